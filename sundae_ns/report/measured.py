"""The measurements of finished scenes, and the table of a report: as Markdown and as CSV."""

from __future__ import annotations

import csv
import html
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from io import StringIO
from statistics import fmean
from typing import Any

from sundae_ns.core.metrics import ViewQuality
from sundae_ns.core.tables import MEGABYTE, number, table, without_nan

HEAD_ON, HEAD_OFF = "head on", "head off"
METRICS = (("psnr", 2), ("ssim", 4), ("psnr_fitted", 2), ("flip", 4), ("lpips", 4))
"""Metrics in the order of a table's columns, with their number of decimals."""
EXPLANATIONS = (
    "Each row is one configuration of rendering a scene. Its time and its metrics come from the same calls.",
    "Metrics are means over the test views. PSNR is over all pixels and channels; fitted, it is taken after the "
    "affine map of colours that brings the image nearest to its photo, so that changing light counts less. SSIM is "
    "pytorch_msssim's (11 x 11 window, no padding), FLIP is LDR-FLIP at 67 pixels per degree, and LPIPS names its net.",
    "Higher PSNR and SSIM are better; lower FLIP, LPIPS, ms and MB are better.",
    "ms per frame is the median over the test views, synchronised with the device.",
    "MB are 1e6 bytes in fp32 of all that the configuration needs: no network or features if the head is off. "
    "For a packed scene it is the whole file.",
    "With the head off, the same scene shows its base colours, although it was trained with a head. Training without a "
    "head is another run, with --pipeline.model.head.mode off.",
)
"""Sentences on the figures of a report's table."""
COLUMNS = (
    *("scene", "method", "variant", "keep_ratio", "seed", "steps", "primitives"),
    *("psnr", "ssim", "psnr_base", "ssim_base", "psnr_fitted", "lpips", "lpips_net"),
    *("bytes_primitives", "bytes_head", "bytes_total", "ms_frame", "ms_splat", "ms_head"),
    *("train_s", "prune_s", "peak_primitives", "peak_vram_mib", "gpu", "resolution", "command"),
)
"""Columns of the CSV. Metrics are means over the test views, ``*_base`` without the head; ``bytes_*`` are bytes,
``ms_*`` milliseconds per frame, ``*_s`` seconds, ``peak_vram_mib`` the MiB that torch allocated at most in training."""


@dataclass(frozen=True)
class Configuration:
    """One configuration of rendering a scene. ``ms`` and ``views`` come from the same calls with the same arguments."""

    name: str  # HEAD_ON or HEAD_OFF; a scene without a head has only the latter
    ms: float | None  # Synchronised milliseconds per frame, median over the test views; None if not timed
    bytes: int  # In fp32, without head and features where they are off; of the file for a packed scene
    views: tuple[ViewQuality, ...]

    def mean(self, metric: str) -> float | None:
        """Mean of a metric over the test views; None unless every view has it."""
        values = [getattr(view, metric) for view in self.views]
        known = [value for value in values if value is not None and not math.isnan(value)]
        return fmean(known) if known and len(known) == len(values) else None


@dataclass(frozen=True)
class Measured:
    """A finished scene with its measurements."""

    label: str  # In tables and plots, unique in a report
    source: str  # File or folder that was opened
    scene: str
    method: str
    variant: str
    keep_ratio: float | None
    seed: int | None  # None if the file does not record it
    steps: int
    primitives: int
    bytes_primitives: int
    bytes_head: int
    resolution: str  # Width x height, pixels
    configurations: tuple[Configuration, ...]  # With the head, if the scene has one, then without it
    ms_head: float | None = None  # Milliseconds of the head alone; 0 without a head
    precision: str = ""  # Arithmetic of the head; empty without one
    lpips_net: str = ""
    train_s: float | None = None
    prune_s: float | None = None
    peak_primitives: int | None = None
    peak_vram_mib: float | None = None
    gpu: str = ""  # Name of the GPU that rendered; empty for a CPU
    command: str = ""

    @property
    def bytes_total(self) -> int:
        """Bytes of Gaussians and head."""
        return self.bytes_primitives + self.bytes_head

    @property
    def full(self) -> Configuration:
        """The complete rendering: with the head, if the scene has one."""
        return self.configurations[0]

    @property
    def base(self) -> Configuration:
        """The rendering of base colours, without the head."""
        return self.configurations[-1]

    @property
    def has_head(self) -> bool:
        """Whether the scene has an enabled head."""
        return len(self.configurations) > 1

    def as_json(self) -> dict[str, Any]:
        """All measurements, including those of each view, as plain values for JSON."""
        plain = asdict(self)
        plain["bytes_total"] = self.bytes_total
        for configuration, entry in zip(self.configurations, plain["configurations"], strict=True):
            entry["mean"] = {metric.name: configuration.mean(metric.name) for metric in fields(ViewQuality)}
        return without_nan(plain)


def heads_of(runs: Sequence[Measured]) -> list[str]:
    """Column heads of the table of a report; LPIPS names the nets of the runs."""
    nets = sorted({run.lpips_net for run in runs if run.full.mean("lpips") is not None})
    heads = ["run", "rendered with", "Gaussians", "MB", "ms per frame", "PSNR, dB", "SSIM", "fitted, dB", "FLIP"]
    return [*heads, f"LPIPS ({', '.join(nets)})" if nets else "LPIPS"]


def rows_of(runs: Sequence[Measured]) -> list[list[str]]:
    """Cells of each configuration of the runs below :func:`heads_of`."""
    return [
        [
            run.label,
            configuration.name if run.has_head else "no head",
            number(run.primitives, 0),
            number(configuration.bytes / MEGABYTE, 2),
            number(configuration.ms, 2),
            *(number(configuration.mean(metric), digits) for metric, digits in METRICS),
        ]
        for run in runs
        for configuration in run.configurations
    ]


def markdown(scenes: Mapping[str, Sequence[Measured]], notes: Sequence[str]) -> str:
    """The table of each scene, and what was left out, as a Markdown page; names stay text."""
    heads = heads_of([run for runs in scenes.values() for run in runs])
    parts = []
    for scene, runs in scenes.items():
        rows = [[_plain(cell) for cell in row] for row in rows_of(runs)]
        parts.append(f"# {_plain(scene)}\n\n" + "\n".join(table(heads, rows)))
    return "\n\n".join([*parts, *(f"- Left out: {_plain(note)}" for note in notes)]) + "\n"


def _plain(text: str) -> str:
    """Text of one line in which Markdown and HTML mark nothing."""
    return re.sub(r"([\\`*\[\]|~])", r"\\\1", html.escape(" ".join(text.split()), quote=False))


def csv_text(runs: Sequence[Mapping[str, Any]]) -> str:
    """Runs of :meth:`Measured.as_json` as CSV; an empty cell means not measured."""
    buffer = StringIO()
    writer = csv.DictWriter(buffer, COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for run in runs:
        full, base = run["configurations"][0], run["configurations"][-1]
        cells = {"ms_frame": full["ms"], "ms_splat": base["ms"], **full["mean"]}
        cells |= {"psnr_base": base["mean"]["psnr"], "ssim_base": base["mean"]["ssim"]}
        cells["lpips_net"] = run["lpips_net"] if cells["lpips"] is not None else ""
        writer.writerow({**run, **cells})
    return buffer.getvalue()
