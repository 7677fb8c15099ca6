"""One training step as far as the model owns it: the image of a training view, ready for the loss."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from sundae_ns.compensation import Window, training_window
from sundae_ns.rendering.render import RenderSettings, compensate, draw
from sundae_ns.rendering.source import FieldSource, StepResolution
from sundae_ns.rendering.views import View
from sundae_ns.training.extension import Extension
from sundae_ns.training.field_state import FieldState


@dataclass(frozen=True)
class TrainingImage:
    """The images of a training view and the part of it that they show."""

    images: dict[str, Any]
    """``rgb, base_rgb, depth, accumulation``, each ``[H, W, C]``."""
    window: Window | None
    """The part of the training image; None for the whole image."""


def training_view(
    source: FieldSource, state: FieldState, make_view: Callable[[], View], *, index: int | None, at: StepResolution
) -> tuple[View, Window | None]:
    """The view of a step, and the part of the training image that it shows; None for the whole image.

    Args:
        source: of the primitives.
        state: the field in training; it remembers the focal lengths that the head is trained on.
        make_view: builds the whole view from the camera that was served.
        index: of the training view that was served; None if the camera does not say.
        at: resolution at this step.
    """
    view = source.training_view(at, make_view, index)
    if state.head_enabled and at.downscale == 1:
        state.remember_focal(view.focal)
    window = training_window(view.width, view.height, at.window_pixels, seed=at.step, mirror=at.mirror)
    return view if window is None else view.cut(window), window


def training_image(
    source: FieldSource,
    state: FieldState,
    extensions: Sequence[Extension],
    make_view: Callable[[], View],
    background: Tensor,
    settings: RenderSettings,
    *,
    index: int | None,
    at: StepResolution,
    following: StepResolution,
    depth: bool,
) -> TrainingImage:
    """Render the training view of a step. With several ranks, collective.

    Args:
        source: of the primitives.
        state: the field in training; its ``info`` is set.
        extensions: told before the backward pass.
        make_view: builds the whole view from the camera that was served.
        background: colour ``[3]``.
        settings: of training.
        index: of the training view that was served; None if the camera does not say.
        at: resolution at this step.
        following: resolution at the next step, as far as it is known now.
        depth: whether to render depth.
    """
    view, window = training_view(source, state, make_view, index=index, at=at)
    head = settings.head
    primitives = source.primitives(view, settings, features=head is not None, at=at)
    images, splatted = draw(primitives, view, background, settings, depth=depth)
    if head is not None:
        images["rgb"] = compensate(head, images["base_rgb"], splatted, background, training=True)
    state.info = splatted.info
    if state.densifying:
        source.follow(primitives, state.info, absgrad=settings.absgrad)
    # Now, while the GPU works on this step.
    source.plan_next(following, state.optimizers)
    for extension in extensions:
        extension.before_backward(state)
    del images["feature_image"]
    return TrainingImage(images, window)
