"""The report as one web page that needs no network: figures, and a slider between photo and rendering of each view."""

from __future__ import annotations

import base64
import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from io import BytesIO
from typing import Any

import matplotlib
import numpy as np
import torch
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from sundae_ns.core.errors import DataError
from sundae_ns.core.metrics import ViewQuality
from sundae_ns.core.tables import MEGABYTE, number
from sundae_ns.report.measured import EXPLANATIONS, METRICS, Measured, heads_of, rows_of
from sundae_ns.train.curve import CountCurve

MOST_VIEWS = 24
"""Most views that a page shows of a run."""
MOST_ON_A_PAGE = 32
"""Most views that a page shows of all runs, if that leaves two for each."""
LONGEST_SIDE = 1200
"""Longest side of images in a page, pixels; larger ones are reduced."""
EXACT_SIDE = 512
"""Longest side of images that are stored without loss, pixels: a browser enlarges them, and losses would show."""
LARGEST_ERROR = 51
"""Mean absolute difference of the channels, in levels of 255, that gets the last colour of the error map."""
ERROR_COLORS: NDArray[np.uint8] = np.round(
    255 * matplotlib.colormaps["magma"](np.linspace(0, 1, 32))[:, :3]  # readable in grey and with colour deficiency
).astype(np.uint8)
"""Colours of an error map ``[32, 3]``, from no error to the largest; few, because they decide its bytes."""
_NAMES = {"psnr": "PSNR", "psnr_fitted": "colours fitted", "ssim": "SSIM", "flip": "FLIP", "lpips": "LPIPS"}


@dataclass(frozen=True)
class ShownView:
    """One test view in a page. Images are addresses with their data (``data:``), and all of one size."""

    index: int  # In the order of the capture, from 0
    name: str  # Of the photo's file
    size: tuple[int, int]  # Width and height of the measured photo, pixels
    shown: tuple[int, int]  # Width and height of the images here
    full: ViewQuality
    base: ViewQuality | None  # Without the head; None if there is no head
    photo: str
    images: Mapping[str, str]  # Over the photo: ``rendering``, ``head off`` if there is a head, ``error map``


@dataclass(frozen=True)
class ShownRun:
    """A run in a page."""

    measured: Measured
    views: Sequence[ShownView]  # In the order of the capture
    curve: CountCurve | None = None  # Expected quality over the number of Gaussians; None if no trials decided about it
    capture: str = ""  # Identifies the capture: views of one index and name compare between runs of one capture


def choose_cameras(qualities: Sequence[float], most: int) -> list[int]:
    """Indices of the views to show, ascending: the worst, the best, and others evenly spaced in the capture's order.

    ``qualities`` are the PSNR by view; NaN counts as worst. At least 2 and at most ``most`` are returned, or all if
    fewer.
    """
    count, most = len(qualities), max(most, 2)
    if count <= most:
        return list(range(count))
    ranked = sorted(range(count), key=lambda i: -math.inf if math.isnan(qualities[i]) else qualities[i])
    spaced = (round(index) for index in np.linspace(0, count - 1, most - 2))
    # Where the worst or the best is among the spaced ones, the next worst fills up.
    order = dict.fromkeys([ranked[0], ranked[-1], *spaced, *ranked])
    return sorted(list(order)[:most])


