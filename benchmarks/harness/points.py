"""Images and point clouds of the centres of primitives, and histograms of their filter responses."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from plyfile import PlyData, PlyElement
from torch import Tensor

from sundae_ns.errors import DataError
from sundae_ns.storage.atomic import replacing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Okabe and Ito's colours, which people with colour-vision deficiency can tell apart."""
BACKGROUND = (246, 246, 244)
"""Colour behind the points: lighter than most captures, but darker than white objects."""
_COVERED = 0.6
"""Share of the image that the points would cover if none hid another; it sets the size of a point."""
_SIZE_LIMIT = 90
"""The largest point has 1/90 of the image's longer side."""


@dataclass(frozen=True)
class Projection:
    """Points projected into an image."""

    name: str
    """Caption of the viewing direction; may be empty."""
    pixels: Tensor
    """Column and row of each point ``[N, 2]``, in pixels, the first pixel's centre at 0.5. Outside of it: not drawn."""
    depth: Tensor
    """Depth of each point ``[N]``. Nearer points hide others; points with depth <= 0 are not drawn."""
    width: int
    height: int


def project_through_camera(points: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int) -> Projection:
    """Points ``[N, 3]`` projected by a pinhole camera.

    Args:
        points: centres, world units ``[N, 3]``.
        viewmat: world-to-camera, OpenCV axes ``[4, 4]`` or its first three rows.
        K: intrinsics in pixels ``[3, 3]``.
        width, height: size of the image in pixels.
    """
    local = points.double() @ viewmat[:3, :3].double().T + viewmat[:3, 3].double()
    depth = local[:, 2]
    safe = torch.where(depth > 0, depth, torch.ones_like(depth))
    pixels = local[:, :2] / safe[:, None] * torch.stack([K[0, 0], K[1, 1]]).double() + K[:2, 2].double()
    return Projection("", pixels, depth, width, height)


def project_along_axes(points: Tensor, side: int = 600) -> list[Projection]:
    """Three orthographic projections of points ``[N, 3]``: from above (along z), from the front (y) and the side (x).

    The common scale fits 1.5 times the extent of the middle 70% of the points; a far background would shrink the rest
    to a dot.

    Args:
        points: centres, world units ``[N, 3]``.
        side: width of the images in pixels.
    """
    low, high = (torch.quantile(_sample(points.double()), share, dim=0) for share in (0.15, 0.85))
    middle, extent = (low + high) / 2, float((high - low).max()) * 1.5
    scale = side / extent if extent > 0 else 1.0
    projections = []
    for name, right, up, along, sign in (
        ("from above", 0, 1, 2, -1.0),
        ("from the front", 0, 2, 1, 1.0),
        ("from the side", 1, 2, 0, -1.0),
    ):
        moved = (points.double() - middle) * scale
        tall = float(high[up] - low[up]) * 2.2 * scale  # extra height for objects that stand out of a flat scene
        height = round(min(max(tall, side / 4), side))
        pixels = torch.stack([side / 2 + moved[:, right], height / 2 - moved[:, up]], dim=1)
        depth = sign * moved[:, along]
        projections.append(Projection(name, pixels, depth - depth.min() + 1, side, height))
    return projections


