"""Test views as a page shows them: photo, renderings and error map of one size, as data of the page."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO

import matplotlib
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from sundae_ns.errors import DataError
from sundae_ns.evaluation.comparison_image import ComparisonRow
from sundae_ns.evaluation.measured import ViewQuality

MOST_VIEWS = 24
"""Most views that a page shows of a run."""
MOST_ON_A_PAGE = 32
"""Most views that a page shows of all runs, unless the worst and the best of each are more."""
LONGEST_SIDE = 1200
"""Of the images in a page, pixels; larger ones are reduced."""
LARGEST_ERROR = 51
"""Mean absolute difference of the channels, in levels of 255, that gets the last colour of the error map."""
EXACT_SIDE = 512
"""Longest side of images that lose nothing, pixels: a browser enlarges them, so that losses at colours' edges show."""
_QUALITY = 90
"""Of larger ones, as WebP: the losses of a view to its photo are far larger."""
_COLORS = 32
"""Colours of an error map: few, because they decide its bytes."""
_COLORMAP = "magma"
"""Perceptually uniform, and readable with colour-vision deficiency and in grey."""


@dataclass(frozen=True)
class ShownView:
    """One test view in a page. Images are addresses with their data (``data:``), and all of one size."""

    index: int
    """In the order of the capture, from 0."""
    name: str
    """Of the photo's file."""
    size: tuple[int, int]
    """Width and height of the photo that was measured, pixels."""
    shown: tuple[int, int]
    """Width and height of the images here."""
    full: ViewQuality
    """Of the complete rendering, at the size that was measured."""
    base: ViewQuality | None
    """Without the head; None if there is no head."""
    photo: str
    rendering: str
    bare: str | None
    """Rendering without the head; None if there is no head."""
    error: str
    """Error of the complete rendering."""

    @property
    def exact(self) -> bool:
        """Whether the images are those that were measured, neither reduced nor with losses of their format."""
        return max(self.size) <= EXACT_SIDE


def choose_views(qualities: Sequence[float], most: int) -> list[int]:
    """Indices of the views to show, ascending: the worst, the best, and others evenly spaced in the capture's order.

    Args:
        qualities: PSNR by view; NaN counts as worst.
        most: number of indices to return; at least 2, and all views if they are fewer.
    """
    count, most = len(qualities), max(most, 2)
    if count <= most:
        return list(range(count))
    ranked = sorted(range(count), key=lambda i: -math.inf if math.isnan(qualities[i]) else qualities[i])
    spaced = (round(place) for place in np.linspace(0, count - 1, most - 2))
    # Where the worst or the best is among the spaced ones, the next worst fills up.
    order = dict.fromkeys([ranked[0], ranked[-1], *spaced, *ranked])
    return sorted(list(order)[:most])


def views_for_each(runs: int) -> int:
    """Most views to show of each of a number of runs, so that a page keeps its size."""
    return min(MOST_VIEWS, max(MOST_ON_A_PAGE // max(runs, 1), 2))


def error_colors() -> NDArray[np.uint8]:
    """Colours of an error map ``[32, 3]``, from no error to the largest."""
    colors = matplotlib.colormaps[_COLORMAP](np.linspace(0, 1, _COLORS))[:, :3]
    return np.round(255 * colors).astype(np.uint8)


def error_map(rendering: Tensor, photo: Tensor, size: tuple[int, int] | None = None) -> Image.Image:
    """Mean absolute difference of the three channels as colours; equal images get the first colour everywhere.

    Args:
        rendering, photo: ``[H, W, 3]`` in [0, 1]; values beyond are clamped.
        size: width and height of the map, by the mean over each of its pixels; by default that of the images.

    Returns:
        An image with a palette, from 0 to :data:`LARGEST_ERROR` levels of 255; more gets the last colour.

    Raises:
        DataError: the shapes differ, or are not ``[H, W, 3]``.
    """
    if rendering.shape != photo.shape or photo.dim() != 3 or photo.shape[-1] != 3:
        raise DataError(f"Images have shapes {list(rendering.shape)} and {list(photo.shape)}; give two of one size.")
    error = (_plain(rendering) - _plain(photo)).abs().mean(dim=-1)
    image = Image.fromarray(error.numpy())
    if size is not None and size != image.size:
        image = image.resize(size, Image.Resampling.BOX)
    places = np.asarray(image) * (255 / LARGEST_ERROR * (_COLORS - 1))
    mapped = Image.fromarray(np.round(places.clip(0, _COLORS - 1)).astype(np.uint8))
    mapped.putpalette(error_colors().tobytes())
    return mapped


def shown_view(row: ComparisonRow, index: int, full: ViewQuality, base: ViewQuality | None) -> ShownView:
    """A view with its images reduced and encoded.

    Args:
        row: images of the view; its title is the name of the photo's file.
        index: of the view.
        full, base: as in :class:`ShownView`.
    """
    photo, rendering = torch.as_tensor(row.truth), torch.as_tensor(row.compensated)
    height, width = photo.shape[:2]
    scale = min(1.0, LONGEST_SIDE / max(height, width))
    size = (max(round(width * scale), 1), max(round(height * scale), 1))
    return ShownView(
        index=index,
        name=row.title,
        size=(width, height),
        shown=size,
        full=full,
        base=base,
        photo=_address(_image(photo, size)),
        rendering=_address(_image(rendering, size)),
        bare=None if base is None else _address(_image(torch.as_tensor(row.base), size)),
        error=_address(error_map(rendering, photo, size)),
    )


def _plain(image: Tensor) -> Tensor:
    # A damaged field may render NaN, which no image holds.
    return image.detach().to(device="cpu", dtype=torch.float32).nan_to_num(nan=0.0).clamp(0, 1)


def _image(image: Tensor, size: tuple[int, int]) -> Image.Image:
    whole = Image.fromarray((255 * _plain(image)).round().to(torch.uint8).numpy())
    return whole if whole.size == size else whole.resize(size, Image.Resampling.LANCZOS)


def _address(image: Image.Image) -> str:
    """An image as a ``data:`` address: PNG if it has a palette, else WebP."""
    file = BytesIO()
    if image.mode == "P":
        image.save(file, "png", optimize=True)
    elif max(image.size) <= EXACT_SIDE:
        image.save(file, "webp", lossless=True)
    else:
        image.save(file, "webp", quality=_QUALITY)
    kind = "png" if image.mode == "P" else "webp"
    return f"data:image/{kind};base64,{base64.b64encode(file.getvalue()).decode()}"
