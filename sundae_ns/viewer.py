"""Controls of nerfstudio's viewer: the head's check box, and a preview of what a prune would keep.

The preview never touches the field, nor the images of training and evaluation. It shows what the prune itself leaves, by
the same decision; under a rule that merges, with the merged values. The head is disabled in a preview, because it was
trained on all primitives of the field.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from nerfstudio.viewer.render_state_machine import RenderStateMachine
from nerfstudio.viewer.viewer_elements import ViewerCheckbox, ViewerControl, ViewerDropdown, ViewerSlider
from torch import Tensor

from sundae_ns.compensation import PHASES
from sundae_ns.errors import ConfigError, SundaeError
from sundae_ns.gaussians import finite_mask
from sundae_ns.gaussians.field import Field
from sundae_ns.graphs import NeighborGraph
from sundae_ns.pruning import Decision, PruningConfig, band_rule, decide, field_graph, single_prune
from sundae_ns.pruning.scores import for_graph
from sundae_ns.rendering.outputs import FieldKey
from sundae_ns.rendering.source import FieldSource
from sundae_ns.training.field_state import FieldState
from sundae_ns.training.schedules import make_schedule

Rule = Literal["as configured", "band: high", "band: low", "band: both", "opacity", "random"]

STEP = 0.01
"""Step of the slider, and its lowest share."""
STEPS_BETWEEN_SCORES = 100
"""Training steps after which the scores of a moving field are computed again."""

Contribute = Callable[[Any, float | None], Tensor]
"""Contribution of the primitives ``[N]``, given nerfstudio's datamanager and the share that will stay."""


def in_viewer() -> bool:
    """Whether the calling thread renders for a browser.

    The trainer evaluates by the same method of the model, and its figures must not depend on a slider.
    """
    return isinstance(threading.current_thread(), RenderStateMachine)


def rule_config(config: PruningConfig, rule: Rule, keep_ratio: float) -> PruningConfig:
    """Options of one prune by ``rule`` to a share; everything else is as in ``config``.

    ``band: both`` is the paper's rule with ``config``'s gamma, ``band: high`` and ``band: low`` are its two ends. These,
    opacity and random do not merge.
    """
    bands = {"band: high": 1.0, "band: low": 0.0, "band: both": config.gamma}
    if rule in bands:
        return band_rule(replace(config, signal="positions"), keep_ratio, bands[rule])
    config = single_prune(config, keep_ratio)
    if rule == "opacity":
        return replace(config, score="opacity", selection="top", redistribution="none")
    if rule == "random":
        return replace(config, score="random", selection="sampled", redistribution="none")
    return config


@dataclass(frozen=True)
class Visible:
    """What an image shows."""

    source: FieldSource
    mask: Tensor | None
    """Primitives of the field in it, bool ``[N]``; None for all."""
    compensate: bool
    """Whether the head may correct the image."""


