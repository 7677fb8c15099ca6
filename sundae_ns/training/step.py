"""The training step: from a view to its loss. Every training runs this one.

nerfstudio asks for images and losses in two calls, and runs the backward pass and the optimizers itself. Recorded steps
and fine-tunes run both halves in one call. Several ranks give another source of primitives.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from sundae_ns.compensation import Window, training_window
from sundae_ns.rasterization import Rasterization
from sundae_ns.rendering.render import LocalField, RenderSettings, StepResolution, render_view
from sundae_ns.rendering.views import View
from sundae_ns.training.field_state import FieldState
from sundae_ns.training.losses import StepLosses


@dataclass(frozen=True)
class StepInputs:
    """What a step trains on."""

    view: View
    target: Tensor
    """The true image over the background ``[H, W, 3]``."""
    mask: Tensor | None
    """Pixels that count, float ``[H, W, 1]``; None for all."""
    background: Tensor
    """Colour ``[3]``."""
    window: Window | None = None
    """The part of the training image that is shown; None for the whole image."""
    rates: Tensor | None = None
    """Learning rates of the groups of parameters ``[G]``; None where the optimizer holds them."""
    count: Tensor | None = None
    """Number of primitives ``[]``, where parameters have rows for more and a loss is a mean over them."""

    def _tensors(self) -> list[Tensor]:
        always = (self.view.viewmat, self.view.K, self.target, self.background)
        tensors = (*always, self.mask, self.rates, self.count)
        return [value.detach() for value in tensors if value is not None]

    def clone(self) -> StepInputs:
        """A copy, so that a recording reads it where it stays."""
        copies = [value.clone(memory_format=torch.contiguous_format) for value in self._tensors()]
        viewmat, K, target, background, *rest = copies
        mask, rates, count = (None if one is None else rest.pop(0) for one in (self.mask, self.rates, self.count))
        view = self.view._replace(viewmat=viewmat, K=K)
        return StepInputs(view, target, mask, background, self.window, rates, count)

    def copy_to(self, other: StepInputs) -> None:
        """Write these into the inputs of a recording."""
        torch._foreach_copy_(other._tensors(), self._tensors())


@dataclass(frozen=True)
class StepResult:
    """Images and losses of a step; the next step overwrites them."""

    images: dict[str, Tensor]
    """``rgb``, ``base_rgb`` and ``accumulation``, each ``[H, W, C]``."""
    losses: dict[str, Tensor]
    """Terms of the loss ``[]``."""
    loss: Tensor
    """Their sum ``[]``."""


def training_part(state: FieldState, view: View, at: StepResolution) -> tuple[View, Window | None]:
    """The part of a training view that a step shows, and its window; None for the whole image.

    Args:
        state: the field in training; it remembers the focal lengths that the head is trained on.
        view: the whole view.
        at: resolution at this step.
    """
    if state.head_enabled and at.downscale == 1:
        low, high = state.trained_focal or (view.focal, view.focal)
        state.trained_focal = (min(low, view.focal), max(high, view.focal))
    window = training_window(view.width, view.height, at.window_pixels, seed=at.step, mirror=at.mirror)
    return view if window is None else view.cut(window), window


class TrainingStep(NamedTuple):
    """The step of a field, from a view to its loss."""

    source: LocalField
    """Where the view gets its primitives from."""
    state: FieldState
    """Says what is enabled at this step."""
    losses: StepLosses
    """Terms of the loss."""
    params: Mapping[str, Tensor]
    """Trained parameters, for the terms that see them."""

    def images(
        self,
        view: View,
        background: Tensor,
        settings: RenderSettings,
        *,
        depth: bool = False,
    ) -> tuple[dict[str, Any], Rasterization]:
        """The first half: primitives, one splatting pass, and the head; see :func:`sundae_ns.rendering.render_view`."""
        return render_view(self.source, view, background, settings, depth=depth)

    def terms(
        self, images: Mapping[str, Tensor], target: Tensor, mask: Tensor | None, count: Tensor | None = None
    ) -> dict[str, Tensor]:
        """The second half: the terms of the loss by name, each ``[]``; see :class:`StepInputs` for the arguments."""
        return self.losses(self.state, self.params, images["rgb"], images["base_rgb"], target, mask, count)

    def __call__(self, inputs: StepInputs, settings: RenderSettings) -> tuple[Tensor, Rasterization, StepResult]:
        """Both halves.

        Returns:
            The loss ``[]`` with its graph, the rasteriser's result, and the detached result of the step.
        """
        with torch.enable_grad():
            images, splatted = self.images(inputs.view, inputs.background, settings)
            terms = self.terms(images, inputs.target, inputs.mask, inputs.count)
            loss = functools.reduce(torch.add, terms.values())
        shown = {name: images[name].detach() for name in ("rgb", "base_rgb", "accumulation")}
        return loss, splatted, StepResult(shown, {name: value.detach() for name, value in terms.items()}, loss.detach())
