"""Pictures of the primitives' centres, and of how their responses are distributed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from sundae_ns.errors import DataError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAPER = (246, 246, 244)
"""Colour behind the points: lighter than most of what is photographed, darker than white things."""
_COVER = 0.6
"""Points are drawn so large that they would cover this share of the picture, if none hid another."""
_LARGEST = 90
"""The longer side of the picture over the side of the largest points."""


@dataclass(frozen=True)
class Look:
    """A direction to look at points from: where they land in a picture."""

    name: str
    pixels: Tensor
    """Column and row of each point ``[N, 2]``, pixels, the first pixel's middle at 0.5; anything outside is not drawn."""
    depth: Tensor
    """Distance along the line of sight ``[N]``; nearer points hide others, and points at 0 or less are not drawn."""
    width: int
    height: int


def look_through(points: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int, name: str = "") -> Look:
    """What a pinhole camera sees of points ``[N, 3]``.

    Args:
        points: in world units.
        viewmat: world-to-camera, OpenCV axes ``[4, 4]`` or its first three rows.
        K: intrinsics in pixels ``[3, 3]``.
        width, height: of the picture, pixels.
        name: of the look.
    """
    seen = points.double() @ viewmat[:3, :3].double().T + viewmat[:3, 3].double()
    depth = seen[:, 2]
    safe = torch.where(depth > 0, depth, torch.ones_like(depth))
    pixels = seen[:, :2] / safe[:, None] * torch.stack([K[0, 0], K[1, 1]]).double() + K[:2, 2].double()
    return Look(name, pixels, depth, width, height)


def look_along_axes(points: Tensor, side: int = 600) -> list[Look]:
    """Three orthogonal views of points ``[N, 3]``: from above (along z), from the front (y) and from the side (x).

    Their common scale shows the middle 70% of the points along each axis and half as much again around them: a far
    background, as captures that were walked around have, would shrink the rest to a dot.
    """
    low, high = (torch.quantile(_few(points.double()), share, dim=0) for share in (0.15, 0.85))
    middle, extent = (low + high) / 2, float((high - low).max()) * 1.5
    scale = side / extent if extent > 0 else 1.0
    looks = []
    for name, right, up, along, sign in (
        ("from above", 0, 1, 2, -1.0),
        ("from the front", 0, 2, 1, 1.0),
        ("from the side", 1, 2, 0, -1.0),
    ):
        moved = (points.double() - middle) * scale
        tall = float(high[up] - low[up]) * 2.2 * scale  # more, for what stands out of a flat scene
        height = round(min(max(tall, side / 4), side))
        pixels = torch.stack([side / 2 + moved[:, right], height / 2 - moved[:, up]], dim=1)
        depth = sign * moved[:, along]
        looks.append(Look(name, pixels, depth - depth.min() + 1, side, height))
    return looks


