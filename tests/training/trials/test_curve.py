"""The curve of quality over the number of primitives, and what is chosen by it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import pytest

from sundae_ns.evaluation.count_curve import CurvePoint
from sundae_ns.training.trials.curve import (
    PSNR_WEIGHTS,
    SSIM_WEIGHTS,
    HeadGain,
    Tolerance,
    affordable,
    choose,
    curve_of,
    head_pays,
    is_lost,
    still_climbs,
    with_head,
)

COUNTS = (1000, 400, 200, 100)
Views = list[list[float]]


def point(count: int, psnr_loss: float = 0.0, ssim_loss: float = 0.0, error: float = 0.0, size: int = 0) -> CurvePoint:
    return CurvePoint(count, size or None, 30 - psnr_loss, 0.9 - ssim_loss, psnr_loss, ssim_loss, error, error / 30)


def trials(psnr: Sequence[float], ssim: Sequence[float], *, spread: Sequence[float] = (0.0, 0.0, 0.0)) -> list[Views]:
    """The measurement of each trial; each view differs from the mean by its spread, in every trial."""
    return [[[100.0, 0.0, s, p + offset] for offset in spread] for p, s in zip(psnr, ssim, strict=True)]


def test_losses_are_those_against_the_best_of_each_figure() -> None:
    found = curve_of([100] * 4, trials([30, 31, 30.5, 29], [0.9, 0.89, 0.88, 0.87]), [4, 3, 2, None])
    assert [one.bytes for one in found] == [4, 3, 2, None]
    assert [one.psnr_loss for one in found] == pytest.approx([PSNR_WEIGHTS[0] * loss for loss in (1, 0, 0.5, 2)])
    assert [one.ssim_loss for one in found] == pytest.approx([SSIM_WEIGHTS[0] * loss for loss in (0, 0.01, 0.02, 0.03)])
    assert found[1].psnr == pytest.approx(31)
    assert found[0].ssim == pytest.approx(0.9)


def test_each_halving_gains_more_after_the_trial() -> None:
    found = curve_of((400, 100), trials([30, 30], [0.9, 0.9]), [None, None])
    assert [one.count for one in found] == [400, 100]
    assert [one.psnr_loss for one in found] == pytest.approx([2 * PSNR_WEIGHTS[1], 0])
    assert [one.ssim_loss for one in found] == pytest.approx([2 * SSIM_WEIGHTS[1], 0])


def test_the_error_is_of_the_differences_between_counts_on_the_same_view() -> None:
    """Views differ by decibels from each other, but all counts alike."""
    alike = curve_of(COUNTS[:2], trials([30, 29], [0.9, 0.9], spread=(-5, 0, 5)), [None, None])
    assert alike[1].psnr_error == pytest.approx(0, abs=1e-9)
    unlike = trials([30, 29], [0.9, 0.9])
    for offset, view in zip((-0.3, 0, 0.3), unlike[1], strict=True):
        view[3] += offset
    found = curve_of(COUNTS[:2], unlike, [None, None])
    assert found[1].psnr_error == pytest.approx(PSNR_WEIGHTS[0] * 0.3 / math.sqrt(3))


def test_views_count_by_their_pixels() -> None:
    measured = trials([30, 30], [0.9, 0.9])
    measured[1][0][3] = 20.0
    for trial in measured:
        trial[0][0] = 1e-9
    assert curve_of([100, 100], measured, [None, None])[1].psnr_loss == pytest.approx(0, abs=1e-6)


def test_images_that_are_not_finite_lose_everything() -> None:
    measured = trials([30, 29], [0.9, 0.9])
    measured[0][0][3] = math.nan
    found = curve_of(COUNTS[:2], measured, [None, None])
    assert found[0].psnr_loss == math.inf
    assert found[1].psnr_loss == 0
    assert choose(found, Tolerance()) == COUNTS[1]


@pytest.mark.parametrize(
    ("losses", "chosen"),
    [
        ([(0, 0), (0.05, 0.001), (0.09, 0.002), (1.0, 0.03)], 200),  # all but the last are as good
        ([(0, 0), (0.3, 0), (0.6, 0), (1.0, 0)], 1000),
        ([(0.8, 0.03), (0.4, 0.01), (0, 0), (0.05, 0.001)], 100),  # large fields overfit
        ([(0, 0), (0, 0.02), (0, 0.04), (0, 0.06)], 1000),  # SSIM alone counts, too
        ([(0.5, 0), (0, 0.006), (0.5, 0.03), (1, 0.1)], 400),  # no count is best in both: the least that is lost
    ],
)
def test_the_fewest_primitives_that_are_as_good_as_the_best(losses: list[tuple[float, float]], chosen: int) -> None:
    curve = [point(count, *loss) for count, loss in zip(COUNTS, losses, strict=True)]
    found = choose(curve, Tolerance())
    smaller = max((count for count in COUNTS if count < chosen), default=0)
    assert smaller < found <= chosen
    if chosen in (100, 400):
        assert found == chosen


def test_between_two_counts_the_loss_is_interpolated() -> None:
    curve = [point(1000), point(400, 0.2)]
    assert choose(curve, Tolerance()) == round(math.sqrt(1000 * 400))
    assert choose(curve, Tolerance.of_drop(0.15)) < choose(curve, Tolerance())
    assert Tolerance.of_drop(0.2) == pytest.approx((0.2, 0.006))


def test_a_count_is_lost_only_beyond_doubt() -> None:
    assert is_lost(point(400, 0.9), Tolerance())
    assert not is_lost(point(400, 0.9, error=0.3), Tolerance())
    assert is_lost(point(400, 0, 0.02), Tolerance())


def test_a_head_gains_less_the_more_primitives_there_are() -> None:
    curve = [point(1000, size=9000), point(400, 0.1, 0.003), point(200, 0.5, 0.02), point(100, 1.5, 0.05)]
    curve.append(point(50, 3.0, 0.1, size=500))
    found = with_head(curve, HeadGain(100, 0.5, 0.02, features=200, head=70))
    assert [one.bytes for one in found] == [9000 + 2000 + 70, None, None, None, 500 + 100 + 70]
    assert with_head(curve, HeadGain(100, 0.5, 0.02))[0].bytes is None
    gained = [b.psnr - a.psnr for a, b in zip(curve, found, strict=True)]
    assert gained == pytest.approx([1.5 * share**0.4 for share in (0.1, 0.25, 0.5, 1, 1)])  # no less than was tried
    assert [b.ssim - a.ssim for a, b in zip(curve, found, strict=True)] == pytest.approx(
        [0.004, 0.01, 0.02, 0.04, 0.04]
    )
    assert min(one.psnr_loss for one in found) == min(one.ssim_loss for one in found) == 0
    for a, b in itertools.pairwise(found):
        assert b.psnr - a.psnr == pytest.approx(a.psnr_loss - b.psnr_loss)
    assert choose(found, Tolerance()) < choose(curve, Tolerance())


def test_a_head_must_be_worth_its_bytes_in_the_fields_that_would_be_kept() -> None:
    """0.4 dB for each doubling of the bytes of the scene without one, by what it gains among as many primitives."""
    curve = [point(1000, size=10_000), point(400, size=4000), point(200, 0.5, 0.02, size=2000)]
    kept, plain = choose(with_head(curve, HeadGain(100, 0.3, 0.01)), Tolerance()), choose(curve, Tolerance())
    assert 200 < kept < plain <= 400
    gained = 0.3 * (100 / kept) ** 0.4  # 0.17 to 0.23 dB

    def pays(features: int | None, psnr: float = 0.3, ssim: float = 0.01, ssim_db: float | None = 0.4) -> bool:
        return head_pays(curve, HeadGain(100, psnr, ssim, ssim_db, features, head=0), Tolerance())

    # Bytes of the features of 100 primitives; of the field these take 1,000.
    enough = round(1000 * (plain / kept * 2 ** (gained / 0.4) - 1))
    assert pays(enough - 20)
    assert not pays(enough + 20)
    assert pays(None)
    assert not pays(10, psnr=0.12)  # below the least gain of any head, 0.1 dB, in the field that is kept
    assert not pays(10, ssim_db=0.12)  # SSIM has to rise as much
    assert pays(10, ssim_db=None)  # images too small for it
    assert not pays(10, ssim=-0.001, ssim_db=-0.01)
    assert not pays(10, psnr=math.nan)
    assert not pays(10, ssim_db=math.nan)
    assert not pays(10, psnr=math.inf)


def test_a_head_that_lets_the_scene_shrink_needs_to_gain_little() -> None:
    """Where quality levels off at far fewer primitives with a head, the scene is smaller with one."""
    curve = [point(1000, size=10_000), point(400, 0.2, 0.006, size=4000), point(200, 0.8, 0.03, size=2000)]
    gain = HeadGain(100, 0.2, 0.02, 0.3, features=400, head=0)
    assert choose(with_head(curve, gain), Tolerance()) < 0.7 * choose(curve, Tolerance())
    assert head_pays(curve, gain, Tolerance())
    assert not head_pays(curve, gain._replace(features=4000), Tolerance())


def test_the_gain_of_a_head_in_ssim_is_in_decibels_of_its_distance_from_one() -> None:
    gain = HeadGain.of(10, (30.0, 0.9), (30.5, 0.95))
    assert (gain.psnr, gain.ssim, gain.ssim_db) == pytest.approx((0.5, 0.05, 10 * math.log10(2)))
    assert HeadGain.of(10, (30.0, 0.0), (30.5, 0.0)).ssim_db is None


def test_a_budget_in_bytes_is_a_count_between_the_tried_ones() -> None:
    curve = [point(1000, size=16000), point(500, size=8000), point(250, size=4000)]
    assert affordable(curve, 8000) == pytest.approx(500, abs=1)
    assert affordable(curve, 100) == pytest.approx(6, abs=1)
    assert affordable([point(1000)], 100) is None


def test_a_curve_that_still_climbs_asks_for_more_primitives() -> None:
    assert still_climbs([point(1000), point(400, 0.5)], Tolerance())
    assert not still_climbs([point(1000), point(400, 0.05)], Tolerance())
    assert not still_climbs([point(1000, 0.3), point(400, 0.5), point(200)], Tolerance())