def _sample(points: Tensor, most: int = 100_000) -> Tensor:
    """About ``most`` evenly spaced rows; torch's quantile accepts at most 16 million numbers."""
    return points[:: max(1, len(points) // most)]


def draw_points(projection: Projection, colors: Tensor, mask: Tensor | None = None) -> NDArray[np.uint8]:
    """Draw points as small squares, near ones over far ones.

    Args:
        projection: of all points.
        colors: uint8 ``[N, 3]``.
        mask: draw only these points, bool ``[N]``.

    Returns:
        uint8 ``[H, W, 3]``. Fewer points are drawn as larger squares, up to 1/90 of the image.
    """
    height, width = projection.height, projection.width
    visible = torch.ones_like(projection.depth, dtype=torch.bool) if mask is None else mask.clone()
    visible &= (projection.depth > 0) & torch.isfinite(projection.pixels).all(dim=1)
    visible &= (
        (projection.pixels >= 0).all(dim=1) & (projection.pixels[:, 0] < width) & (projection.pixels[:, 1] < height)
    )
    rows = visible.nonzero().squeeze(1)
    rows = rows[torch.sort(projection.depth[rows], descending=True, stable=True).indices]
    columns, lines = projection.pixels[rows].floor().long().T.numpy()
    most = max(1, max(width, height) // _SIZE_LIMIT)
    side = int(np.clip(round((_COVERED * width * height / max(len(rows), 1)) ** 0.5), 1, most))
    # A margin avoids clipping squares at the edge.
    canvas = np.full((height + 2 * most, width + 2 * most, 3), BACKGROUND, np.uint8)
    # Each pixel takes the last point that covers it, which is the nearest.
    front = np.full(canvas.shape[:2], -1, np.int64)
    order = np.arange(len(rows))
    for down in range(side):
        for right in range(side):
            pixel = (lines + most - side // 2 + down, columns + most - side // 2 + right)
            np.maximum.at(front, pixel, order)
    covered = front >= 0
    canvas[covered] = colors[rows].numpy()[front[covered]]
    return canvas[most : most + height, most : most + width]


def points_sheet(
    projections: Sequence[Projection], colors: Tensor, sets: Mapping[str, Tensor], *, title: str = ""
) -> Image.Image:
    """An image with one row per projection and one column per set of points.

    Args:
        projections: of all points.
        colors: uint8 ``[N, 3]``.
        sets: the points of each column by its caption, bool ``[N]``.
        title: heading of the image.

    Raises:
        DataError: there is no projection or no set.
    """
    from matplotlib.figure import Figure

    if not projections or not sets:
        raise DataError("there is nothing to draw; give at least one projection and one set")
    wide = 4.2
    heights = [wide * projection.height / projection.width for projection in projections]
    figure = Figure(
        figsize=(wide * len(sets), sum(heights) + 0.1 * len(projections) + 0.7), dpi=120, layout="constrained"
    )
    axes = figure.subplots(len(projections), len(sets), squeeze=False, height_ratios=heights)
    for row, projection in enumerate(projections):
        for column, (caption, mask) in enumerate(sets.items()):
            panel = axes[row][column]
            panel.imshow(draw_points(projection, colors, mask), interpolation="antialiased")
            panel.set_xticks([])
            panel.set_yticks([])
            if row == 0:
                panel.set_title(caption, fontsize=11)
            if column == 0 and projection.name:
                panel.set_ylabel(projection.name, fontsize=10)
    figure.suptitle(title, fontsize=12)
    return _rendered(figure)


def response_histogram(
    magnitude: Tensor, *, thresholds: Mapping[str, tuple[float | None, float | None]]
) -> Image.Image:
    """A histogram of response magnitudes on a logarithmic axis.

    Args:
        magnitude: ``[N]``. Zeros and values that are not finite have no place on the axis; the title counts them.
        thresholds: by caption, the largest magnitude that the low-pass rule keeps (drawn dashed) and the smallest that
            the high-pass rule keeps (drawn solid); None draws no line.
    """
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(9.5, 4.5), dpi=120, layout="constrained")
    panel = figure.subplots()
    values = magnitude[torch.isfinite(magnitude) & (magnitude > 0)].double().log10().numpy()
    if len(values):
        low, high = values.min(), values.max()
        edges = np.linspace(low, high, 101) if high > low else np.array([low - 0.5, low + 0.5])
        panel.hist(10.0**values, bins=list(10.0**edges), color="0.75", edgecolor="none")
        panel.set_xscale("log")
    colors = dict(zip(thresholds, itertools.cycle(PALETTE)))
    for caption, (low_pass, high_pass) in thresholds.items():
        for limit, style in ((low_pass, "--"), (high_pass, "-")):
            if limit is not None and limit > 0:
                panel.axvline(limit, color=colors[caption], linestyle=style, linewidth=1.4)
    zeros, unknown = int((magnitude == 0).sum()), int((~torch.isfinite(magnitude)).sum())
    panel.set_title(
        f"High-pass response of {len(magnitude):,} primitives\n"
        f"not shown: {unknown:,} without neighbours, {zeros:,} with response 0",
        fontsize=11,
    )
    panel.set_xlabel("squared norm of the high-pass response")
    panel.set_ylabel("number of primitives")
    panel.yaxis.set_major_locator(MaxNLocator(integer=True))
    panel.spines[["top", "right"]].set_visible(False)
    if thresholds:
        handles = [Line2D([], [], color=color, linewidth=4, label=caption) for caption, color in colors.items()]
        handles += [
            Line2D([], [], color="0.3", label="high-pass keeps\nthe right side"),
            Line2D([], [], color="0.3", linestyle="--", label="low-pass keeps\nthe left side"),
        ]
        figure.legend(
            handles=handles, loc="outside right upper", title="keep ratio", fontsize=9, title_fontsize=9, frameon=False
        )
    return _rendered(figure)


def write_points(path: Path, points: Tensor, colors: Tensor, response: Tensor) -> None:
    """Write coloured points with their responses as a binary .ply, atomically.

    Args:
        path: the file; its folder must exist.
        points: positions ``[N, 3]``, stored as float32.
        colors: ``[N, 3]`` uint8.
        response: ``[N]``, stored as float32.

    Raises:
        StorageError: the disk is full or not writable.
    """
    columns = {**dict(zip("xyz", points.T)), **dict(zip(("red", "green", "blue"), colors.T)), "response": response}
    kinds = [(name, "u1" if column.dtype == torch.uint8 else "<f4") for name, column in columns.items()]
    vertices = np.empty(len(points), kinds)
    for name, column in columns.items():
        vertices[name] = column.numpy()
    with replacing(path) as partial:
        PlyData([PlyElement.describe(vertices, "vertex")], text=False, byte_order="<").write(str(partial))


def _rendered(figure: Figure) -> Image.Image:
    """The image of a figure, drawn without pyplot and its global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