def _few(points: Tensor, most: int = 100_000) -> Tensor:
    """At most about so many rows, evenly spread; torch's quantiles take no more than 16 million numbers."""
    return points[:: max(1, len(points) // most)]


def draw_points(look: Look, colors: Tensor, mask: Tensor | None = None) -> NDArray[np.uint8]:
    """Draw points as little squares, near ones over far ones.

    Args:
        look: where the points are.
        colors: ``[N, 3]`` uint8.
        mask: draw these only, bool ``[N]``.

    Returns:
        ``[H, W, 3]``. The fewer points, the larger the squares, up to a 90th of the picture.
    """
    height, width = look.height, look.width
    chosen = torch.ones_like(look.depth, dtype=torch.bool) if mask is None else mask.clone()
    chosen &= (look.depth > 0) & torch.isfinite(look.pixels).all(dim=1)
    chosen &= (look.pixels >= 0).all(dim=1) & (look.pixels[:, 0] < width) & (look.pixels[:, 1] < height)
    rows = chosen.nonzero().squeeze(1)
    rows = rows[torch.sort(look.depth[rows], descending=True, stable=True).indices]
    columns, lines = look.pixels[rows].floor().long().T.numpy()
    most = max(1, max(width, height) // _LARGEST)
    side = int(np.clip(round((_COVER * width * height / max(len(rows), 1)) ** 0.5), 1, most))
    # A margin, so that squares at the edge need no clipping.
    canvas = np.full((height + 2 * most, width + 2 * most, 3), PAPER, np.uint8)
    # Every pixel takes the last point that covers it, which is the nearest one.
    front = np.full(canvas.shape[:2], -1, np.int64)
    order = np.arange(len(rows))
    for down in range(side):
        for right in range(side):
            place = (lines + most - side // 2 + down, columns + most - side // 2 + right)
            np.maximum.at(front, place, order)
    covered = front >= 0
    canvas[covered] = colors[rows].numpy()[front[covered]]
    return canvas[most : most + height, most : most + width]


def points_sheet(looks: Sequence[Look], colors: Tensor, sets: Mapping[str, Tensor], *, title: str = "") -> Image.Image:
    """A sheet of pictures: a row for each look, a column for each set of points.

    Args:
        looks: of all points.
        colors: ``[N, 3]`` uint8.
        sets: masks by their captions, bool ``[N]``.
        title: stands above.

    Raises:
        DataError: there is nothing to draw.
    """
    from matplotlib.figure import Figure

    if not looks or not sets:
        raise DataError("there is nothing to draw; give at least one look and one set")
    wide = 4.2
    heights = [wide * look.height / look.width for look in looks]
    figure = Figure(figsize=(wide * len(sets), sum(heights) + 0.1 * len(looks) + 0.7), dpi=120, layout="constrained")
    axes = figure.subplots(len(looks), len(sets), squeeze=False, height_ratios=heights)
    for row, look in enumerate(looks):
        for column, (caption, mask) in enumerate(sets.items()):
            panel = axes[row][column]
            panel.imshow(draw_points(look, colors, mask), interpolation="antialiased")
            panel.set_xticks([])
            panel.set_yticks([])
            if row == 0:
                panel.set_title(caption, fontsize=11)
            if column == 0 and look.name:
                panel.set_ylabel(look.name, fontsize=10)
    figure.suptitle(title, fontsize=12)
    return _picture(figure)


def response_histogram(
    magnitude: Tensor, *, thresholds: Mapping[str, tuple[float | None, float | None]]
) -> Image.Image:
    """A histogram of response magnitudes over a logarithmic axis.

    Args:
        magnitude: ``[N]``; zeros and values that are not finite have no place on the axis, and are counted in the title.
        thresholds: for each caption the highest magnitude of the low end that is kept, and the lowest of the high end;
            drawn as a dotted and as a solid line, or not at all for None.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.5, 4.5), dpi=120, layout="constrained")
    panel = figure.subplots()
    values = magnitude[torch.isfinite(magnitude) & (magnitude > 0)].double().log10().numpy()
    if len(values):
        low, high = values.min(), values.max()
        edges = np.linspace(low, high, 101) if high > low else np.array([low - 0.5, low + 0.5])
        panel.hist(10.0**values, bins=list(10.0**edges), color="#7d93a8", edgecolor="none")
        panel.set_xscale("log")
    for color, (caption, (lowest, highest)) in zip(_palette(len(thresholds)), thresholds.items()):
        for place, style, label in ((lowest, ":", None), (highest, "-", caption)):
            if place is not None and place > 0:
                panel.axvline(place, color=color, linestyle=style, linewidth=1.4, label=label)
    zeros, unknown = int((magnitude == 0).sum()), int((~torch.isfinite(magnitude)).sum())
    panel.set_title(
        f"{len(magnitude):,} primitives; not shown: {unknown:,} without neighbours, {zeros:,} of no response",
        fontsize=11,
    )
    panel.set_xlabel("squared norm of the high-pass response")
    panel.set_ylabel("primitives")
    if thresholds:
        title = "share kept; high-pass right\nof the line, low-pass left\nof the dotted one"
        figure.legend(loc="outside right upper", title=title, fontsize=9, title_fontsize=9)
    return _picture(figure)


def _palette(count: int) -> list[str]:
    colors = ["#c0392b", "#d68910", "#1e8449", "#6c3483", "#1f618d"]
    return [colors[i % len(colors)] for i in range(count)]


def _picture(figure: Figure) -> Image.Image:
    """Draw a figure without pyplot, and so without any state that other code could share."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
