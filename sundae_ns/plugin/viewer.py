"""Controls of nerfstudio's viewer: the head's check box, and a preview of what a prune would keep.

The preview changes neither the Gaussians nor the images of training and evaluation. It shows what the prune itself
leaves, by the same decision; under a rule that merges, with the merged values. The head is disabled in a preview,
because it was trained on all Gaussians.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple, get_args

import torch
from nerfstudio.viewer.render_state_machine import RenderStateMachine
from nerfstudio.viewer.viewer_elements import ViewerCheckbox, ViewerControl, ViewerDropdown, ViewerSlider, ViewerText
from torch import Tensor

from sundae_ns.core.errors import ConfigError, SundaeError, one_line
from sundae_ns.core.gaussians import sanitise
from sundae_ns.graph.graph import NeighborGraph
from sundae_ns.pruning.decision import Pruned, prune_gaussians
from sundae_ns.pruning.merge import gaussian_graph
from sundae_ns.pruning.rule import PruneRule, band_rule, kept_count
from sundae_ns.scene.frames import GaussiansKey
from sundae_ns.scene.render import GaussianSource
from sundae_ns.train.curve import CurvePoint, expected_change
from sundae_ns.train.state import TrainingState

_log = logging.getLogger(__name__)

RuleName = Literal["as configured", "band: high", "band: low", "band: both"]


def in_viewer() -> bool:
    """Whether the calling thread renders for a browser.

    The trainer evaluates by the same method of the model, and its figures must not depend on a slider.
    """
    return isinstance(threading.current_thread(), RenderStateMachine)


def stop_rendering(viewer: Any) -> None:
    """End the threads of nerfstudio's viewer: one that still renders when Python exits aborts the process."""
    machines = [] if viewer is None else list(getattr(viewer, "render_statemachines", {}).values())
    for machine in machines:
        machine.running = False
    for machine in machines:
        machine.join()


def previewed_rule(configured: PruneRule, name: RuleName) -> PruneRule:
    """The rule of a name in the menu; everything that the name does not say is as configured.

    ``band: both`` is the paper's rule with the configured gamma, ``band: high`` and ``band: low`` are its two ends.
    These do not merge.
    """
    bands = {"band: high": 1.0, "band: low": 0.0, "band: both": configured.gamma}
    return band_rule(replace(configured, signal="positions"), bands[name]) if name in bands else configured


class Visible(NamedTuple):
    """What an image shows."""

    source: GaussianSource
    mask: Tensor | None  # The Gaussians in it, bool [N]; None for all
    compensate: bool  # Whether the head may correct the image


