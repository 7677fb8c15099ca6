"""The decision on hard fields: exact counts, invariances and finite values."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from prunes import decide_share
from torch import Tensor

from sundae_ns.errors import ConfigError, DataError
from sundae_ns.gaussians import mend
from sundae_ns.gaussians.covariance import covariances, quaternions, rotation_matrices
from sundae_ns.pruning import Decision, PruneRule, field_graph, kept_count, response
from sundae_ns.pruning.redistribution import voronoi_labels
from sundae_ns.pruning.selection import select_band, select_sampled, select_top

SHARE = 0.2
DEFAULT = PruneRule()
PLAIN = replace(DEFAULT, selection="sampled", score="response-contribution", edges="centres", redistribution="none")
"""Response times contribution and independent draws, without the additions of the default rule."""
PAPER = replace(PLAIN, selection="band", score="response", signal="positions")
RULES = {
    "band": PAPER,
    "band of attributes": replace(PAPER, signal="attributes"),
    "top": replace(PAPER, selection="top"),
    "sampled": replace(PLAIN, score="response"),
    "sampled with contribution": PLAIN,
    "systematic": replace(PLAIN, selection="systematic"),
    "default": DEFAULT,
    "merge into the top": replace(DEFAULT, selection="top", score="response"),
}
SPREAD_IN_SPACE = ("systematic", "default")
"""Rules that draw along an order that depends on the axes, and so on the rotation of the field."""


def field(means: Tensor, seed: int = 0) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    shapes = {"scales": (3,), "quats": (4,), "features_dc": (3,), "features_rest": (3, 3), "opacities": (1,)}
    n, dtype = len(means), means.dtype
    other = {name: torch.randn(n, *shape, generator=generator).to(dtype) for name, shape in shapes.items()}
    return {"means": means, **other}


def cloud(n: int = 600, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.randn(n, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(dtype)


def decided(params: dict[str, Tensor], config: PruneRule, share: float = SHARE) -> Decision:
    n = len(params["means"])
    contribution = torch.linspace(0.1, 1, n)
    decision = decide_share(params, config, share, contribution)
    assert int(decision.mask.sum()) == decision.kept == kept_count(share, n)
    again = decide_share(params, config, share, contribution)
    assert torch.equal(again.mask, decision.mask)
    unmerged = config.redistribution == "none" or bool(decision.mask.all())
    assert (decision.values is None) == (unmerged and not mend(params).clamped)
    if decision.values is not None and again.values is not None:
        for name, value in decision.values.items():
            assert value.shape == (decision.kept, *params[name].shape[1:])
            assert value.dtype == params[name].dtype
            assert value.isfinite().all()
            assert torch.equal(again.values[name], value)
    return decision


def kept(params: dict[str, Tensor], config: PruneRule, share: float = SHARE) -> Tensor:
    return decided(params, config, share).mask


def scaled(params: dict[str, Tensor], scale: float, config: PruneRule) -> dict[str, Tensor]:
    """The field at another scale; primitives are scaled too if the rule uses their overlap."""
    if config.edges == "centres":
        return {**params, "means": params["means"] * scale}
    return {**params, "means": params["means"] * scale, "scales": params["scales"] + math.log(scale)}


def merged_values(params: dict[str, Tensor], config: PruneRule, share: float = SHARE) -> dict[str, Tensor]:
    values = decided(params, config, share).values
    assert values is not None
    return dict(values)


def a_rotation() -> Tensor:
    return rotation_matrices(torch.randn(1, 4, dtype=torch.float64))[0]


def rotated(params: dict[str, Tensor], rotation: Tensor) -> dict[str, Tensor]:
    """The field and its primitives, rotated."""
    quats = quaternions(rotation @ rotation_matrices(params["quats"]))
    return {**params, "means": params["means"] @ rotation.T, "quats": quats}


@pytest.fixture(params=RULES.values(), ids=[name.replace(" ", "-") for name in RULES])
def rule(request: pytest.FixtureRequest) -> PruneRule:
    return request.param


HARD = {
    "at one spot": lambda: torch.full((3000, 3), 0.1),
    "thousands at one spot": lambda: torch.cat([torch.zeros(3000, 3), cloud(500)]),
    "collinear": lambda: cloud() * torch.tensor([1.0, 0.0, 0.0]),
    "coplanar": lambda: cloud() * torch.tensor([1.0, 1.0, 0.0]),
    "two clusters 1e6 apart": lambda: torch.cat([cloud(300), cloud(300) + 1e6]),
    "all isolated but two": lambda: torch.cat([1e4 * cloud(40), torch.zeros(2, 3)]),
    "floaters out of reach of float32's squares": lambda: torch.cat(
        [cloud(), torch.tensor([[3e38, 0, 0], [3e38, 0, 0]])]
    ),
    "clusters of 1e-5 beside 1e3": lambda: torch.cat([cloud(300) * 1e-5, cloud(300) * 1e3]),
    "1e-25 small": lambda: cloud() * 1e-25,
    "every point twice": lambda: cloud(300).repeat(2, 1),
}


@pytest.mark.parametrize("name", HARD)
@pytest.mark.parametrize("keep_ratio", [0.001, 0.2, 1.0])
def test_every_rule_keeps_the_exact_count_of_every_hard_field(rule: PruneRule, name: str, keep_ratio: float) -> None:
    kept(field(HARD[name]()), rule, keep_ratio)


@pytest.mark.parametrize("gamma", [0.0, 1.0])
def test_gamma_0_and_1_take_one_end_each(gamma: float) -> None:
    params = field(cloud())
    mask = kept(params, replace(PAPER, gamma=gamma))
    found = response(params, PAPER)
    known = ~found.isnan()
    if gamma == 1:
        assert found[mask].min() >= found[~mask & known].max()
    else:
        assert found[mask].max() <= found[~mask & known].min()


def test_the_scene_shifted_by_1e5_keeps_its_selection_in_float32(rule: PruneRule) -> None:
    means = (cloud() * 64).round() / 64
    assert torch.equal((means + 1e5) - 1e5, means)
    moved, still = decided(field(means + 1e5), rule), decided(field(means), rule)
    assert torch.equal(moved.mask, still.mask)
    if moved.values is not None and still.values is not None:
        for name, value in still.values.items():
            # Centres are rounded at their position; nothing else may depend on the position.
            bound = 2**-7 if name == "means" else 0.0
            torch.testing.assert_close(
                moved.values[name] - (1e5 if name == "means" else 0), value, rtol=0, atol=bound, msg=name
            )


@pytest.mark.parametrize("scale", [2.0**-80, 2.0**-20, 2.0**20, 2.0**60])
def test_a_scale_without_rounding_keeps_the_selection(rule: PruneRule, scale: float) -> None:
    # Scales are stored as logarithms, and adding a logarithm rounds: float64 keeps the selection.
    params = field(cloud())
    if rule.edges == "appearance" and rule.uses_response:
        params = {name: value.double() for name, value in params.items()}
    assert torch.equal(kept(scaled(params, scale, rule), rule), kept(params, rule))


@pytest.mark.parametrize("scale", [1e-6, 1e6])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_scale_with_rounding_swaps_no_more_than_near_ties(rule: PruneRule, scale: float, dtype: torch.dtype) -> None:
    params = field(cloud(dtype=dtype))
    before = kept(params, rule)
    swapped = int((kept(scaled(params, scale, rule), rule) != before).sum())
    assert swapped <= (2 if dtype == torch.float32 else 0)  # measured 0


@pytest.mark.parametrize("name", [name for name in RULES if name not in SPREAD_IN_SPACE])
def test_rotation_keeps_the_selection_but_for_near_ties(name: str) -> None:
    rule = RULES[name]
    # In the signal of all attributes only positions rotate.
    rotation = a_rotation()
    means = cloud(dtype=torch.float64)
    if rule.signal == "attributes":
        # That signal is centred on medians of single axes, which do not rotate with the field unless it is symmetric.
        means = torch.cat([means, -means])
    params = field(means)
    swapped = int((kept(rotated(params, rotation), rule) != kept(params, rule)).sum())
    assert swapped == 0


@pytest.mark.parametrize("scale", [2.0**-80, 1e-6, 1e6, 2.0**60])
def test_merged_values_scale_with_the_scene(scale: float) -> None:
    params = {name: value.double() for name, value in field(cloud()).items()}
    before, after = merged_values(params, DEFAULT), merged_values(scaled(params, scale, DEFAULT), DEFAULT)
    expected = scaled(before, scale, DEFAULT)
    torch.testing.assert_close(after["means"] / scale, before["means"], rtol=1e-6, atol=1e-9)
    for name in ("scales", "opacities", "features_dc", "features_rest"):
        torch.testing.assert_close(after[name], expected[name], rtol=1e-6, atol=1e-6)


def test_merged_values_rotate_with_the_scene() -> None:
    config = replace(DEFAULT, selection="top")
    params = {name: value.double() for name, value in field(cloud()).items()}
    rotation = a_rotation()
    before = rotated(merged_values(params, config), rotation)
    after = merged_values(rotated(params, rotation), config)
    for name in ("means", "scales", "opacities", "features_dc", "features_rest"):
        torch.testing.assert_close(after[name], before[name], rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(
        covariances(after["scales"].exp(), after["quats"]), covariances(before["scales"].exp(), before["quats"])
    )


def test_the_default_rule_follows_a_permutation() -> None:
    params, order, contribution = field(cloud()), torch.randperm(600), torch.linspace(0.1, 1, 600)
    plain = decide_share(params, DEFAULT, SHARE, contribution)
    mixed = decide_share({key: value[order] for key, value in params.items()}, DEFAULT, SHARE, contribution[order])
    assert torch.equal(mixed.mask, plain.mask[order])
    assert mixed.values is not None
    assert plain.values is not None
    back = torch.argsort(order[mixed.mask])
    for name, value in plain.values.items():
        torch.testing.assert_close(mixed.values[name][back], value, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", HARD)
def test_extreme_primitives_merge_to_finite_ones(name: str) -> None:
    params = field(HARD[name]())
    n = len(params["means"])
    third = torch.arange(n) % 3
    params["scales"][third == 0] = torch.tensor([-18.0, 7.0, 0.0])
    params["scales"][third == 1] -= 60
    params["quats"][::2] = 0
    params["opacities"][:] = torch.where(torch.arange(n) % 4 < 2, 30.0, -30.0)[:, None]
    # One extreme colour among clones of another.
    params["features_dc"][:] = 0.1
    params["features_dc"][n // 2] = 1e6
    for keep_ratio in (0.001, 0.2, 1.0):
        decided(params, DEFAULT, keep_ratio)


def test_a_primitive_of_extreme_colour_has_an_heir() -> None:
    means = cloud(2000)
    params, wild = field(means), int(means.norm(dim=1).argmin())
    params["features_dc"][:] = 0
    params["features_dc"][wild] = 1e6
    graph = field_graph(params, DEFAULT)
    assert not graph.isolated[wild]
    mask = torch.arange(2000) % 10 == (wild + 1) % 10
    assert int(voronoi_labels(graph, mask)[wild]) >= 0


@pytest.mark.parametrize("name", ["band", "band of attributes", "top", "merge into the top"])
def test_permutation_is_followed(name: str) -> None:
    params = field(cloud())
    order = torch.randperm(600)
    shuffled = {key: value[order] for key, value in params.items()}
    assert torch.equal(kept(shuffled, RULES[name]), kept(params, RULES[name])[order])


def test_responses_follow_a_permutation() -> None:
    params, order = field(cloud()), torch.randperm(600)
    shuffled = {key: value[order] for key, value in params.items()}
    config = RULES["sampled"]
    found, expected = response(shuffled, config), response(params, config)[order]
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=0, equal_nan=True)


def test_isolated_primitives_are_selected_last() -> None:
    means = torch.cat([cloud(100), 1e4 * cloud(20)])
    for gamma in (0.0, 0.5, 1.0):
        mask = kept(field(means), replace(PAPER, gamma=gamma), 0.5)
        assert not mask[response(field(means), PAPER).isnan()].any()


def test_tau_infinite_joins_all_and_tau_small_none() -> None:
    params = field(torch.cat([cloud(100), 1e4 * cloud(20)]))
    # A wide sigma too, or the weights of far neighbours underflow.
    wide = replace(PAPER, tau=math.inf, sigma=1e4)
    assert not response(params, wide).isnan().any()
    kept(params, wide)
    assert response(params, replace(PAPER, tau=1e-300)).isnan().all()
    kept(params, replace(PAPER, tau=1e-300))
    with pytest.raises(ConfigError, match="tau is 0"):
        decide_share(params, replace(PAPER, tau=0.0))


def test_all_responses_equal_are_taken_by_index() -> None:
    params = field(torch.zeros(50, 3))
    assert response(params, PAPER).eq(0).all()
    assert kept(params, PAPER).nonzero().flatten().tolist() == list(range(10))


def test_responses_of_inf_come_first_and_nan_last() -> None:
    found = torch.tensor([1.0, math.inf, math.nan, 2.0, math.inf, 0.0])
    assert select_top(found, 2).tolist() == [False, True, False, False, True, False]
    assert select_band(found, 3, 1 / 3).tolist() == [True, True, False, False, False, True]
    for seed in range(20):
        assert select_sampled(found, 4, seed).tolist() == [True, True, False, True, True, False]
    for values in (torch.full((6,), math.nan), torch.full((6,), math.inf), torch.full((6,), -math.inf)):
        for mask in (select_top(values, 2), select_band(values, 2, 0.5), select_sampled(values, 2, 0)):
            assert int(mask.sum()) == 2


@pytest.mark.parametrize("keep_ratio", [0.001, 0.5, 1.0])
@pytest.mark.parametrize("n", [1, 2, 3, 16])
def test_fewer_primitives_than_neighbours_are_pruned_like_any_others(
    rule: PruneRule, n: int, keep_ratio: float
) -> None:
    apart, at_one_spot = torch.arange(3.0 * n).reshape(n, 3), torch.zeros(n, 3)
    for means in (apart, at_one_spot):
        kept(field(means), rule, keep_ratio)


def test_two_primitives_merge_into_one_and_one_alone_is_kept_without_a_graph() -> None:
    params = field(torch.tensor([[0.0, 0, 0], [1.0, 0, 0]]))
    values = merged_values(params, DEFAULT, 0.001)
    # Contributions are 0.1 and 1.
    torch.testing.assert_close(values["means"], torch.tensor([[1 / 1.1, 0, 0]]))
    torch.testing.assert_close(
        values["features_dc"][0], (0.1 * params["features_dc"][0] + params["features_dc"][1]) / 1.1
    )
    one = decide_share(field(torch.zeros(1, 3)), DEFAULT)
    assert (one.kept, one.values) == (1, None)
    with pytest.raises(DataError, match="1 primitives cannot have 1 neighbours"):
        response(field(torch.zeros(1, 3)), PAPER)


@given(
    st.lists(st.tuples(st.integers(-2, 2), st.integers(-2, 2), st.integers(0, 1)), min_size=6, max_size=60),
    st.integers(-60, 60),
    st.floats(0.001, 1),
    st.floats(0, 1),
    st.sampled_from(list(RULES)),
    st.integers(0, 2**31),
)
def test_any_cells_at_any_scale(
    cells: list[Any], exponent: int, keep_ratio: float, gamma: float, name: str, seed: int
) -> None:
    params = field(torch.tensor(cells, dtype=torch.float32) * 2.0**exponent, seed)
    config = replace(RULES[name], gamma=gamma, num_neighbors=5, seed=seed)
    mask = kept(params, config, keep_ratio)
    found = response(params, config)
    assert (found[~found.isnan()] >= 0).all()
    assert not found.isinf().any()
    if config.selection == "band" and int(mask.sum()) <= int((~found.isnan()).sum()):
        assert not found[mask].isnan().any()
    # A shift by a whole number of cells is exact.
    moved = {**params, "means": params["means"] + 64 * 2.0**exponent}
    if config.signal == "positions" or name == "default":
        assert torch.equal(kept(moved, config, keep_ratio), mask)


@pytest.mark.gpu
@pytest.mark.parametrize("name", HARD)
def test_cpu_and_gpu_select_the_same_up_to_ties(rule: PruneRule, name: str) -> None:
    params = field(HARD[name]())
    n = len(params["means"])
    contribution = torch.linspace(0.1, 1, n)
    on_cpu = decide_share(params, rule, SHARE, contribution)
    on_device = {key: value.cuda() for key, value in params.items()}
    on_gpu = decide_share(on_device, replace(rule, graph_device="field"), SHARE, contribution.cuda())
    differing = on_gpu.mask.cpu() != on_cpu.mask
    print(f"{name}: {int(differing.sum())} of {n} primitives differ")
    assert on_gpu.kept == on_cpu.kept
    if rule.uses_response:
        # Responses agree up to rounding, so only primitives within rounding of a threshold may differ.
        expected, found = response(params, rule), response(on_device, rule).cpu()
        largest = float(expected.nan_to_num().max())
        torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-6 * largest, equal_nan=True)
    if on_gpu.values is not None:
        assert all(value.isfinite().all() for value in on_gpu.values.values())
    assert int(differing.sum()) <= max(2, n // 500)
