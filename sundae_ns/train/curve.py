"""The curve of expected quality over the number of Gaussians, as a run records it in ``trials.json``."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from sundae_ns.core.errors import CheckpointError, one_line, regular
from sundae_ns.core.tables import MEGABYTE, table

RECORD = "trials.json"  # in the folder of a run


@dataclass(frozen=True)
class CurvePoint:
    """What to expect of one number of Gaussians, on the held-out training views."""

    count: int  # Number of Gaussians
    bytes: int | None  # Estimated bytes of the packed scene, with a head if it pays; None if unknown
    psnr: float  # Expected PSNR after a fit of colours to each photo, dB; differences to other points are more certain
    ssim: float  # Expected SSIM
    psnr_loss: float  # PSNR that is lost against the best count for it, dB
    ssim_loss: float  # SSIM that is lost against the best count for it
    psnr_error: float  # Standard error of the loss over the views, dB
    ssim_error: float  # Standard error of the loss of SSIM over the views


@dataclass(frozen=True)
class CountCurve:
    """The record of a decision."""

    chosen: int  # Number of Gaussians that the run has kept
    full: int  # Their number before the prune
    reason: str  # Why this number was chosen
    points: tuple[CurvePoint, ...]  # What was tried, largest count first


def read_count_curve(folder: Path) -> CountCurve | None:
    """The record in a run's folder; None if trials have not decided about its number of Gaussians.

    ``CheckpointError`` if the record is damaged.
    """
    path = folder / RECORD
    try:
        if (record := json.loads(regular(path).read_text(encoding="utf-8")).get("count")) is None:
            return None
        points = [{entry.name: point[entry.name] for entry in fields(CurvePoint)} for point in record["curve"]]
        # Infinite losses are stored as null, and unknown bytes too.
        if odd := [x for point in points for x in point.values() if x is not None and type(x) not in (int, float)]:
            raise TypeError(f"{odd[0]!r} is no number")
        curve = tuple(CurvePoint(**point) for point in points)
        return CountCurve(int(record["chosen"]), int(record["full"]), str(record["reason"]), curve)
    except FileNotFoundError:
        return None
    except (OSError, ArithmeticError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise CheckpointError(f"{path} cannot be read ({one_line(error)}); remove it, or train again") from error


def expected_change(points: Sequence[CurvePoint], count: int, other: int) -> tuple[float, float] | None:
    """Change of PSNR (dB) and SSIM from one count to another, after training; None beyond the tried counts.

    Between two tried counts the losses are interpolated over the logarithm of the count.
    """
    known = sorted((point for point in points if math.isfinite(point.psnr_loss)), key=lambda point: point.count)
    if not known or not all(known[0].count <= end <= known[-1].count for end in (count, other)):
        return None
    counts, ends = [math.log(point.count) for point in known], [math.log(count), math.log(other)]
    psnr = np.interp(ends, counts, [point.psnr_loss for point in known])
    ssim = np.interp(ends, counts, [point.ssim_loss for point in known])
    return float(psnr[0] - psnr[1]), float(ssim[0] - ssim[1])


def curve_table(points: Sequence[CurvePoint]) -> list[str]:
    """Lines of a table of the points: count, packed size, and the expected figures with their losses."""
    rows = []
    for point in points:
        size = "" if point.bytes is None else f"{point.bytes / MEGABYTE:.2f}"
        psnr = _figures(point.psnr, point.psnr_loss, point.psnr_error, 2)
        rows.append([f"{point.count:,}", size, *psnr, *_figures(point.ssim, point.ssim_loss, point.ssim_error, 4)])
    return table(["Gaussians", "packed, MB", "PSNR, dB", "below the best", "SSIM", "below the best"], rows, words=0)


def _figures(value: float, loss: float, error: float, digits: int) -> list[str]:
    if not math.isfinite(loss):
        return ["", "not finite"]
    return [f"{value:.{digits}f}", f"{loss:.{digits}f} ± {error:.{digits}f}"]