class ViewerControls(torch.nn.Module):
    """The controls, and what the preview has computed of the Gaussians of a state by the ``configured`` rule.

    A module without parameters, because nerfstudio looks for viewer elements in modules only. ``contribute`` returns
    the contribution of the Gaussians ``[N]``, given nerfstudio's datamanager and the number that a prune will keep;
    ``curve`` the curve by which trials have chosen the number of Gaussians, empty without them.
    """

    def __init__(
        self,
        state: TrainingState,
        configured: PruneRule,
        contribute: Callable[[Any, int | None], Tensor],
        curve: Callable[[], Sequence[CurvePoint]],
    ) -> None:
        super().__init__()
        self.compensate = ViewerCheckbox("Neural compensation", True, hint="Off shows the base colours alone")
        hint = "Show only what a prune to this share would keep; 1 shows everything"
        self.keep_ratio = ViewerSlider("Keep ratio", 1.0, 0.01, 1.0, 0.01, cb_hook=self._show_expected, hint=hint)
        hint = "Number of Gaussians and, where trials have found it, what so few lose if they are trained on"
        self.expected = ViewerText("Expected", "", disabled=True, hint=hint)
        hint = "Rule of the previewed prune; the head is disabled in a preview"
        rules = list(get_args(RuleName))
        self.rule = ViewerDropdown("Rule", rules[0], rules, hint=hint)
        self.control = ViewerControl()  # gives access to the viewer, and so to the training views
        self.training_gaussians = False  # Whether a trainer changes the field
        self._state, self._configured, self._contribute, self._curve = state, configured, contribute, curve
        self._lock = threading.Lock()
        self._previewed: tuple[int, ...] = ()  # Of the Gaussians that were previewed
        self._graphs: dict[tuple[str, bool], NeighborGraph] = {}
        self._contributions: dict[int | None, Tensor] = {}
        self._previews: dict[tuple[str, float], Pruned | None] = {}

    @property
    def gaussians_key(self) -> GaussiansKey | None:
        """Identifies the present Gaussians; None during densification."""
        if self.training_gaussians and self._state.densifying:
            return None
        return self._state.gaussians.num_gaussians, self._state.pruning["num_prunes"]

    def _show_expected(self, slider: ViewerSlider) -> None:
        n = self._state.gaussians.num_gaussians
        count = kept_count(float(slider.value), n)
        change = expected_change(self._curve(), n, count)
        figures = "" if change is None else f": {change[0]:+.2f} dB, SSIM {change[1]:+.4f}"
        self.expected.value = f"{count:,} Gaussians{figures}"

    def visible(self, source: GaussianSource, crop: Tensor | None, *, compensate: bool) -> Visible | None:
        """What the next image of a ``source`` shows; None if it shows no Gaussian.

        ``crop`` are the Gaussians in the crop box, bool ``[N]``; ``compensate`` counts outside of a viewer.
        """
        if (preview := self.preview()) is not None:
            gaussians, mask = preview.gaussians, preview.decision.mask
            if crop is not None:
                gaussians, mask = gaussians.rows(crop[mask]), mask & crop
            return Visible(GaussianSource(gaussians, replayable=False), mask, compensate=False) if mask.any() else None
        if in_viewer():
            compensate = self.compensate.value
        if crop is None:
            return Visible(source, None, compensate)
        rows = GaussianSource(source.gaussians.rows(crop), replayable=False)
        return Visible(rows, crop, compensate) if crop.any() else None

    def preview(self) -> Pruned | None:
        """The previewed prune; None outside of the viewer, with the slider at 1, or if the rule cannot be applied.

        The caller holds nerfstudio's lock on the model, so training in another thread waits.
        """
        name = self.rule.value
        ratio = round(float(self.keep_ratio.value), 6)
        if ratio >= 1 or not in_viewer():
            return None
        with self._lock:
            state = self._state
            # Each change in place raises a tensor's version, in training at every step; there, count steps instead.
            counts = (value._version for value in state.gaussians.values())
            known = state.gaussians.num_gaussians, state.pruning["num_prunes"], state.restored
            version = (*known, *((state.step // 100,) if self.training_gaussians else counts))
            if version != self._previewed:
                self._previewed, self._graphs, self._contributions, self._previews = version, {}, {}, {}
            if (name, ratio) not in self._previews:
                pruned: Pruned | None = None
                try:
                    pruned = self._prune(previewed_rule(self._configured, name), ratio)
                except (SundaeError, torch.cuda.OutOfMemoryError) as error:
                    # An exception in the viewer's thread would end all rendering.
                    _log.warning(f"no preview of {name}: {one_line(error)}")
                self._previews = {(name, ratio): pruned}
            return self._previews[name, ratio]

    @torch.no_grad()
    def _prune(self, rule: PruneRule, ratio: float) -> Pruned:
        gaussians = self._state.gaussians
        usable = sanitise(gaussians).gaussians
        count = kept_count(ratio, usable.num_gaussians)
        kind = rule.edges, rule.uses_edge_weights
        if rule.uses_graph and kind not in self._graphs:
            self._graphs[kind] = gaussian_graph(usable, rule)
        weights = None
        if rule.uses_contribution and count < usable.num_gaussians:
            detail = count if rule.uses_detail else None
            if detail not in self._contributions:
                viewer: Any = getattr(self.control, "viewer", None)
                if viewer is None:
                    raise ConfigError("there are no training views; open the run with ns-viewer, or take another rule")
                self._contributions = {detail: self._contribute(viewer.pipeline.datamanager, detail)}
            weights = self._contributions[detail]
        return prune_gaussians(gaussians, rule, count, weights, self._graphs.get(kind))
