"""A comparison as one web page that needs no network: figures, and a slider for each view."""

from __future__ import annotations

import base64
import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from io import BytesIO

import matplotlib
import numpy as np
import torch
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from PIL import Image
from torch import Tensor

from sundae_ns.core.metrics import ViewQuality, check_pair
from sundae_ns.core.tables import number
from sundae_ns.report.measure import METRICS, Measured, Subject, cells_of
from sundae_ns.scene.scene import image_of
from sundae_ns.train.curve import CountCurve

MOST_VIEWS = 24  # that a page shows of a scene
MOST_ON_A_PAGE = 32  # views of all scenes, if that leaves two for each
LONGEST_SIDE = 1200  # of images in a page, pixels; larger ones are reduced
EXACT_SIDE = 512  # longest side of images that are stored without loss: a browser enlarges them, and losses would show
LARGEST_ERROR = 51  # mean difference of the channels, in levels of 255, that gets the last colour of the error map
ERROR_COLORS = np.round(255 * matplotlib.colormaps["magma"](np.linspace(0, 1, 32))[:, :3]).astype(np.uint8)
"""Colours of an error map ``[32, 3]``, readable in grey and with colour deficiency; few, as they decide its bytes."""
NAMES = {"psnr": "PSNR", "psnr_fitted": "colours fitted", "ssim": "SSIM", "lpips": "LPIPS"}


@dataclass(frozen=True)
class ShownView:
    """One view in a page. Images are addresses with their data (``data:``), and all of one size."""

    index: int  # In the order of the capture, from 0
    name: str  # Of the photo's file
    size: tuple[int, int]  # Width and height of the measured truth, pixels
    shown_size: tuple[int, int]  # Width and height of the images here
    full: ViewQuality
    base: ViewQuality | None  # Without the head; None if there is no head
    truth: str
    images: Mapping[str, str]  # Over the truth: ``rendering``, ``head off`` if there is a head, ``error map``


@dataclass(frozen=True)
class ShownRun:
    """A scene in a page."""

    measured: Measured
    views: Sequence[ShownView] = ()  # In the order of the capture
    curve: CountCurve | None = None  # Expected quality over the number of Gaussians; None if no trials decided about it
    capture: str = ""  # Identifies the capture: views of one index and name compare between scenes of one capture


def choose_cameras(qualities: Sequence[float], most: int) -> list[int]:
    """Indices of at most ``most`` views, two or more, ascending: evenly spaced from the worst PSNR to the best.

    NaN counts as worst.
    """
    ranked = sorted(range(len(qualities)), key=lambda i: -math.inf if math.isnan(qualities[i]) else qualities[i])
    return sorted(ranked[int(i)] for i in np.linspace(0, len(ranked) - 1, min(len(ranked), max(most, 2))).round())


def error_map(rendering: Tensor, truth: Tensor, size: tuple[int, int] | None = None) -> Image.Image:
    """Mean absolute difference of the three channels as colours; equal images get the first colour everywhere.

    Both images are ``[H, W, 3]`` in [0, 1], else a ``DataError``; values beyond are clamped. Returns an image with a
    palette, of this width and height or those of the images, from 0 to :data:`LARGEST_ERROR` levels of 255; more gets
    the last colour.
    """
    check_pair(rendering, truth)
    image = Image.fromarray((_plain(rendering) - _plain(truth)).abs().mean(dim=-1).numpy())
    image = image.resize(size or image.size, Image.Resampling.BOX)
    last = len(ERROR_COLORS) - 1
    ranks = np.asarray(image) * (255 / LARGEST_ERROR * last)
    mapped = Image.fromarray(np.round(ranks.clip(0, last)).astype(np.uint8))
    mapped.putpalette(ERROR_COLORS.tobytes())
    return mapped


def shown_views(subject: Subject, measured: Measured, runs: int) -> list[ShownView]:
    """Some views of one of the ``runs`` on a page; memory holds the images of one at a time at their full size."""
    most = min(MOST_VIEWS, max(MOST_ON_A_PAGE // runs, 2))
    full, base = measured.full.views, measured.base.views if measured.has_head else None
    views = []
    for i in choose_cameras([view.psnr for view in full], most):
        images = {"rendering": subject.image(i)} | ({} if base is None else {"head off": subject.image(i, head=False)})
        views.append(shown_view(i, subject.names[i], subject.truths[i], images, full[i], base[i] if base else None))
    return views


def shown_view(
    index: int, name: str, truth: Tensor, images: Mapping[str, Tensor], full: ViewQuality, base: ViewQuality | None
) -> ShownView:
    """A view with its images ``[H, W, 3]`` in [0, 1], by name, reduced and encoded; others are as in the class."""
    height, width = truth.shape[:2]
    scale = min(1.0, LONGEST_SIDE / max(height, width))
    size = (max(round(width * scale), 1), max(round(height * scale), 1))
    layers = {layer: _image(image, size) for layer, image in images.items()}
    layers["error map"] = error_map(images["rendering"], truth, size)
    encoded = {layer: _encoded(image) for layer, image in layers.items()}
    return ShownView(index, name, (width, height), size, full, base, _encoded(_image(truth, size)), encoded)


def _plain(image: Tensor) -> Tensor:
    return image.detach().to(device="cpu", dtype=torch.float32).nan_to_num(nan=0.0).clamp(0, 1)  # of a damaged scene


def _image(image: Tensor, size: tuple[int, int]) -> Image.Image:
    return image_of(_plain(image)).resize(size, Image.Resampling.LANCZOS)


def _encoded(image: Image.Image) -> str:
    """An image as a ``data:`` address: PNG if it has a palette, else WebP."""
    file = BytesIO()
    kind = "png" if image.mode == "P" else "webp"
    image.save(file, kind, optimize=True, lossless=max(image.size) <= EXACT_SIDE, quality=90)
    return f"data:image/{kind};base64,{base64.b64encode(file.getvalue()).decode()}"


def report_page(runs: Sequence[ShownRun], notes: Sequence[str], command: str, truth: str = "photo") -> str:
    """The HTML of a page that loads nothing, which its policy forbids; made by a ``command``.

    Labels of ``runs`` differ; ``notes`` say what was left out and why, in one sentence each. ``truth`` names what the
    images are compared with.
    """
    scenes: dict[str, list[tuple[int, ShownRun]]] = {}
    for numbered in enumerate(runs):
        scenes.setdefault(numbered[1].measured.scene, []).append(numbered)
    files = (resources.files("sundae_ns.report").joinpath(name) for name in ("page.html", "page.js"))
    page, script = (file.read_text(encoding="utf-8") for file in files)
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {"data": Markup, "number": number}
    return environment.from_string(page).render(
        title=", ".join(scenes),
        command=command,
        truth=truth,
        devices=", ".join(sorted({run.measured.gpu or "CPU" for run in runs})),
        scenes=[(name, group, cells_of([run.measured for _, run in group])) for name, group in scenes.items()],
        runs=runs,
        notes=notes,
        metrics=[(name, NAMES[name], digits, " dB" * name.startswith("psnr")) for name, digits in METRICS],
        log=math.log10,
        gradient=", ".join("#{:02x}{:02x}{:02x}".format(*color) for color in ERROR_COLORS),
        largest_error=LARGEST_ERROR,
        longest_side=LONGEST_SIDE,
        exact_side=EXACT_SIDE,
        script=Markup(script),
        # A browser runs no other script here, even if a file's name should ever stand unescaped.
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
    )
