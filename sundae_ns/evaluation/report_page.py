"""The report as one web page that needs no network: figures, and a slider between photo and rendering of each view."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from io import BytesIO
from typing import Any

import matplotlib
from jinja2 import Environment, StrictUndefined, Template
from markupsafe import Markup

from sundae_ns.evaluation.count_curve import CountCurve
from sundae_ns.evaluation.document import EXPLANATIONS, METRICS, devices_of, heads_of, number, row_of
from sundae_ns.evaluation.measured import MEGABYTE, Measured, ViewQuality
from sundae_ns.evaluation.plots import PALETTE, plot_counts
from sundae_ns.evaluation.shown_views import LARGEST_ERROR, LONGEST_SIDE, ShownView, error_colors

_NAMES = {
    "psnr": "PSNR",
    "psnr_fitted": "colours fitted",
    "ssim": "SSIM",
    "flip": "FLIP",
    "lpips": "LPIPS",
    "jod": "JOD",
}
_UNITS = {"psnr": " dB", "psnr_fitted": " dB"}
_INK = "#010203"
_COLORS = {_INK: "currentColor", PALETTE[0].lower(): "var(--line)", PALETTE[1].lower(): "var(--choice)"}
"""Colours of a drawing, and those of the page, light or dark, that it takes instead."""
_TICKS = 4
"""Parts of the scale of errors."""


@dataclass(frozen=True)
class ShownRun:
    """A run in a page."""

    measured: Measured
    views: Sequence[ShownView]
    """Its views to show, in the order of the capture."""
    curve: CountCurve | None = None
    """Expected quality over the number of primitives; None if no trials decided about it."""
    capture: str = ""
    """Stands for the capture: views of one index and name compare between runs of one capture."""


def report_page(
    scenes: Mapping[str, Sequence[ShownRun]],
    plots: Mapping[str, Sequence[tuple[str, bytes]]],
    notes: Sequence[str],
    command: str,
) -> str:
    """The HTML of the page. It holds all that it shows, and its policy forbids it to load anything.

    Args:
        scenes: runs by scene.
        plots: (title, content of the PNG file) by scene.
        notes: what was left out and why, one sentence each.
        command: the command that made the page.
    """
    runs = [run for own in scenes.values() for run in own]
    numbers = {run.measured.label: place for place, run in enumerate(runs)}
    script = _text("report_page.js")
    sections = [
        {
            "name": scene,
            "rows": [row_of(run.measured, way) for run in own for way in run.measured.configurations],
            "runs": [_run(run, numbers, own) for run in own],
            "plots": [(title, Markup(_address(content))) for title, content in plots.get(scene, ())],
        }
        for scene, own in scenes.items()
    ]
    return _template().render(
        title=", ".join(scenes),
        command=command,
        devices=devices_of([run.measured for run in runs]),
        heads=heads_of([run.measured for run in runs]),
        scenes=sections,
        runs=[(numbers[run.measured.label], run.measured.label) for run in runs],
        explanations=EXPLANATIONS,
        notes=notes,
        gradient=", ".join("#{:02x}{:02x}{:02x}".format(*color) for color in error_colors()),
        ticks=[f"{LARGEST_ERROR * i / _TICKS:.0f}" for i in range(_TICKS)] + [f"{LARGEST_ERROR} or more"],
        largest_error=LARGEST_ERROR,
        longest_side=LONGEST_SIDE,
        script=Markup(script),
        # The only script that a browser runs here, even if some name of a file should ever slip through unescaped.
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
    )


@cache
def _template() -> Template:
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(_text("report_page.html"))


def _text(name: str) -> str:
    return resources.files("sundae_ns.evaluation").joinpath(name).read_text(encoding="utf-8")


def _address(png: bytes) -> str:
    return f"data:image/png;base64,{base64.b64encode(png).decode()}"


def _run(run: ShownRun, numbers: Mapping[str, int], beside: Sequence[ShownRun]) -> dict[str, Any]:
    """Values of the template for a run; ``beside`` are the runs of its scene."""
    own, place = run.measured, numbers[run.measured.label]
    facts = {
        "source": own.source,
        "method": own.method,
        "variant": own.variant,
        "steps": f"{own.steps:,}",
        "seed": "" if own.seed is None else str(own.seed),
        "share kept": "" if own.keep_ratio is None else f"{100 * own.keep_ratio:.1f}%",
        "primitives": f"{own.primitives:,}",
        "size": f"{own.bytes_total / MEGABYTE:.2f} MB ({own.bytes_total:,} bytes)",
        "test views": f"{len(own.full.views)}, {own.resolution} px",
        "head": f"on, {own.precision}" if own.has_head else "none",
    }
    # The same view of another run of this scene may stand in the photo's place.
    peers = [
        (other.measured, {_key(other, view): view.index for view in other.views})
        for other in beside
        if other is not run
    ]
    views = [
        {
            "id": f"v{place}-{view.index}",
            "view": view,
            "quality": _figures(view.full),
            "base": None if view.base is None else _figures(view.base),
            "psnr": repr(view.full.psnr),
            "images": {name: Markup(image) for name, image in _images(view).items()},
            "peers": [
                (f"v{numbers[other.label]}-{known[key]}", other.label)
                for other, known in peers
                if (key := _key(run, view)) in known
            ],
            "percent": f"{100 * view.shown[0] / view.size[0]:.0f}",
        }
        for view in run.views
    ]
    return {
        "number": place,
        "label": own.label,
        "facts": {name: value for name, value in facts.items() if value},
        "views": views,
        "total": len(own.full.views),
        "has_head": own.has_head,
        "exact": all(view.exact for view in run.views),
        "curve": None if run.curve is None else Markup(_drawing(run.curve, f"c{place}-")),
        "decision": run.curve,
    }


def _key(run: ShownRun, view: ShownView) -> tuple[object, ...]:
    return run.capture, view.index, view.name, view.shown


def _images(view: ShownView) -> dict[str, str]:
    """Images over the photo by their names."""
    found = {"rendering": view.rendering, "head off": view.bare, "error map": view.error}
    return {name: image for name, image in found.items() if image is not None}


def _figures(view: ViewQuality) -> str:
    """Figures of a view, those that were measured."""
    values = [(name, getattr(view, name), digits) for name, digits in METRICS]
    return ", ".join(
        f"{_NAMES[name]} {number(value, digits)}{_UNITS.get(name, '')}"
        for name, value, digits in values
        if value is not None
    )


def _drawing(curve: CountCurve, prefix: str) -> str:
    """The curve as an SVG element that stands in a page: text in the page's colour, and names of its own.

    Args:
        curve: to draw.
        prefix: of the names that the element gives to its parts; those of other drawings in the page differ.
    """
    look: dict[Any, Any] = {"svg.fonttype": "none", "svg.hashsalt": prefix, "font.family": "sans-serif"}
    look |= dict.fromkeys(("axes.facecolor", "figure.facecolor", "savefig.facecolor"), "none")
    look |= dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), _INK)
    file = BytesIO()
    with matplotlib.rc_context(look):
        plot_counts(file, curve, form="svg")
    text = file.getvalue().decode()
    # What stands before it and its metadata hold addresses, which only name standards.
    text = re.sub("<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = re.sub(r' xmlns(:\w+)?="[^"]*"| version="[^"]*"', "", text, count=3)
    text = re.sub(r'\bid="|(?<=url\()#|(?<=href=")#', lambda found: found[0] + prefix, text)
    text = re.sub("<style[^>]*>.*?</style>", "", text, flags=re.DOTALL)
    for color, own in _COLORS.items():
        text = text.replace(color, own)
    return text.replace("<svg ", '<svg aria-hidden="true" ', 1)
