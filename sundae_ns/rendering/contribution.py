"""Contribution of the primitives: their blending weights, summed over the pixels of the training views."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from sundae_ns.errors import DataError
from sundae_ns.pruning.detail import pixel_detail
from sundae_ns.rasterization import blending_weights
from sundae_ns.rendering.render import RenderSettings, draw, pass_options
from sundae_ns.rendering.source import FieldSource, Primitives, TrainingView, ViewBatch
from sundae_ns.rendering.views import View

if TYPE_CHECKING:
    from rich.console import Console


@torch.no_grad()
def contribution(
    source: FieldSource,
    views: Sequence[TrainingView],
    background: Tensor,
    settings: RenderSettings,
    count: int | None = None,
    *,
    console: Console | None = None,
) -> Tensor:
    """Blending weight of each primitive, summed over the pixels of all views ``[N]``. With several ranks, collective.

    Args:
        source: of the primitives.
        views: the training views.
        background: colour ``[3]``; fixed, so that the result does not depend on a random one.
        settings: how images are made.
        count: number of primitives that a prune will keep. If given, pixels are weighted by the detail that these
            cannot show (:func:`sundae_ns.pruning.detail.pixel_detail`).
        console: shows a progress bar; None for none.

    Raises:
        DataError: a mask has another size than its view.
    """
    means = source.field["means"]
    total = torch.zeros(source.field.num_primitives, device=means.device)
    for batch, _, primitives, weights in weights_by_batch(source, views, background, settings, count, console=console):
        source.accumulate(total, weights, primitives, batch)
    return total


def weights_by_batch(
    source: FieldSource,
    views: Sequence[TrainingView],
    background: Tensor,
    settings: RenderSettings,
    count: int | None = None,
    *,
    console: Console | None = None,
) -> Iterator[tuple[ViewBatch, View, Primitives, Tensor]]:
    """Weights of the primitives in each batch of views; arguments and errors as for :func:`contribution`.

    Yields:
        The batch, the view of this process, its primitives, and their weights ``[M]``.
    """
    batches: Iterable[ViewBatch] = source.batches(views)
    if console is not None:
        from rich.progress import track  # takes 20 ms, which a render without a prune need not spend

        batches = track(batches, "Contribution of primitives", transient=True, console=console)
    for batch in batches:
        view, mask = batch.own
        if mask is not None and tuple(mask.shape) != (view.height, view.width, 1):
            raise DataError(
                f"a mask is {list(mask.shape)} but its view is {view.width} x {view.height} px; "
                "give masks the size of their images"
            )
        primitives = source.primitives(view, settings, features=False, colors=count is not None)
        pixels = None if mask is None else mask[..., 0].to(primitives["means"])
        if count is None:
            weights = blending_weights(pixels=pixels, **pass_options(primitives, view, settings))
        else:
            share, background = count / source.total, background.to(primitives["means"].device)
            weights = _detail_weights(primitives, view, background, settings, share, pixels)
        yield batch, view, primitives, weights


def _detail_weights(
    primitives: Primitives,
    view: View,
    background: Tensor,
    settings: RenderSettings,
    share: float,
    pixels: Tensor | None,
) -> Tensor:
    """Blending weights ``[M]`` over pixels weighted by their detail, and by ``pixels`` ``[H, W]``."""
    # As in blending_weights, but one pass gives the image and the weights: the gradient of the first channel.
    fixed = Primitives({name: value.detach() for name, value in primitives.items()})
    fixed["colors"].requires_grad_()
    with torch.enable_grad():
        images, splatted = draw(fixed, view, background, settings.without_head(), depth=False)
    # A prune keeps the same share of the visible primitives as of all.
    detail = pixel_detail(images["base_rgb"], share * float((splatted.radii > 0).sum()))
    pixels = detail if pixels is None else detail * pixels
    with torch.enable_grad():
        blended = (splatted.colors[..., 0] * pixels).sum()
    return torch.autograd.grad(blended, fixed["colors"])[0][:, 0]