class _FieldVersion:
    """Identifies a field without keeping it alive: exactly, or to within some steps while it is trained."""

    def __init__(self, state: FieldState, training: bool) -> None:
        self._parameters = [weakref.ref(value) for value in state.field.values()]
        self._version = self._version_of(state, training)

    @staticmethod
    def _version_of(state: FieldState, training: bool) -> list[int]:
        # Each change in place raises a tensor's version, in training at every step; there, count steps instead. Surgery
        # makes new parameters.
        if training:
            return [state.field.num_primitives, state.step // STEPS_BETWEEN_SCORES]
        return [state.field.num_primitives, *(value._version for value in state.field.values())]

    def matches(self, state: FieldState, training: bool) -> bool:
        """Whether the state still has this field."""
        values = list(state.field.values())
        same = len(values) == len(self._parameters) and all(r() is v for r, v in zip(self._parameters, values))
        return same and self._version == self._version_of(state, training)


class ViewerControls(torch.nn.Module):
    """The controls, and what the preview has computed of the present field.

    A module without parameters, because nerfstudio looks for viewer elements in modules only.

    Args:
        state: the field.
        config: options of pruning.
        contribute: computes contributions.
    """

    def __init__(self, state: FieldState, config: PruningConfig, contribute: Contribute) -> None:
        super().__init__()
        self.compensate = ViewerCheckbox("Neural compensation", True, hint="Off shows the base colours alone")
        self.phases: ViewerDropdown[str] = ViewerDropdown(
            "Runs of the head",
            str(1 if state.head is None else state.head.config.phases),
            [str(count) for count in PHASES],
            hint="Mean over this many offsets of its pixel grid: slower, with less flicker",
            cb_hook=self._set_phases,
        )
        self.keep_ratio = ViewerSlider(
            "Keep ratio",
            1.0,
            STEP,
            1.0,
            STEP,
            hint="Show only what a prune to this share would keep; 1 shows everything",
        )
        rules = list(get_args(Rule))
        self.rule = ViewerDropdown(
            "Rule", rules[0], rules, hint="Rule of the previewed prune; the head is disabled in a preview"
        )
        self.control = ViewerControl()
        """Gives access to the viewer, and so to the training views."""
        self.training_field = False
        """Whether a trainer changes the field."""
        self._state, self._config, self._contribute = state, config, contribute
        self._lock = threading.Lock()
        self._seen: _FieldVersion | None = None
        self._graphs: dict[str, NeighborGraph] = {}
        self._contribution: tuple[float | None, Tensor] | None = None
        self._found: tuple[tuple[str, float], Decision | None] | None = None

    @property
    def field_key(self) -> FieldKey | None:
        """Identifies the present field; None while it is densified."""
        if self.training_field and self._state.densifying:
            return None
        return self._state.field.num_primitives, self._state.pruning["num_prunes"]

    def _set_phases(self, chosen: ViewerDropdown[str]) -> None:
        head = self._state.head
        if head is not None:
            head.config = replace(head.config, phases=int(chosen.value))  # type: ignore[arg-type]

    def visible(self, source: FieldSource, crop: Tensor | None, *, compensate: bool) -> Visible | None:
        """What the next image shows; None if it shows no primitive.

        Args:
            source: of all primitives.
            crop: primitives in the crop box, bool ``[N]``; None for no box.
            compensate: whether images outside of a viewer get the head's correction.
        """
        preview, mask = self.preview(), crop
        if preview is not None:
            mask = preview.mask if mask is None else mask & preview.mask
        if mask is None:
            return Visible(source, None, self.compensate.value if in_viewer() else compensate)
        if not mask.any():
            return None
        values = None
        if preview is not None and preview.values is not None:
            rows = mask[preview.mask]
            values = {name: value[rows] for name, value in preview.values.items()}
        allowed = preview is None and (self.compensate.value if in_viewer() else compensate)
        return Visible(source.part(mask, values), mask, allowed)

    def preview(self) -> Decision | None:
        """The previewed prune; None outside of the viewer, with the slider at 1, or if the rule cannot be applied.

        Graphs are built once for a field. The pass over the training views is repeated if the rule weights pixels by the
        share that stays. The caller holds nerfstudio's lock on the field, so training in another thread waits.
        """
        keep_ratio = round(float(self.keep_ratio.value), 6)
        if keep_ratio >= 1 or not in_viewer():
            return None
        asked = (self.rule.value, keep_ratio)
        with self._lock:
            if self._seen is None or not self._seen.matches(self._state, self.training_field):
                self._seen = _FieldVersion(self._state, self.training_field)
                self._graphs, self._contribution, self._found = {}, None, None
            if self._found is None or self._found[0] != asked:
                found: Decision | None = None
                try:
                    found = self._decide(rule_config(self._config, *asked))
                except (SundaeError, torch.cuda.OutOfMemoryError) as error:
                    # An exception in the viewer's thread would end all rendering.
                    reason = " ".join(str(error).split())[:200]
                    CONSOLE.log(f"[yellow]No preview of {asked[0]}: {reason}")
                self._found = (asked, found)
            return self._found[1]

    def _decide(self, config: PruningConfig) -> Decision:
        field = self._state.field
        finite = finite_mask(field)
        if config.uses_graph and config.edges not in self._graphs:
            usable = Field({name: value.detach()[finite] for name, value in field.items()}, field.encoding)
            self._graphs[config.edges] = field_graph(for_graph(usable, config), config)
        count = make_schedule(config).target(int(finite.sum()))
        graph = self._graphs.get(config.edges)
        return decide(field, config, lambda: self._contribution_of(config), count=count, graph=graph)

    def _contribution_of(self, config: PruningConfig) -> Tensor:
        share = config.keep_ratio if config.uses_detail else None
        if self._contribution is None or self._contribution[0] != share:
            viewer: Any = getattr(self.control, "viewer", None)
            if viewer is None:
                raise ConfigError("there are no training views; open the run with ns-viewer, or choose another rule")
            self._contribution = (share, self._contribute(viewer.pipeline.datamanager, share))
        return self._contribution[1]
