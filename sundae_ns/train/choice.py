"""The choice among candidates (count x head x length) by held-out training views.

A trial is far shorter than the training that follows, so its images do not show what that training reaches. Expected
quality over the number of Gaussians is a weighted sum of two numbers. One is the quality at the end of the trial: after
it, the counts differ by less. The other is the logarithm of the count: after the trial, smaller fields gain more. The
weights were fitted to trainings of six captures at up to six counts each. A head gains more by the end of the training
than in its trial, and it gains less in larger fields. How much was fitted to two captures (``docs/decisions.md``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sundae_ns.train.curve import CurvePoint

HEADS = ("plain", "head", "features")  # In the order of their trials: none, as configured, with more features
PSNR_WEIGHTS, SSIM_WEIGHTS = (0.75, 0.1), (0.75, 0.003)
"""Weight of PSNR (SSIM) at the end of a trial, and dB (SSIM) that each halving of the count gains after it."""
HEAD_PSNR, HEAD_SSIM = (3.0, 0.4), (2.0, 1.0)
"""Gain of a head at the end as a multiple of that in its trial, and the power of the count by which it falls."""
LOST = 4.0  # times the tolerance, beyond two standard errors: such a count is clearly too small
LEAST_GAIN = 0.1  # PSNR that a larger scene must gain, dB: two runs of one seed differ by as much
GAIN_PER_DOUBLING = 0.4
"""PSNR that a larger scene must gain for each doubling of the stored bytes, dB. Twice as many Gaussians gain about
twice this at the end of a run, and a trial shows a part of a gain."""
LEAST_LOSS = 0.005  # Growth of the loss over the best measurement, as a share, from which on more training harms

HELD_OUT_EVERY, MOST_HELD_OUT = 8, 16  # Every 8th training view; at most 16
FEW_VIEWS = 12  # With fewer training views, two are held out in turn, for trials of half the length
HEAD_STEPS = 1200  # Length of a trial of a head within the shares below: shorter ones show too little
LEAST_TRIAL, MOST_TRIAL = 0.04, 0.05
"""Shortest and longest trial of a head as shares of the schedule. All but the chosen one's cost at most a tenth."""


class HeldOutQuality(NamedTuple):
    """Quality of the image of one held-out view. The figures are NaN or infinite if the image is not finite."""

    pixels: int  # Number of pixels that count: those under the mask
    psnr: float  # PSNR of these pixels, dB
    ssim: float  # SSIM of these pixels; 0 for an image that is smaller than the window of SSIM
    fitted: float = math.nan  # PSNR after the affine map of colours that fits the photo best, dB; NaN if not asked for


@dataclass
class Tried:
    """A candidate after its trial; plain values, for checkpoints."""

    stage: str  # What it was tried for: count, tenth (a head on a tenth of the Gaussians), head, or length
    count: int  # Gaussians
    head: str  # One of HEADS
    length: int  # Training steps of the trial
    views: list[list[float]] = field(default_factory=list)
    """For each held-out view the values of a :class:`HeldOutQuality`; empty if masks leave no pixel."""
    bytes: list[int] | None = None  # Of the Gaussians, with their features, and of the head; None if they do not pack

    @property
    def qualities(self) -> list[HeldOutQuality]:
        """The measurements."""
        return [HeldOutQuality(int(pixels), *figures) for pixels, *figures in self.views]


def mean_quality(views: Sequence[HeldOutQuality]) -> tuple[float, float]:
    """PSNR (dB) and SSIM, each the mean over views weighted by the pixels that count; NaN without any."""
    total = sum(view.pixels for view in views) or math.nan
    decibels = sum(view.pixels * view.psnr for view in views) / total
    return decibels, sum(view.pixels * view.ssim for view in views) / total


