"""The measurements of one field: each configuration of rendering it has its own time and its own error."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields
from statistics import fmean
from typing import Any

HEAD_ON, HEAD_OFF = "head on", "head off"
MEGABYTE = 1e6
"""Bytes in the MB of tables and plots."""


@dataclass(frozen=True)
class ViewQuality:
    """Metrics of one test view; None is a metric that was not measured."""

    psnr: float
    """dB."""
    ssim: float
    """pytorch_msssim's variant, without padding; NaN for images smaller than its window."""
    flip: float | None = None
    lpips: float | None = None
    psnr_fitted: float | None = None
    """dB, after the affine map of colours that fits best (:func:`sundae_ns.evaluation.metrics.fitted_psnr`)."""
    jod: float | None = None
    """Visibility of the difference, 10 for none (:func:`sundae_ns.evaluation.jod.jod`)."""


@dataclass(frozen=True)
class Configuration:
    """One configuration of rendering a field. ``ms`` and ``views`` come from the same calls with the same arguments."""

    name: str
    """``head on`` or ``head off``; a field without a head has only the latter."""
    ms: float | None
    """Synchronised milliseconds per frame, median over the test views; None if not timed."""
    bytes: int
    """Bytes on disk in fp32 that this configuration needs: without the head, neither network nor features. For a packed
    scene, the size of the file."""
    views: tuple[ViewQuality, ...]
    """Metrics by test view, in the order of the views."""

    def mean(self, metric: str) -> float | None:
        """Mean of a metric over the test views; None unless every view has it."""
        values = [getattr(view, metric) for view in self.views]
        known = [value for value in values if value is not None and not math.isnan(value)]
        return fmean(known) if known and len(known) == len(values) else None


@dataclass(frozen=True)
class Measured:
    """A finished field with its measurements."""

    label: str
    """Name in tables and plots, unique in a report."""
    source: str
    """The file or folder that was opened."""
    scene: str
    method: str
    variant: str
    keep_ratio: float | None
    seed: int | None
    """None if the file does not record it."""
    steps: int
    primitives: int
    bytes_primitives: int
    bytes_head: int
    resolution: str
    """Width x height, pixels."""
    configurations: tuple[Configuration, ...]
    """With the head, if the field has one, then without it."""
    ms_head: float | None = None
    """Milliseconds of the head alone; 0 without a head."""
    precision: str = ""
    """Arithmetic of the head; empty without one."""
    lpips_net: str = ""
    train_s: float | None = None
    prune_s: float | None = None
    peak_primitives: int | None = None
    peak_vram_mib: float | None = None
    gpu: str = ""
    """Name of the GPU that rendered; empty for a CPU."""
    fingerprint: str = ""
    """Stands for the options of the run; empty if they are unknown."""
    command: str = ""

    @property
    def bytes_total(self) -> int:
        """Bytes of primitives and head."""
        return self.bytes_primitives + self.bytes_head

    @property
    def full(self) -> Configuration:
        """The complete rendering: with the head, if the field has one."""
        return self.configurations[0]

    @property
    def base(self) -> Configuration:
        """The rendering of base colours, without the head."""
        return self.configurations[-1]

    @property
    def has_head(self) -> bool:
        """Whether the field has an enabled head."""
        return len(self.configurations) > 1

    def as_json(self) -> dict[str, Any]:
        """All measurements, including those of each view, as plain values for JSON."""
        plain = asdict(self)
        plain["bytes_total"] = self.bytes_total
        for configuration, entry in zip(self.configurations, plain["configurations"], strict=True):
            entry["mean"] = {metric.name: configuration.mean(metric.name) for metric in fields(ViewQuality)}
        return without_nan(plain)


def without_nan(value: Any) -> Any:
    """Plain values for JSON: numbers that are not finite become None."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: without_nan(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_nan(inner) for inner in value]
    return value