def cameras_for_each(runs: int) -> int:
    """Most views of each run on a page of this number of runs."""
    return min(MOST_VIEWS, max(MOST_ON_A_PAGE // max(runs, 1), 2))


def error_map(rendering: Tensor, photo: Tensor, size: tuple[int, int] | None = None) -> Image.Image:
    """Mean absolute difference of the three channels as colours; equal images get the first colour everywhere.

    Both images are ``[H, W, 3]`` in [0, 1], else a ``DataError``; values beyond are clamped. Returns an image with a
    palette, of this width and height or those of the images, from 0 to :data:`LARGEST_ERROR` levels of 255; more gets
    the last colour.
    """
    if rendering.shape != photo.shape or photo.dim() != 3 or photo.shape[-1] != 3:
        raise DataError(f"Images have shapes {list(rendering.shape)} and {list(photo.shape)}; give two of one size.")
    error = (_plain(rendering) - _plain(photo)).abs().mean(dim=-1)
    image = Image.fromarray(error.numpy())
    if size is not None and size != image.size:
        image = image.resize(size, Image.Resampling.BOX)
    last = len(ERROR_COLORS) - 1
    ranks = np.asarray(image) * (255 / LARGEST_ERROR * last)
    mapped = Image.fromarray(np.round(ranks.clip(0, last)).astype(np.uint8))
    mapped.putpalette(ERROR_COLORS.tobytes())
    return mapped


def shown_view(
    index: int, name: str, photo: Tensor, rendering: Tensor, bare: Tensor, full: ViewQuality, base: ViewQuality | None
) -> ShownView:
    """A view with its images reduced and encoded, those without the head only with ``base``.

    Images are ``[H, W, 3]`` in [0, 1]; ``bare`` is without the head. The other arguments are those of
    :class:`ShownView`.
    """
    height, width = photo.shape[:2]
    scale = min(1.0, LONGEST_SIDE / max(height, width))
    size = (max(round(width * scale), 1), max(round(height * scale), 1))
    images = {"rendering": _image(rendering, size)}
    images |= {} if base is None else {"head off": _image(bare, size)}
    images |= {"error map": error_map(rendering, photo, size)}
    encoded = {layer: _encoded(image) for layer, image in images.items()}
    return ShownView(index, name, (width, height), size, full, base, _encoded(_image(photo, size)), encoded)


def _plain(image: Tensor) -> Tensor:
    # A damaged scene may render NaN.
    return image.detach().to(device="cpu", dtype=torch.float32).nan_to_num(nan=0.0).clamp(0, 1)


def _image(image: Tensor, size: tuple[int, int]) -> Image.Image:
    converted = Image.fromarray((255 * _plain(image)).round().to(torch.uint8).numpy())
    return converted if converted.size == size else converted.resize(size, Image.Resampling.LANCZOS)


def _encoded(image: Image.Image) -> str:
    """An image as a ``data:`` address: PNG if it has a palette, else WebP."""
    file, kind = BytesIO(), "png" if image.mode == "P" else "webp"
    quality = {"lossless": True} if max(image.size) <= EXACT_SIDE else {"quality": 90}
    image.save(file, kind, optimize=True, **quality)
    return _address(file.getvalue(), kind)


def _address(content: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def curve_plot(curve: CountCurve) -> str:
    """Expected PSNR and SSIM over the number of Gaussians, with errors and the choice, as the address of an SVG."""
    figure = Figure(figsize=(10.8, 4.2), layout="constrained")
    FigureCanvasSVG(figure)
    points = [point for point in curve.points if point.psnr_loss is not None and point.ssim_loss is not None]
    counts = [point.count for point in points]
    for panel, metric, label in zip(figure.subplots(1, 2), ("psnr", "ssim"), ("PSNR, dB", "SSIM"), strict=True):
        values = [getattr(point, metric) for point in points]
        errors = [getattr(point, f"{metric}_error") for point in points]
        panel.errorbar(counts, values, yerr=errors, color="#0072B2", marker="o", markersize=5, capsize=3, linewidth=1.3)
        panel.axvline(curve.chosen, color="#D55E00", linestyle="--", linewidth=1.3)
        panel.set(xscale="log", xlabel="number of Gaussians", ylabel=f"{label} (higher is better)")
        panel.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
        panel.xaxis.set_minor_formatter(NullFormatter())
        panel.grid(alpha=0.3, linewidth=0.6)
    lines = figure.axes[0].lines
    labels = ["expected; bars: standard error of the loss", f"chosen: {curve.chosen:,} of {curve.full:,}"]
    figure.legend([lines[0], lines[-1]], labels, loc="outside lower center", ncols=2, frameon=False)
    file = BytesIO()
    figure.savefig(file, format="svg")
    return _address(file.getvalue(), "svg+xml")


def report_page(runs: Sequence[ShownRun], notes: Sequence[str], command: str) -> str:
    """The HTML of a page that loads nothing, which its policy forbids; made by a ``command``.

    Labels of ``runs`` differ; ``notes`` say what was left out and why, in one sentence each.
    """
    measured = [run.measured for run in runs]
    numbers = {run.label: number for number, run in enumerate(measured)}
    scenes = {run.scene: [other for other in runs if other.measured.scene == run.scene] for run in measured}
    script, last = _text("page.js"), LARGEST_ERROR
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(_text("page.html")).render(
        title=", ".join(scenes),
        command=command,
        devices=", ".join(sorted({run.gpu or "CPU" for run in measured})),
        heads=heads_of(measured),
        scenes=[
            {
                "name": scene,
                "rows": rows_of([run.measured for run in group]),
                "runs": [_run(run, numbers, group) for run in group],
            }
            for scene, group in scenes.items()
        ],
        runs=[(number, label) for label, number in numbers.items()],
        explanations=EXPLANATIONS,
        notes=notes,
        gradient=", ".join("#{:02x}{:02x}{:02x}".format(*color) for color in ERROR_COLORS),
        ticks=[*(f"{last * i / 4:.0f}" for i in range(4)), f"{last} or more"],
        largest_error=last,
        longest_side=LONGEST_SIDE,
        script=Markup(script),
        # A browser runs no other script here, even if a file's name should ever stand unescaped.
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
    )


def _text(name: str) -> str:
    return resources.files("sundae_ns.report").joinpath(name).read_text(encoding="utf-8")


def _run(run: ShownRun, numbers: Mapping[str, int], group: Sequence[ShownRun]) -> dict[str, Any]:
    """Values of the template for a run; ``group`` are the runs of its scene."""
    measured = run.measured
    run_number = numbers[measured.label]
    facts = {
        "source": measured.source,
        "method": measured.method,
        "variant": measured.variant,
        "steps": f"{measured.steps:,}",
        "seed": "" if measured.seed is None else str(measured.seed),
        "share kept": "" if measured.keep_ratio is None else f"{100 * measured.keep_ratio:.1f}%",
        "Gaussians": f"{measured.primitives:,}",
        "size": f"{measured.bytes_total / MEGABYTE:.2f} MB ({measured.bytes_total:,} bytes)",
        "test views": f"{len(measured.full.views)}, {measured.resolution} px",
        "head": f"on, {measured.precision}" if measured.has_head else "none",
    }

    def identity(run: ShownRun, view: ShownView) -> tuple[object, ...]:
        return run.capture, view.index, view.name, view.shown

    # The same view of another run of this scene may stand in the photo's place.
    peers = [
        (other.measured.label, {identity(other, view) for view in other.views}) for other in group if other is not run
    ]
    views = [
        {
            "id": f"v{run_number}-{view.index}",
            "view": view,
            "quality": _figures(view.full),
            "base": None if view.base is None else _figures(view.base),
            "psnr": repr(view.full.psnr),
            "photo": Markup(view.photo),
            "images": {name: Markup(image) for name, image in view.images.items()},
            "peers": [
                (f"v{numbers[label]}-{view.index}", label) for label, known in peers if identity(run, view) in known
            ],
            "percent": f"{100 * view.shown[0] / view.size[0]:.0f}",
        }
        for view in run.views
    ]
    return {
        "number": run_number,
        "label": measured.label,
        "facts": {name: value for name, value in facts.items() if value},
        "views": views,
        "total": len(measured.full.views),
        "has_head": measured.has_head,
        "exact": all(max(view.size) <= EXACT_SIDE for view in run.views),
        "plot": None if run.curve is None else Markup(curve_plot(run.curve)),
        "curve": run.curve,
    }


def _figures(view: ViewQuality) -> str:
    """The measured figures of a view."""
    values = [(name, getattr(view, name), digits) for name, digits in METRICS]
    return ", ".join(
        f"{_NAMES[name]} {number(value, digits)}{' dB' if name.startswith('psnr') else ''}"
        for name, value, digits in values
        if value is not None
    )
