"""Expected quality as a function of the number of primitives, and the choice of a number by it.

A trial is far shorter than the training that follows, so its images do not show what that training reaches. The
expected quality is a weighted sum of two numbers. One is the quality at the end of the trial: after it, the counts
differ by less. The other is the logarithm of the count: after the trial, smaller fields gain more. The weights were
fitted to trainings of six captures at up to six counts each. A head gains more by the end of the training than in its
trial, and it gains less in larger fields. How much was fitted to trainings of two captures (``docs/decisions.md``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sundae_ns.evaluation.count_curve import CurvePoint
from sundae_ns.training.trials.head import is_enough

PSNR_WEIGHTS = (0.75, 0.1)
"""Weight of the PSNR at the end of a trial, and dB that each halving of the count gains after it."""
SSIM_WEIGHTS = (0.75, 0.003)
"""The same for SSIM."""
HEAD_PSNR = (3.0, 0.4)
"""Gain of a head at the end as a multiple of that in its trial, and the power of the count by which it falls."""
HEAD_SSIM = (2.0, 1.0)
"""The same for SSIM."""
LOST = 4.0
"""A count that loses this many times the tolerance, beyond two standard errors, is clearly too small."""


class Tolerance(NamedTuple):
    """What a smaller field may lose against the best one."""

    psnr: float = 0.1
    """dB."""
    ssim: float = 0.003
    """On the scale of SSIM."""

    @classmethod
    def of_drop(cls, psnr: float | None) -> Tolerance:
        """The tolerance for a drop of PSNR in dB, SSIM in proportion; the usual one for None."""
        return cls() if psnr is None else cls(psnr, psnr * cls().ssim / cls().psnr)


class HeadGain(NamedTuple):
    """What trials of a head have shown."""

    primitives: int
    """Number of primitives in these trials."""
    psnr: float
    """What the head has gained, dB."""
    ssim: float
    """The same for SSIM."""
    ssim_db: float | None = None
    """By how much 1 - SSIM has fallen, dB; None where images are too small for SSIM."""
    features: int | None = None
    """Estimated bytes of the features of these primitives in a packed scene; None if unknown."""
    head: int = 0
    """Bytes of the packed head."""

    @classmethod
    def of(cls, primitives: int, plain: tuple[float, float], head: tuple[float, float]) -> HeadGain:
        """What trials with ``primitives`` have shown that ended with these PSNRs (dB) and SSIMs."""
        (psnr, ssim), (better, closer) = plain, head
        seen = ssim != closer and max(ssim, closer) < 1
        rise = 10 * math.log10((1 - ssim) / (1 - closer)) if seen else None
        return cls(primitives, better - psnr, closer - ssim, rise)

    def falls_by(self, count: int, power: float) -> float:
        """Factor of the gain at another count. Fewer primitives than in the trials were not tried with a head."""
        return (self.primitives / max(count, self.primitives)) ** power

    def bytes_of(self, count: int) -> int | None:
        """Estimated bytes of features and head with this number of primitives; None if unknown."""
        return None if self.features is None else round(self.features * count / self.primitives) + self.head


def excess(point: CurvePoint, tolerance: Tolerance) -> float:
    """The larger of both losses in units of its tolerance; at most 1 is as good as the best."""
    return max(point.psnr_loss / tolerance.psnr, point.ssim_loss / tolerance.ssim)


def is_lost(point: CurvePoint, tolerance: Tolerance) -> bool:
    """Whether the count is clearly too small, so that fewer need not be tried."""
    psnr = point.psnr_loss - 2 * point.psnr_error > LOST * tolerance.psnr
    return psnr or point.ssim_loss - 2 * point.ssim_error > LOST * tolerance.ssim


def curve_of(
    counts: Sequence[int], measured: Sequence[Sequence[Sequence[float]]], sizes: Sequence[int | None]
) -> list[CurvePoint]:
    """The curve of some trials, largest count first.

    Args:
        counts: number of primitives of each trial.
        measured: for each trial and view the values of a :class:`sundae_ns.training.heldout.HeldOutQuality`, with a
            fitted PSNR.
        sizes: estimated bytes of each packed field.

    Returns:
        A point for each trial; losses of a trial whose images are not finite are infinite.
    """
    values = np.asarray(measured, dtype=np.float64)  # [T, V, 4]
    pixels = values[0, :, 0] / values[0, :, 0].sum()
    halvings = -np.log2(np.asarray(counts, dtype=np.float64))[:, None]
    columns = []
    for index, (weight, later) in ((3, PSNR_WEIGHTS), (2, SSIM_WEIGHTS)):
        end = values[:, :, index]
        expected = weight * end + later * halvings  # [T, V], up to a constant of the capture
        means = np.where(np.isfinite(expected).all(1), expected @ pixels, -np.inf)
        best = int(means.argmax())
        losses, errors = zip(*(_paired(expected[best] - one, pixels) for one in expected), strict=True)
        columns.append(([float(end[best] @ pixels) - loss for loss in losses], losses, errors))
    (psnr, psnr_loss, psnr_error), (ssim, ssim_loss, ssim_error) = columns
    rows = zip(counts, sizes, psnr, ssim, psnr_loss, ssim_loss, psnr_error, ssim_error, strict=True)
    return [CurvePoint(*row) for row in rows]


def with_head(curve: Sequence[CurvePoint], gain: HeadGain) -> list[CurvePoint]:
    """The curve of a field with a head, from one without."""
    found = []
    for point in curve:
        psnr, ssim = (
            factor * gained * gain.falls_by(point.count, power)
            for gained, (factor, power) in ((gain.psnr, HEAD_PSNR), (gain.ssim, HEAD_SSIM))
        )
        added = gain.bytes_of(point.count)
        size = None if point.bytes is None or added is None else point.bytes + added
        point = replace(point, bytes=size, psnr=point.psnr + psnr, ssim=point.ssim + ssim)
        found.append(replace(point, psnr_loss=point.psnr_loss - psnr, ssim_loss=point.ssim_loss - ssim))
    psnr, ssim = min(point.psnr_loss for point in found), min(point.ssim_loss for point in found)
    return [replace(one, psnr_loss=one.psnr_loss - psnr, ssim_loss=one.ssim_loss - ssim) for one in found]


def head_pays(curve: Sequence[CurvePoint], gain: HeadGain, tolerance: Tolerance) -> bool:
    """Whether a head gains enough for its bytes in a packed scene, in PSNR and in SSIM.

    Both scenes are compared as they would be kept: with a head quality levels off at fewer primitives, so the scene may
    take fewer bytes in all. Gains count at the count that is kept with the head, since in a larger field it gains less.

    Args:
        curve: of the field without a head.
        gain: what its trials have shown.
        tolerance: by which the counts are chosen.
    """
    with_one, without = choose(with_head(curve, gain), tolerance), choose(curve, tolerance)
    added, doublings = gain.bytes_of(with_one), 0.0
    ours, theirs = _bytes_at(curve, with_one), _bytes_at(curve, without)
    if ours and theirs and added is not None:
        doublings = math.log2((ours + added) / theirs)
    falls = gain.falls_by(with_one, HEAD_PSNR[1])
    gains = [one * falls for one in (gain.psnr, gain.ssim_db) if one is not None]
    return all(is_enough(one, gain.ssim, doublings) for one in gains)


def _bytes_at(curve: Sequence[CurvePoint], count: int) -> float | None:
    """Estimated bytes of a packed field without a head, from the nearest count of a curve."""
    near = min(curve, key=lambda point: abs(math.log(point.count / count)))
    return near.bytes and near.bytes * count / near.count


def _paired(differences: NDArray[np.float64], pixels: NDArray[np.float64]) -> tuple[float, float]:
    """Weighted mean of the differences over views, and its standard error; an infinite loss if one is not finite."""
    if not np.isfinite(differences).all():
        return math.inf, 0.0
    mean, views = float(differences @ pixels), len(differences)
    if views < 2:
        return mean, 0.0
    squares = float((pixels**2) @ (differences - mean) ** 2)
    return mean, math.sqrt(squares * views / (views - 1))


def choose(curve: Sequence[CurvePoint], tolerance: Tolerance) -> int:
    """The smallest count that is as good as the best one in PSNR and SSIM.

    Between the smallest tried count that is and the next smaller one, the loss is interpolated over the logarithm of
    the count. If PSNR and SSIM ask for different counts, the one that loses least, in tolerances, is taken.

    Args:
        curve: largest count first.
        tolerance: losses that nobody sees.
    """
    over = [excess(point, tolerance) for point in curve]
    good = [index for index, value in enumerate(over) if value <= 1]
    if not good:
        return curve[over.index(min(over))].count
    index = good[-1]
    if index + 1 == len(curve) or not math.isfinite(over[index + 1]):
        return curve[index].count
    part = (1 - over[index]) / (over[index + 1] - over[index])
    large, small = (math.log(point.count) for point in curve[index : index + 2])
    return round(math.exp(large + part * (small - large)))


def affordable(curve: Sequence[CurvePoint], most: int) -> int | None:
    """Largest count whose packed field fits into a number of bytes, by the estimates; None if no size is known.

    Args:
        curve: the points.
        most: bytes.
    """
    known = [(math.log(point.count), math.log(point.bytes)) for point in curve if point.bytes]
    if not known:
        return None
    rest = max(most, 1)
    if len(known) == 1:
        return max(int(math.exp(known[0][0]) * rest / math.exp(known[0][1])), 1)
    x, y = (np.array(column) for column in zip(*known, strict=True))
    slope, start = np.polyfit(x, y, 1)
    return max(int(math.exp((math.log(rest) - start) / max(slope, 0.1))), 1)


def still_climbs(curve: Sequence[CurvePoint], tolerance: Tolerance) -> bool:
    """Whether the largest count is the best and the next smaller one clearly worse: more primitives might help."""
    return len(curve) > 1 and excess(curve[0], tolerance) <= 0 and excess(curve[1], tolerance) > 1
