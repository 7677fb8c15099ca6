"""What a prune would keep, shown in the viewer before it happens. Floor 3: nerfstudio's viewer elements, no maths.

A slider and a menu in the viewer; the field, and pictures of training and evaluation, are never touched. What is shown is
what the prune itself leaves, by the same decision: under a rule that merges, with what the dropped hand on. The head is left
out: it was trained on the primitives that are there, and on a part of them it would paint what no one has trained it to.
"""

from __future__ import annotations

import threading
import weakref
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal, get_args

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from nerfstudio.viewer.render_state_machine import RenderStateMachine
from nerfstudio.viewer.viewer_elements import ViewerControl, ViewerDropdown, ViewerSlider
from torch import Tensor

from sundae_ns.errors import ConfigError, SundaeError
from sundae_ns.gaussians import finite_mask
from sundae_ns.graphs import NeighborGraph
from sundae_ns.pruning import Decision, PruningConfig, band_rule, decide, field_graph, single_prune
from sundae_ns.pruning.scores import for_graph

if TYPE_CHECKING:
    from sundae_ns.model import SundaeModel

Rule = Literal["as configured", "band: high", "band: low", "band: both", "opacity", "random"]

STEP = 0.01
"""Step of the slider, and its least share."""
STEPS_BETWEEN_SCORES = 100
"""While a trainer moves the field at every step, its scores are taken again after so many steps."""


def in_viewer() -> bool:
    """Whether the calling thread draws for a browser.

    What is set in the viewer is asked for here first: the trainer evaluates by the same method of the model, and its
    figures must not depend on where a slider stands.
    """
    return isinstance(threading.current_thread(), RenderStateMachine)


def rule_config(config: PruningConfig, rule: Rule, keep_ratio: float) -> PruningConfig:
    """Options of one prune by ``rule`` that keeps ``keep_ratio``; what the rule leaves open is as in ``config``.

    ``band: both`` is the paper's rule, with ``config``'s gamma; ``band: high`` and ``band: low`` are its two ends alone.
    These, opacity and random leave the values of what stays alone.
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


class _Version:
    """Remembers a field without keeping it alive: exactly while nobody trains it, else to within some steps."""

    def __init__(self, model: SundaeModel) -> None:
        self._parameters = [weakref.ref(value) for value in model.gaussians.values()]
        self._moves = self._moves_of(model)

    @staticmethod
    def _moves_of(model: SundaeModel) -> list[int]:
        # Every change in place raises a tensor's version. In training that is every step, so steps are counted instead;
        # densification and prunes make new parameters.
        if model.attached:
            return [model.num_points, model.step // STEPS_BETWEEN_SCORES]
        return [model.num_points, *(value._version for value in model.gaussians.values())]

    def is_of(self, model: SundaeModel) -> bool:
        """Whether the model still has the field that was remembered."""
        values = list(model.gaussians.values())
        same = len(values) == len(self._parameters) and all(r() is v for r, v in zip(self._parameters, values))
        return same and self._moves == self._moves_of(model)


class Preview(torch.nn.Module):
    """Slider and menu of the viewer, and what has been computed of the present field.

    A module without parameters, because nerfstudio looks for elements of the viewer in modules only.
    """

    def __init__(self) -> None:
        super().__init__()
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
            "Rule", rules[0], rules, hint="Which primitives a prune would keep; shown without the head"
        )
        self.control = ViewerControl()
        """Through it nerfstudio hands over the viewer, and so the training views."""
        self._lock = threading.Lock()
        self._seen: _Version | None = None
        self._graphs: dict[str, NeighborGraph] = {}
        self._contribution: tuple[float | None, Tensor] | None = None
        self._found: tuple[tuple[str, float], Decision | None] | None = None

    def decision(self, model: SundaeModel) -> Decision | None:
        """What to show; None for all of the field as it is.

        None outside of the viewer, with the slider at 1, and where the rule cannot be applied, which is said once. Graphs
        are built once a field; the pass over the training views is repeated where the rule weighs pixels by the share
        that is kept. The caller holds nerfstudio's lock on the field, as its viewer does, so that training in another
        thread waits.
        """
        keep_ratio = round(float(self.keep_ratio.value), 6)
        if keep_ratio >= 1 or not in_viewer():
            return None
        asked = (self.rule.value, keep_ratio)
        with self._lock:
            if self._seen is None or not self._seen.is_of(model):
                self._seen, self._graphs, self._contribution, self._found = _Version(model), {}, None, None
            if self._found is None or self._found[0] != asked:
                found: Decision | None = None
                try:
                    found = self._decide(model, rule_config(model.config.pruning, *asked))
                except (SundaeError, torch.cuda.OutOfMemoryError) as error:
                    # In the viewer's thread an error would end all drawing.
                    reason = " ".join(str(error).split())[:200]
                    CONSOLE.log(f"[yellow]No preview of {asked[0]}: {reason}")
                self._found = (asked, found)
            return self._found[1]

    def _decide(self, model: SundaeModel, config: PruningConfig) -> Decision:
        params = model.gaussians
        if config.uses_graph and config.edges not in self._graphs:
            finite = finite_mask(params)
            usable = {name: value.detach()[finite] for name, value in params.items()}
            self._graphs[config.edges] = field_graph(for_graph(usable, config), config)
        return decide(
            params, config, lambda: self._contribution_of(model, config), graph=self._graphs.get(config.edges)
        )

    def _contribution_of(self, model: SundaeModel, config: PruningConfig) -> Tensor:
        share = config.keep_ratio if config.uses_detail else None
        if self._contribution is None or self._contribution[0] != share:
            viewer: Any = getattr(self.control, "viewer", None)
            if viewer is None:
                raise ConfigError("there are no training views here; open the run with ns-viewer, or take another rule")
            self._contribution = (share, model.contribution(viewer.pipeline.datamanager, config))
        return self._contribution[1]