def spread_cameras(indices: Sequence[int], count: int, half: int) -> list[int]:
    """``count`` indices evenly over a capture, as neighbours look alike; those of half 0 and 1 share none."""
    return [indices[(2 * i + half) * len(indices) // (2 * count)] for i in range(count)]


def plan_heads(indices: Sequence[int], steps: int) -> tuple[list[list[int]], int]:
    """Folds of held-out views among at least two, each for a trial of every head, and the steps of such a trial."""
    few = len(indices) < FEW_VIEWS
    chosen = spread_cameras(indices, 2 if few else max(2, min(MOST_HELD_OUT, len(indices) // HELD_OUT_EVERY)), 1)
    length = LEAST_TRIAL * steps / 2 if few else max(LEAST_TRIAL * steps, min(HEAD_STEPS, MOST_TRIAL * steps))
    return [[index] for index in chosen] if few else [chosen], max(round(length), 1)


def least_gain(doublings: float) -> float:
    """PSNR that a scene must gain for this number of doublings of its bytes, dB."""
    return max(LEAST_GAIN, GAIN_PER_DOUBLING * doublings)


def is_enough(gained: float, least: float, doublings: float) -> bool:
    """Whether a gain (dB) pays for doublings of the bytes and the least of all gains is no loss; not if not finite."""
    return math.inf > gained >= least_gain(doublings) and least >= 0


def best_head(tried: Sequence[Tried], folds: int) -> str:
    """The largest head that gains enough over the best smaller one, by PSNR and SSIM in the mean, and loses neither.

    ``tried`` has a row for each head and fold, heads in their order; a head whose folds have not all ended is left out.
    """
    best: Tried | None = None
    for first in range(0, len(tried) - folds + 1, folds):
        rows = tried[first : first + folds]
        row = replace(rows[0], views=[view for each in rows for view in each.views])
        if best is not None:
            gain = HeadGain.of(best, row)
            doublings = math.log2(sum(row.bytes or [1]) / sum(best.bytes or [1]))
            gained = gain.psnr if gain.ssim_db is None else (gain.psnr + gain.ssim_db) / 2
            if not is_enough(gained, min(gain.psnr, gain.ssim), doublings):
                continue
        best = row
    return best.head if best else "plain"


class HeadGain(NamedTuple):
    """What a head has gained in its trials."""

    num_gaussians: int  # In the trials
    psnr: float  # dB
    ssim: float
    ssim_db: float | None = None  # By how much 1 - SSIM has fallen, dB; None where images are too small for SSIM
    features: int | None = None  # Estimated bytes of the features of these Gaussians in a packed scene; None if unknown
    head: int = 0  # Bytes of the packed head

    @classmethod
    def of(cls, plain: Tried, head: Tried) -> HeadGain:
        """The gain between two trials that differ by the head."""
        (psnr, ssim), (better, closer) = (mean_quality(row.qualities) for row in (plain, head))
        rise = 10 * math.log10((1 - ssim) / (1 - closer)) if ssim != closer and max(ssim, closer) < 1 else None
        sizes = (head.bytes[0] - plain.bytes[0], head.bytes[1]) if plain.bytes and head.bytes else ()
        return cls(plain.count, better - psnr, closer - ssim, rise, *sizes)

    def falls_by(self, count: int, power: float) -> float:
        """Factor of the gain at another count; below that of the trials it is not known to rise."""
        return (self.num_gaussians / max(count, self.num_gaussians)) ** power

    def bytes_of(self, count: int) -> int | None:
        """Estimated bytes of features and head with this number of Gaussians; None if unknown."""
        return None if self.features is None else round(self.features * count / self.num_gaussians) + self.head


def head_pays(curve: Sequence[CurvePoint], gain: HeadGain, tolerance: Tolerance) -> bool:
    """Whether a head gains enough for its bytes in a packed scene, in PSNR and in SSIM.

    Both scenes are compared as they would be kept: with a head quality levels off at fewer Gaussians, so the scene may
    take fewer bytes in all. Gains count at the count that is kept with the head. The curve is without one.
    """
    kept, without = choose(with_head(curve, gain), tolerance), choose(curve, tolerance)
    ours, theirs = _bytes_at(curve, kept), _bytes_at(curve, without)
    added = gain.bytes_of(kept)
    doublings = math.log2((ours + added) / theirs) if ours and theirs and added is not None else 0.0
    falls, gains = gain.falls_by(kept, HEAD_PSNR[1]), (gain.psnr, gain.ssim_db)
    return all(is_enough(gained * falls, gain.ssim, doublings) for gained in gains if gained is not None)


def _bytes_at(curve: Sequence[CurvePoint], count: int) -> float | None:
    """Estimated bytes of a packed field without a head, from the nearest count of a curve."""
    near = min(curve, key=lambda point: abs(math.log(point.count / count)))
    return near.bytes and near.bytes * count / near.count


class Tolerance(NamedTuple):
    """What a smaller field may lose against the best one."""

    psnr: float = 0.1  # dB
    ssim: float = 0.003

    @classmethod
    def of_drop(cls, psnr: float | None) -> Tolerance:
        """The tolerance for a drop of PSNR in dB, SSIM in proportion; the usual one for None."""
        return cls() if psnr is None else cls(psnr, psnr * cls().ssim / cls().psnr)


def curve_of(tried: Sequence[Tried]) -> list[CurvePoint]:
    """The curve of trials of counts, largest count first, measured with a fitted PSNR.

    Losses of a trial whose images are not finite are infinite. There are no points if masks leave no pixel.
    """
    if not tried or not tried[0].views:
        return []
    counts = [row.count for row in tried]
    values = np.asarray([row.views for row in tried])  # [T, V, 4]
    pixels = values[0, :, 0] / values[0, :, 0].sum()
    halvings = -np.log2(np.asarray(counts, dtype=np.float64))[:, None]
    columns = []
    for index, weights in ((3, PSNR_WEIGHTS), (2, SSIM_WEIGHTS)):
        end = values[:, :, index]
        expected = weights[0] * end + weights[1] * halvings  # [T, V], up to a constant of the capture
        best = int(np.where(np.isfinite(expected).all(1), expected @ pixels, -np.inf).argmax())
        losses, errors = zip(*(_paired(expected[best] - row, pixels) for row in expected), strict=True)
        columns.append(([float(end[best] @ pixels) - loss for loss in losses], losses, errors))
    (psnr, psnr_loss, psnr_error), (ssim, ssim_loss, ssim_error) = columns
    sizes = [row.bytes[0] if row.bytes else None for row in tried]
    rows = zip(counts, sizes, psnr, ssim, psnr_loss, ssim_loss, psnr_error, ssim_error, strict=True)
    return [CurvePoint(*row) for row in rows]


def _paired(differences: NDArray[np.float64], pixels: NDArray[np.float64]) -> tuple[float, float]:
    """Weighted mean of the differences over views, and its standard error; an infinite loss if one is not finite."""
    if not np.isfinite(differences).all():
        return math.inf, 0.0
    mean, views = float(differences @ pixels), len(differences)
    return mean, math.sqrt(float((pixels**2) @ (differences - mean) ** 2) * views / max(views - 1, 1))


def with_head(curve: Sequence[CurvePoint], gain: HeadGain) -> list[CurvePoint]:
    """The curve of a field with a head, from one without."""
    points = []
    for point in curve:
        psnr = HEAD_PSNR[0] * gain.psnr * gain.falls_by(point.count, HEAD_PSNR[1])
        ssim = HEAD_SSIM[0] * gain.ssim * gain.falls_by(point.count, HEAD_SSIM[1])
        added = gain.bytes_of(point.count)
        size = None if point.bytes is None or added is None else point.bytes + added
        point = replace(point, bytes=size, psnr=point.psnr + psnr, ssim=point.ssim + ssim)
        points.append(replace(point, psnr_loss=point.psnr_loss - psnr, ssim_loss=point.ssim_loss - ssim))
    psnr, ssim = min(point.psnr_loss for point in points), min(point.ssim_loss for point in points)
    return [replace(point, psnr_loss=point.psnr_loss - psnr, ssim_loss=point.ssim_loss - ssim) for point in points]


def is_lost(point: CurvePoint, tolerance: Tolerance) -> bool:
    """Whether the count is clearly too small, so that fewer need not be tried."""
    psnr = point.psnr_loss - 2 * point.psnr_error > LOST * tolerance.psnr
    return psnr or point.ssim_loss - 2 * point.ssim_error > LOST * tolerance.ssim


def choose(curve: Sequence[CurvePoint], tolerance: Tolerance) -> int:
    """The smallest count that is as good as the best one in PSNR and SSIM, from a curve with the largest count first.

    Between the smallest tried count that is and the next smaller one, the loss is interpolated over the logarithm of
    the count. If PSNR and SSIM ask for different counts, the one that loses least, in tolerances, is taken.
    """
    # The larger of both losses in units of its tolerance; at most 1 is as good as the best.
    over = [max(point.psnr_loss / tolerance.psnr, point.ssim_loss / tolerance.ssim) for point in curve]
    if not (good := [index for index, value in enumerate(over) if value <= 1]):
        return curve[over.index(min(over))].count
    index = good[-1]
    if index + 1 == len(curve) or not math.isfinite(over[index + 1]):
        return curve[index].count
    share = (1 - over[index]) / (over[index + 1] - over[index])
    large, small = (math.log(point.count) for point in curve[index : index + 2])
    return round(math.exp(large + share * (small - large)))


def choose_within(
    curve: Sequence[CurvePoint], tolerance: Tolerance, *, most: int | None, most_bytes: int | None
) -> tuple[int, str]:
    """The count by :func:`choose` within a number of Gaussians and of bytes of the packed scene, and why."""
    count = choose(curve, tolerance)
    reason = "the fewest that are as good as the best"
    fitting = None if most_bytes is None else affordable(curve, most_bytes)
    for name, limit in (("max-gaussians", most), ("max-bytes", fitting)):
        if limit is not None and limit < count:
            count, reason = limit, f"the most that pruning.{name} allows"
    return count, reason


def affordable(curve: Sequence[CurvePoint], most: int) -> int | None:
    """Largest count whose packed field fits into ``most`` bytes, by the estimates; None if no size is known."""
    if not (sizes := {math.log(point.count): math.log(point.bytes) for point in curve if point.bytes}):
        return None
    x, y = [*sizes], [*sizes.values()]
    slope, start = np.polyfit(x, y, 1) if len(sizes) > 1 else (1.0, y[0] - x[0])
    return max(int(math.exp((math.log(max(most, 1)) - start) / max(slope, 0.1))), 1)


def loss_of(views: Sequence[HeldOutQuality], ssim_weight: float) -> float:
    """The loss of training after the prune: root of the mean squared error, and SSIM, which rises for longer."""
    psnr, ssim = mean_quality(views)
    return float((1 - ssim_weight) * 10 ** (-psnr / 20) + ssim_weight * (1 - ssim))


def best_length(losses: Sequence[float]) -> tuple[int, bool]:
    """Windows of training after which the loss was least, and whether it has grown by enough since to stop.

    There is at least one loss, of the held-out views after each window; NaN if they could not be measured.
    """
    known = [math.inf if math.isnan(loss) else loss for loss in losses]
    best = known.index(min(known))
    return best + 1, bool(losses[-1] >= (1 + LEAST_LOSS) * losses[best])
