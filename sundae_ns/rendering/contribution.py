"""Contribution of the primitives: their blending weights, summed over the pixels of the training views."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from sundae_ns.errors import DataError
from sundae_ns.pruning.scores import pixel_detail
from sundae_ns.rasterization import blending_weights
from sundae_ns.rendering.render import RenderSettings, draw, pass_options
from sundae_ns.rendering.source import LocalField, TrainingView
from sundae_ns.rendering.views import View

if TYPE_CHECKING:
    from rich.console import Console


@torch.no_grad()
def contribution(
    source: LocalField,
    views: Sequence[TrainingView],
    background: Tensor,
    settings: RenderSettings,
    count: int | None = None,
    *,
    console: Console | None = None,
) -> Tensor:
    """Blending weight of each primitive, summed over the pixels of all views ``[N]``.

    Args:
        source: of the primitives.
        views: the training views.
        background: colour ``[3]``; fixed, so that the result does not depend on a random one.
        settings: how images are made.
        count: number of primitives that a prune will keep. If given, pixels are weighted by the detail that these
            cannot show (:func:`sundae_ns.pruning.scores.pixel_detail`).
        console: shows a progress bar; None for none.

    Raises:
        DataError: a mask has another size than its view.
    """
    total = torch.zeros(source.field.num_primitives, device=source.field["means"].device)
    shown: Iterable[TrainingView] = views
    if console is not None:
        from rich.progress import track  # takes 20 ms, which a render without a prune need not spend

        shown = track(views, "Contribution of primitives", transient=True, console=console)
    for view, mask in shown:
        if mask is not None and tuple(mask.shape) != (view.height, view.width, 1):
            raise DataError(
                f"a mask is {list(mask.shape)} but its view is {view.width} x {view.height} px; "
                "give masks the size of their images"
            )
        primitives = source.primitives(view, settings, features=False, colors=count is not None)
        pixels = None if mask is None else mask[..., 0].to(total)
        if count is None:
            total += blending_weights(pixels=pixels, **pass_options(primitives, view, settings))
        else:
            share = count / source.total
            total += _detail_weights(primitives, view, background.to(total.device), settings, share, pixels)
    return total


def _detail_weights(
    primitives: Mapping[str, Tensor],
    view: View,
    background: Tensor,
    settings: RenderSettings,
    share: float,
    pixels: Tensor | None,
) -> Tensor:
    """Blending weights ``[M]`` over pixels weighted by their detail, and by ``pixels`` ``[H, W]``."""
    # As in blending_weights, but one pass gives the image and the weights: the gradient of the first channel.
    fixed = {name: value.detach() for name, value in primitives.items()}
    fixed["colors"].requires_grad_()
    with torch.enable_grad():
        images, splatted = draw(fixed, view, background, settings.without_head(), depth=False)
    # A prune keeps the same share of the visible primitives as of all.
    detail = pixel_detail(images["base_rgb"], share * float((splatted.radii > 0).sum()))
    pixels = detail if pixels is None else detail * pixels
    with torch.enable_grad():
        blended = (splatted.colors[..., 0] * pixels).sum()
    return torch.autograd.grad(blended, fixed["colors"])[0][:, 0]
