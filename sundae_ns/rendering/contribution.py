"""Contribution of the primitives: their blending weights, summed over the pixels of the training views."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import torch
from torch import Tensor

from sundae_ns.errors import DataError
from sundae_ns.pruning.detail import pixel_detail
from sundae_ns.rasterization import blending_weights
from sundae_ns.rendering.render import RenderSettings, draw, pass_options
from sundae_ns.rendering.source import FieldSource, Primitives, TrainingView, ViewBatch
from sundae_ns.rendering.views import View


def view_weights(
    primitives: Primitives,
    view: View,
    background: Tensor,
    settings: RenderSettings,
    keep_ratio: float | None = None,
    mask: Tensor | None = None,
) -> Tensor:
    """Blending weight of each primitive, summed over the pixels of one view ``[M]``.

    Args:
        primitives: of the view, from a :class:`FieldSource`.
        view: the camera.
        background: colour ``[3]``.
        settings: how images are made.
        keep_ratio: share of the primitives that will stay. If given, pixels are weighted by detail at the
            resolution of these primitives (:func:`sundae_ns.pruning.pixel_detail`).
        mask: pixels that count, bool ``[H, W, 1]``; None for all.

    Raises:
        DataError: the mask has another size than the view.
    """
    if mask is not None and tuple(mask.shape) != (view.height, view.width, 1):
        raise DataError(
            f"a mask is {list(mask.shape)} but its view is {view.width} x {view.height} px; give masks the size of their images"
        )
    pixels = None
    if keep_ratio is not None:
        background = background.to(primitives["means"].device)
        images, splatted = draw(primitives, view, background, settings.without_head(), depth=False)
        pixels = pixel_detail(images["base_rgb"], keep_ratio * float((splatted.radii > 0).sum()))
    if mask is not None:
        counts = mask[..., 0].to(primitives["means"])
        pixels = counts if pixels is None else pixels * counts
    return blending_weights(pixels=pixels, **pass_options(primitives, view, settings))


def weights_by_batch(
    source: FieldSource,
    views: Sequence[TrainingView],
    background: Tensor,
    settings: RenderSettings,
    keep_ratio: float | None = None,
    *,
    progress: bool = False,
) -> Iterator[tuple[ViewBatch, View, Primitives, Tensor]]:
    """Weights of the primitives in each batch of views; arguments as for :func:`contribution`.

    Yields:
        The batch, the view of this process, its primitives, and their weights ``[M]``.
    """
    batches: Iterable[ViewBatch] = source.batches(views)
    if progress:
        from nerfstudio.utils.rich_utils import CONSOLE  # programs without nerfstudio show no progress
        from rich.progress import track

        batches = track(batches, "Contribution of primitives", transient=True, console=CONSOLE)
    for batch in batches:
        view = batch.own.view
        primitives = source.primitives(view, settings, features=False, colors=keep_ratio is not None)
        yield batch, view, primitives, view_weights(primitives, view, background, settings, keep_ratio, batch.own.mask)


@torch.no_grad()
def contribution(
    source: FieldSource,
    views: Sequence[TrainingView],
    background: Tensor,
    settings: RenderSettings,
    keep_ratio: float | None = None,
    *,
    progress: bool = False,
) -> Tensor:
    """Blending weight of each primitive, summed over the pixels of all views ``[N]``. With several ranks, collective.

    Args:
        source: of the primitives.
        views: the training views.
        background: colour ``[3]``; fixed, so that the result does not depend on a random one.
        settings: how images are made.
        keep_ratio: see :func:`view_weights`.
        progress: show a progress bar.
    """
    means = source.field["means"]
    total = torch.zeros(source.field.num_primitives, device=means.device)
    passes = weights_by_batch(source, views, background, settings, keep_ratio, progress=progress)
    for batch, _, primitives, weights in passes:
        source.accumulate(total, weights, primitives, batch)
    return total
