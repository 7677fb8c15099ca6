"""Exact counts, order, ties and frequencies of the selections."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from sundae_ns.errors import ConfigError, DataError
from sundae_ns.pruning import PruneRule, kept_count, select_random
from sundae_ns.pruning.selection import select_band, select_sampled, select_top

VALUES = st.one_of(st.floats(0, 1e30), st.sampled_from([0.0, 1.0, math.nan, math.inf, -math.inf, 1e-300]))
SCORES = st.lists(VALUES, min_size=1, max_size=40).map(lambda v: torch.tensor(v, dtype=torch.float64))


def chosen(mask: Tensor) -> list[int]:
    return mask.nonzero().squeeze(1).tolist()


@given(SCORES, st.floats(0, 1, exclude_min=True), st.floats(0, 1), st.integers(0, 2**31))
def test_any_scores_keep_the_exact_count(score: Tensor, keep_ratio: float, gamma: float, seed: int) -> None:
    count = kept_count(keep_ratio, len(score))
    assert count == max(1, round(keep_ratio * len(score)))
    for mask in (
        select_top(score, count),
        select_band(score, count, gamma),
        select_sampled(score, count, seed),
        select_random(len(score), count, seed),
    ):
        assert mask.dtype == torch.bool
        assert mask.shape == score.shape
        assert int(mask.sum()) == count


@given(SCORES, st.data())
def test_top_drops_nothing_above_what_it_keeps(score: Tensor, data: st.DataObject) -> None:
    count = data.draw(st.integers(1, len(score)))
    mask = select_top(score, count)
    known = torch.nan_to_num(score, nan=-math.inf, posinf=math.inf, neginf=-math.inf)
    if count < len(score):
        assert known[mask].min() >= known[~mask].max()
        assert not score[mask].isnan().any() or not (~score[~mask].isnan()).any()


def test_ties_go_to_the_lower_index() -> None:
    assert chosen(select_top(torch.tensor([1.0, 2, 2, 2, 0]), 2)) == [1, 2]
    # Many, because an unstable sort of few elements can be stable by chance.
    assert chosen(select_top(torch.arange(5000) % 3, 1500)) == list(range(2, 4500, 3))
    assert chosen(select_band(torch.zeros(6), 4, 0.5)) == [0, 1, 2, 3]
    assert chosen(select_band(torch.tensor([5.0, 1, 1, 1, 5]), 3, 1 / 3)) == [0, 1, 2]


def test_nan_comes_last_and_infinity_first() -> None:
    score = torch.tensor([math.nan, 1.0, math.inf, -math.inf, math.nan, 0.0])
    assert chosen(select_top(score, 1)) == [2]
    assert chosen(select_top(score, 4)) == [1, 2, 3, 5]
    assert chosen(select_top(score, 5)) == [0, 1, 2, 3, 5]


def test_band_takes_both_ends() -> None:
    magnitude = torch.tensor([3.0, 0, 9, 1, 8, 2, 7, 4])
    assert chosen(select_band(magnitude, 4, 0.5)) == [1, 2, 3, 4]
    assert chosen(select_band(magnitude, 4, 1.0)) == [2, 4, 6, 7]
    assert chosen(select_band(magnitude, 4, 0.0)) == [0, 1, 3, 5]
    assert chosen(select_band(magnitude, 4, 0.25)) == [1, 2, 3, 5]


def test_isolated_primitives_fill_neither_end_of_the_band() -> None:
    magnitude = torch.tensor([math.nan, 3.0, math.nan, 1.0, 2.0, 4.0])
    assert chosen(select_band(magnitude, 2, 0.5)) == [3, 5]
    assert chosen(select_band(magnitude, 4, 0.5)) == [1, 3, 4, 5]
    assert chosen(select_band(magnitude, 5, 0.0)) == [0, 1, 3, 4, 5]
    assert chosen(select_band(magnitude, 5, 1.0)) == [0, 1, 3, 4, 5]


@given(st.permutations(range(12)), st.integers(1, 12), st.floats(0, 1))
def test_band_is_the_two_ends_of_the_ranking(order: list[int], count: int, gamma: float) -> None:
    mask = select_band(torch.tensor(order, dtype=torch.float64), count, gamma)
    high = round(gamma * count)
    expected = set(range(12 - high, 12)) | set(range(count - high))
    assert {order[i] for i in chosen(mask)} == expected


def test_sampled_frequencies_are_in_proportion() -> None:
    score = torch.tensor([1.0, 2, 3, 4])
    first = torch.stack([select_sampled(score, 1, seed) for seed in range(4000)]).double().mean(0)
    torch.testing.assert_close(first, torch.tensor([0.1, 0.2, 0.3, 0.4]).double(), rtol=0, atol=0.03)
    pairs = torch.stack([select_sampled(score, 2, seed) for seed in range(4000)]).double().mean(0)
    p = score.double() / 10
    expected = torch.stack([p[i] + sum(p[j] * p[i] / (1 - p[j]) for j in range(4) if j != i) for i in range(4)])
    torch.testing.assert_close(pairs, expected, rtol=0, atol=0.03)


@pytest.mark.parametrize("scale", [1e-300, 1e-30, 1e300])
def test_sampling_does_not_depend_on_the_scale(scale: float) -> None:
    score = torch.rand(200, generator=torch.Generator().manual_seed(0), dtype=torch.float64) + 0.01
    assert torch.equal(select_sampled(score * scale, 50, 7), select_sampled(score, 50, 7))


def test_sampling_survives_scores_of_every_size() -> None:
    score = torch.logspace(-300, 300, 601, dtype=torch.float64)
    mask = select_sampled(score, 100, 0)
    assert min(chosen(mask)) > 490


def test_zero_scores_are_taken_only_after_positive_ones() -> None:
    score = torch.tensor([0.0, 1e-30, math.nan, 5.0, 0.0, -1.0, 0.0])
    assert chosen(select_sampled(score, 2, 0)) == [1, 3]
    extra = {tuple(set(chosen(select_sampled(score, 3, seed))) - {1, 3}) for seed in range(60)}
    assert extra == {(0,), (2,), (4,), (5,), (6,)}


def test_draws_depend_on_the_seed_and_not_on_the_global_generator() -> None:
    score = torch.rand(300, generator=torch.Generator().manual_seed(0))
    torch.manual_seed(1)
    first = select_sampled(score, 30, 5)
    torch.manual_seed(2)
    assert torch.equal(select_sampled(score, 30, 5), first)
    assert not torch.equal(select_sampled(score, 30, 6), first)
    assert torch.equal(select_random(300, 30, 5), select_random(300, 30, 5))


def test_draws_are_pinned() -> None:
    """Results with a seed stay reproducible from release to release."""
    assert chosen(select_random(20, 5, 0)) == [6, 7, 9, 11, 17]


@pytest.mark.parametrize("count", [0, 4, -1])
def test_impossible_counts_are_refused(count: int) -> None:
    with pytest.raises(DataError, match=f"cannot keep {count} of 3"):
        select_top(torch.ones(3), count)


def test_bad_options_are_refused() -> None:
    with pytest.raises(ConfigError, match="gamma"):
        PruneRule(gamma=1.5).validate()
    with pytest.raises(DataError, match="one number per primitive"):
        select_top(torch.ones(3, 2), 1)


@pytest.mark.gpu
def test_masks_are_the_same_on_every_device() -> None:
    score = torch.rand(1000, generator=torch.Generator().manual_seed(0))
    for select in (lambda s: select_top(s, 99), lambda s: select_band(s, 99, 0.4), lambda s: select_sampled(s, 99, 3)):
        assert select(score.cuda()).is_cuda
        assert torch.equal(select(score.cuda()).cpu(), select(score))
