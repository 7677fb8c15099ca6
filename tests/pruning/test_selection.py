"""Selections: the two ends of a ranking, and systematic draws with their inclusion probabilities."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sundae_ns.pruning import selection
from sundae_ns.pruning.rule import kept_count
from sundae_ns.pruning.selection import inclusion_probabilities, neighbor_order, select_band, select_systematic

VALUES = st.one_of(st.floats(), st.sampled_from([0.0, 1.0, math.nan, math.inf, -math.inf, 1e-300]))
SCORES = st.lists(VALUES, min_size=1, max_size=40).map(lambda v: torch.tensor(v, dtype=torch.float64))


@given(SCORES, st.floats(0, 1, exclude_min=True), st.floats(0, 1), st.integers(0, 2**31))
def test_any_scores_keep_the_exact_count_and_unusable_ones_come_last(score, keep_ratio, gamma, seed):
    count = kept_count(keep_ratio, len(score))
    assert count == max(1, round(keep_ratio * len(score)))
    assert int(select_band(score, count, gamma).sum()) == count
    mask = select_systematic(score, count, torch.randperm(len(score)), seed)
    assert (mask.dtype, mask.shape, int(mask.sum())) == (torch.bool, score.shape, count)
    for usable in (score == math.inf, score > 0):
        assert int((mask & usable).sum()) == min(count, int(usable.sum()))


@pytest.mark.parametrize(
    ("magnitude", "count", "gamma", "kept"),
    [
        ([3.0, 0, 9, 1, 8, 2, 7, 4], 4, 0.25, [1, 2, 3, 5]),
        # Isolated Gaussians fill neither end.
        ([math.nan, 3.0, math.nan, 1.0, 2.0, 4.0], 2, 0.5, [3, 5]),
        ([math.nan, 3.0, math.nan, 1.0, 2.0, 4.0], 4, 0.5, [1, 3, 4, 5]),
        ([math.nan, 3.0, math.nan, 1.0, 2.0, 4.0], 5, 0.0, [0, 1, 3, 4, 5]),
        ([math.nan, 3.0, math.nan, 1.0, 2.0, 4.0], 5, 1.0, [0, 1, 3, 4, 5]),
        # Ties go to the lower index; many, because an unstable sort of few elements can be stable by chance.
        ([0.0] * 6, 4, 0.5, [0, 1, 2, 3]),
        ([5.0, 1, 1, 1, 5], 3, 1 / 3, [0, 1, 2]),
        ([i % 3.0 for i in range(5000)], 1500, 1.0, list(range(2, 4500, 3))),
        ([1.0, math.inf, math.nan, 2.0, math.inf, 0.0], 3, 1 / 3, [0, 1, 5]),
        ([math.nan, 1.0, math.inf, -math.inf, math.nan, 0.0], 5, 1.0, [0, 1, 2, 3, 5]),
    ],
)
def test_band_by_hand(magnitude, count, gamma, kept):
    assert select_band(torch.tensor(magnitude), count, gamma).nonzero().flatten().tolist() == kept


def scores(n=500):
    return torch.rand(n, generator=torch.Generator().manual_seed(0), dtype=torch.float64).pow(3) + 1e-3


def test_probabilities_are_in_proportion_up_to_1_and_sum_to_the_count():
    values = scores()
    probabilities = inclusion_probabilities(values, 200)
    assert float(probabilities.sum()) == pytest.approx(200, abs=1e-9)
    certain = probabilities == 1
    assert 0 < int(certain.sum()) < 200
    assert values[certain].min() > values[~certain].max()
    ratio = probabilities[~certain] / values[~certain]
    torch.testing.assert_close(ratio, ratio[:1].expand_as(ratio))
    assert selection._systematic_sample(torch.tensor([0.0, 0.5, 0.5]).double(), 1, 0.0).tolist() == [1], "0 is never"
    # No Gaussian is certain without need.
    assert float(probabilities[~certain].max()) < 1


@pytest.mark.parametrize(
    ("values", "count", "expected"),
    [
        ([1.0, 1, 1, 1], 2, [0.5, 0.5, 0.5, 0.5]),
        ([1e300, 1e300, 1e-300], 2, [1, 1, 1e-300]),
        ([1e300, 1e-300, 1e-300], 2, [1, 0.5, 0.5]),
        ([5.0, 1, 1], 1, [5 / 7, 1 / 7, 1 / 7]),
        ([5.0, 1, 1], 2, [1, 0.5, 0.5]),
        ([3.0, 2, 1], 3, [1, 1, 1]),
        ([7.0], 1, [1]),
    ],
)
def test_probabilities_by_hand(values, count, expected):
    found = inclusion_probabilities(torch.tensor(values, dtype=torch.float64), count)
    torch.testing.assert_close(found, torch.tensor(expected, dtype=torch.float64))


def test_draw_frequencies_match_the_probabilities():
    values, order = scores(40), torch.randperm(40)
    drawn = torch.stack([select_systematic(values, 12, order, seed) for seed in range(1000)]).double().mean(dim=0)
    # Four standard deviations of a frequency over 1,000 draws are 0.063.
    torch.testing.assert_close(drawn, inclusion_probabilities(values, 12), rtol=0, atol=0.063)


def test_every_stretch_keeps_its_expected_number():
    values, order = scores(), torch.randperm(500)
    probabilities = inclusion_probabilities(values, 100)[order]
    for seed in range(20):
        # Certain Gaussians are selected first and count in full.
        gap = (select_systematic(values, 100, order, seed)[order].double() - probabilities).cumsum(0)
        assert float(gap.max() - gap.min()) < 2 + 1e-9  # between any two places


def test_the_order_walks_through_small_clusters_too():
    generator = torch.Generator().manual_seed(0)
    centers = torch.tensor([[0.0, 0, 0], [1e3, 0, 0], [0, 1e3, 0]])
    points = (centers[:, None] + 1e-2 * torch.rand(3, 512, 3, generator=generator)).reshape(-1, 3)
    order = neighbor_order(points)
    assert sorted(order.tolist()) == list(range(1536))
    steps = (points[order][1:] - points[order][:-1]).norm(dim=1)
    # Steps between the three clusters, and within the few leaves that hold points of two: measured 15.
    assert int((steps > 1).sum()) <= 32
    # Among 512 points in a cube of 1e-2, neighbours are about 7e-4 apart, and random pairs 6.6e-3.
    assert steps[steps < 1].mean() < 3.5e-3
