"""What was measured of one field: ways of rendering it, each with its own time and its own error."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from statistics import fmean
from typing import Any

from sundae_ns.evaluation.records import RunRow

HEAD_ON, HEAD_OFF = "head on", "head off"
MEGABYTE = 1e6
"""Bytes in the MB of tables and plots."""


@dataclass(frozen=True)
class ViewQuality:
    """One test view, rendered in one way; None is a metric that could not be taken."""

    psnr: float
    """dB."""
    ssim: float
    """pytorch_msssim's, valid window."""
    flip: float | None = None
    lpips: float | None = None


@dataclass(frozen=True)
class Configuration:
    """One way of rendering a field. ``ms`` and ``views`` are of the same calls with the same arguments."""

    name: str
    """``head on`` or ``head off``; a field without a head has the latter alone."""
    ms: float | None
    """Milliseconds a frame, device waited for: median over the test views; None if it was not timed."""
    bytes: int
    """All that it needs on disk, in fp32: without the head neither network nor features. Of a packed scene, the file."""
    views: tuple[ViewQuality, ...]
    """In the order of the test views."""

    def mean(self, metric: str) -> float | None:
        """Mean of a metric over the test views; None where it was not taken of all of them."""
        values = [getattr(view, metric) for view in self.views]
        known = [value for value in values if value is not None and not math.isnan(value)]
        return fmean(known) if known and len(known) == len(values) else None


@dataclass(frozen=True)
class Measured:
    """A finished field and everything that was measured of it."""

    label: str
    """What it is called in tables and plots; one of a kind in a report."""
    source: str
    """File or folder that it was read from."""
    scene: str
    method: str
    variant: str
    keep_ratio: float | None
    seed: int | None
    """None where the file does not say."""
    steps: int
    primitives: int
    bytes_primitives: int
    bytes_head: int
    resolution: str
    """Width x height, pixels."""
    configurations: tuple[Configuration, ...]
    """With the head first, where there is one."""
    ms_head: float | None = None
    """The head alone; 0 without one."""
    lpips_net: str = ""
    train_s: float | None = None
    prune_s: float | None = None
    peak_primitives: int | None = None
    peak_vram_mib: float | None = None
    gpu: str = ""
    """Device that rendered: its name; empty for a CPU."""
    commit: str = ""
    command: str = ""

    @property
    def bytes_total(self) -> int:
        """Everything that has to be stored."""
        return self.bytes_primitives + self.bytes_head

    @property
    def full(self) -> Configuration:
        """The whole picture: with the head, where there is one."""
        return self.configurations[0]

    @property
    def bare(self) -> Configuration:
        """Base colours alone."""
        return self.configurations[-1]

    @property
    def has_head(self) -> bool:
        """Whether a head takes part."""
        return len(self.configurations) > 1

    def row(self) -> RunRow:
        """The run as a row of ``runs.csv``: ``psnr`` beside ``ms_frame``, ``psnr_base`` beside ``ms_splat``."""
        lpips = self.full.mean("lpips")
        return RunRow(
            scene=self.scene,
            method=self.method,
            variant=self.variant,
            keep_ratio=self.keep_ratio,
            seed=self.seed,
            steps=self.steps,
            primitives=self.primitives,
            psnr=self.full.mean("psnr"),
            ssim=self.full.mean("ssim"),
            psnr_base=self.bare.mean("psnr"),
            ssim_base=self.bare.mean("ssim"),
            lpips=lpips,
            lpips_net=self.lpips_net if lpips is not None else "",
            bytes_primitives=self.bytes_primitives,
            bytes_head=self.bytes_head,
            bytes_total=self.bytes_total,
            ms_frame=self.full.ms,
            ms_splat=self.bare.ms,
            ms_head=self.ms_head,
            train_s=self.train_s,
            prune_s=self.prune_s,
            peak_primitives=self.peak_primitives,
            peak_vram_mib=self.peak_vram_mib,
            gpu=self.gpu,
            resolution=self.resolution,
            commit=self.commit,
            command=self.command,
        )

    def as_json(self) -> dict[str, Any]:
        """Everything, per-view figures included, as plain values; NaN becomes None, since JSON has none."""
        plain = asdict(self)
        plain["bytes_total"] = self.bytes_total
        for configuration, own in zip(self.configurations, plain["configurations"], strict=True):
            own["mean"] = {metric: configuration.mean(metric) for metric in ("psnr", "ssim", "flip", "lpips")}
        return without_nan(plain)


def without_nan(value: Any) -> Any:
    """Plain values as JSON can hold them: numbers that are not finite become None."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: without_nan(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_nan(inner) for inner in value]
    return value
