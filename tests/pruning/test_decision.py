"""Decisions on hard fields: exact counts, the symmetries of a scene, finite values, and the two uses of a decision."""

import hashlib
import itertools
import math
from dataclasses import replace

import pytest
import torch
from fields import normal_points
from prunes import PAPER, decide_share, draws, gaussians
from torch.nn import Parameter

import sundae_ns.pruning.decision
from sundae_ns.core.covariance import covariances, quaternions, rotation_matrices
from sundae_ns.core.errors import ConfigError, DataError
from sundae_ns.core.gaussians import SPLAT_NAMES, Gaussians, sanitise
from sundae_ns.pruning.decision import Pruner, decide, prune_gaussians
from sundae_ns.pruning.merge import gaussian_graph, voronoi_labels
from sundae_ns.pruning.rule import band_rule, kept_count
from sundae_ns.pruning.scores import response

SHARE = 0.2
UNTURNED = ("scales", "opacities", "features_dc", "features_rest")
DEFAULT = draws()


def opacity(params):
    return params["opacities"].sigmoid().flatten()


RULES = {
    "default": DEFAULT,
    "pairs": replace(DEFAULT, selection="pairs"),
    "drawn by response": replace(DEFAULT, score="response", edges="centres", redistribution="none"),
    "merged into a band": replace(DEFAULT, score="response", selection="band"),
    "a function": replace(DEFAULT, score=opacity, redistribution="none"),
    "band": PAPER,
    "band of attributes": replace(PAPER, signal="attributes"),
}


def cloud(n):
    return normal_points(n, 1).float()


def decided(params, config, share=SHARE):
    n = len(params["means"])
    contribution = torch.linspace(0.1, 1, n)
    decision = decide_share(params, config, share, contribution)
    assert int(decision.mask.sum()) == decision.kept == kept_count(share, n)
    again = decide_share(params, config, share, contribution)
    assert torch.equal(again.mask, decision.mask)
    unmerged = config.redistribution == "none" or bool(decision.mask.all())
    assert (decision.values is None) == (unmerged and not sanitise(params).clamped)
    for name, value in (decision.values or {}).items():
        assert (value.shape, value.dtype) == ((decision.kept, *params[name].shape[1:]), params[name].dtype)
        assert value.isfinite().all()
    close(again.values, decision.values, 0.0)
    return decision


def close(found, expected, tolerance, names=SPLAT_NAMES):
    """Compare values after a merge, where there was one."""
    for name in names if expected else ():
        torch.testing.assert_close(found[name], expected[name], rtol=tolerance, atol=tolerance, msg=name)


def scaled(params, scale, config):
    """The field at another scale; Gaussians are scaled too if the rule uses their overlap."""
    larger = 0 if config.edges == "centres" else math.log(scale)
    return {**params, "means": params["means"] * scale, "scales": params["scales"] + larger}


def rotated(params, rotation):
    """The field and its Gaussians, rotated."""
    quats = quaternions(rotation @ rotation_matrices(params["quats"]))
    return {**params, "means": params["means"] @ rotation.T, "quats": quats}


@pytest.fixture(params=RULES.values(), ids=[*RULES])
def rule(request):
    return request.param


HARD = {
    "at one spot": lambda: torch.full((3000, 3), 0.1),
    "thousands at one spot": lambda: torch.cat([torch.zeros(3000, 3), cloud(500)]),
    "collinear": lambda: cloud(600) * torch.tensor([1.0, 0.0, 0.0]),
    "coplanar": lambda: cloud(600) * torch.tensor([1.0, 1.0, 0.0]),
    "two clusters 1e6 apart": lambda: torch.cat([cloud(300), cloud(300) + 1e6]),
    "all isolated but two": lambda: torch.cat([1e4 * cloud(40), torch.zeros(2, 3)]),
    "floaters out of reach of squares": lambda: torch.cat([cloud(600), torch.tensor([[3e38, 0, 0], [3e38, 0, 0]])]),
    "clusters of 1e-5 beside 1e3": lambda: torch.cat([cloud(300) * 1e-5, cloud(300) * 1e3]),
    "1e-25 small": lambda: cloud(600) * 1e-25,
    "every point twice": lambda: cloud(300).repeat(2, 1),
}


GOLDEN = {
    "default": ("1a1aa424", [118.709, 138.443]),
    "pairs": ("1a10e0b7", [132.794, 133.502]),
    "drawn by response": ("8b1a3e61", [136.953, 130.25]),
    "merged into a band": ("7fcbc415", [85.066, 145.976]),
    "a function": ("8bcc8dd9", [129.037, 142.88]),
    "band": ("1d9fbd7b", [95.15, 145.865]),
    "band of attributes": ("0feabee6", [81.95, 144.827]),
}
"""By rule: a hash of the mask, and sums of centres and colours of what is left."""


@pytest.mark.parametrize("name", GOLDEN)
def test_decisions_of_a_known_field_stay_as_they_are(name):
    """Of uniform numbers, clones and Gaussians that hardly contribute, so that no rounding decides."""
    params = {}
    for seed, (key, width) in enumerate({"means": 3, "scales": 3, "features_dc": 3, "opacities": 1}.items()):
        params[key] = 2 * torch.rand(300, width, generator=torch.Generator().manual_seed(seed)) - 3 * (key == "scales")
        params[key][200:240] = params[key][200]
    params |= {"quats": torch.eye(4)[[0] * 300], "features_rest": torch.zeros(300, 0, 3)}
    found = prune_gaussians(params, RULES[name], 45, torch.linspace(0, 3, 300).square())
    sums = [float(found.gaussians[key].double().sum()) for key in ("means", "features_dc")]
    digest = hashlib.sha256(found.decision.mask.numpy().tobytes()).hexdigest()[:8]
    assert (digest, sums) == (GOLDEN[name][0], pytest.approx(GOLDEN[name][1], rel=1e-5))


@pytest.mark.parametrize("name", HARD)
@pytest.mark.parametrize("keep_ratio", [0.001, 0.2])
def test_every_rule_keeps_the_exact_count_of_every_hard_field(rule, name, keep_ratio):
    decided(gaussians(means=HARD[name]()), rule, keep_ratio)


def test_the_scene_shifted_by_1e5_keeps_its_selection_in_float32(rule):
    means = (cloud(600) * 64).round() / 64
    assert torch.equal((means + 1e5) - 1e5, means)
    moved, still = decided(gaussians(means=means + 1e5), rule), decided(gaussians(means=means), rule)
    assert torch.equal(moved.mask, still.mask)
    # Centres are rounded at their position; nothing else may depend on the position.
    close(moved.values, still.values, 0.0, (*UNTURNED, "quats"))
    if still.values:
        torch.testing.assert_close(moved.values["means"] - 1e5, still.values["means"], rtol=0, atol=2**-7)


@pytest.mark.parametrize("scale", [2.0**-80, 1e-6, 2.0**60])
def test_scale_is_followed(rule, scale):
    # Scales are stored as logarithms, and adding a logarithm rounds: float64 keeps the selection.
    params = {name: value.double() for name, value in gaussians(means=cloud(600)).items()}
    before, after = decided(params, rule), decided(scaled(params, scale, rule), rule)
    assert torch.equal(after.mask, before.mask)
    if before.values:
        torch.testing.assert_close(after.values["means"] / scale, before.values["means"], rtol=1e-6, atol=1e-9)
        close(after.values, scaled(before.values, scale, rule), 1e-6, UNTURNED)


@pytest.mark.parametrize("name", ["band", "band of attributes", "a function", "merged into a band"])
def test_rotation_is_followed(name):
    """Draws follow an order that depends on the axes; in the signal of all attributes only positions rotate."""
    rule, means = RULES[name], normal_points(600, 1)
    rotation = rotation_matrices(torch.randn(1, 4, dtype=torch.float64))[0]
    if name == "a function":
        rule = replace(rule, selection="band")
    if rule.signal == "attributes":
        # That signal is centred on medians of single axes, which do not rotate with the field unless it is symmetric.
        means = torch.cat([means, -means])
    params = gaussians(means=means)
    before, after = decided(params, rule), decided(rotated(params, rotation), rule)
    assert torch.equal(after.mask, before.mask)
    if before.values:
        turned = rotated(before.values, rotation)
        close(after.values, turned, 1e-6, ("means", *UNTURNED))
        found, expected = (covariances(values["scales"].exp(), values["quats"]) for values in (after.values, turned))
        torch.testing.assert_close(found, expected)


def test_permutation_is_followed(rule):
    params, order, contribution = gaussians(means=cloud(600)), torch.randperm(600), torch.linspace(0.1, 1, 600)
    plain = decide_share(params, rule, SHARE, contribution)
    mixed = decide_share({key: value[order] for key, value in params.items()}, rule, SHARE, contribution[order])
    assert torch.equal(mixed.mask, plain.mask[order])
    back = torch.argsort(order[mixed.mask])
    close({name: value[back] for name, value in (mixed.values or {}).items()}, plain.values, 1e-4)


@pytest.mark.parametrize("name", HARD)
def test_extreme_primitives_merge_to_finite_ones(name):
    params = gaussians(means=HARD[name]())
    n = len(params["means"])
    third = torch.arange(n) % 3
    params["scales"][third == 0] = torch.tensor([-18.0, 7.0, 0.0])
    params["scales"][third == 1] -= 60
    params["quats"][::2] = 0
    params["opacities"][:] = torch.where(torch.arange(n) % 4 < 2, 30.0, -30.0)[:, None]
    params["opacities"][::5], params["scales"][::7, 1] = torch.inf, -torch.inf  # opaque, flat
    # One extreme colour among clones of another.
    params["features_dc"][:] = 0.1
    params["features_dc"][n // 2] = 1e6
    for keep_ratio, rule in itertools.product((0.001, 0.2, 1.0), (DEFAULT, RULES["a function"])):
        decided(params, rule, keep_ratio)


def test_a_primitive_of_extreme_colour_has_an_heir():
    means = cloud(2000)
    params, wild = gaussians(means=means), int(means.norm(dim=1).argmin())
    params["features_dc"][:] = 0
    params["features_dc"][wild] = 1e6
    graph = gaussian_graph(params, DEFAULT)
    assert not graph.isolated[wild]
    assert int(voronoi_labels(graph, torch.arange(2000) % 10 == (wild + 1) % 10)[wild]) >= 0


@pytest.mark.parametrize("gamma", [0.0, 0.5, 1.0])
def test_a_band_takes_both_ends_and_isolated_primitives_last(gamma):
    params = gaussians(means=torch.cat([cloud(100), 1e4 * cloud(20)]))
    decision = decided(params, replace(PAPER, gamma=gamma), 0.5)
    found = response(params, PAPER)
    ranked, high = found[~found.isnan()].sort().values.tolist(), round(gamma * 60)
    assert sorted(found[decision.mask].tolist()) == ranked[: 60 - high] + ranked[len(ranked) - high :]
    assert decision.isolated == int(found.isnan().sum()) > 0
    at_one_spot = decide_share(gaussians(means=torch.zeros(50, 3)), PAPER, 0.2)
    assert at_one_spot.mask.tolist() == [True] * 10 + [False] * 40


@pytest.mark.parametrize("keep_ratio", [0.001, 0.5, 1.0])
@pytest.mark.parametrize("n", [1, 2, 3, 16])
def test_fewer_primitives_than_neighbours_are_pruned_like_any_others(rule, n, keep_ratio):
    apart, at_one_spot = torch.arange(3.0 * n).reshape(n, 3), torch.zeros(n, 3)
    for means in (apart, at_one_spot):
        decided(gaussians(means=means), rule, keep_ratio)


def test_two_primitives_merge_into_one_and_one_alone_is_kept_without_a_graph():
    params = gaussians(means=torch.tensor([[0.0, 0, 0], [1.0, 0, 0]]))
    values, colors = decided(params, DEFAULT, 0.001).values, params["features_dc"]
    # Contributions are 0.1 and 1.
    torch.testing.assert_close(values["means"], torch.tensor([[1 / 1.1, 0, 0]]))
    torch.testing.assert_close(values["features_dc"][0], (0.1 * colors[0] + colors[1]) / 1.1)
    one = decide_share(gaussians(means=torch.zeros(1, 3)), DEFAULT)
    assert (one.kept, one.values) == (1, None)


def test_the_band_rule_is_the_papers():
    given = draws(signal="positions", num_neighbors=7, seed=3)
    paper = replace(given, gamma=0.7, score="response", selection="band", edges="centres", redistribution="none")
    assert band_rule(given, 0.7) == paper
    flags = ("uses_contribution", "uses_graph", "uses_edge_weights", "uses_detail", "refits")
    needs = {name: "".join(str(int(getattr(rule, flag))) for flag in flags) for name, rule in RULES.items()}
    assert list(needs.values()) == ["11110", "11011", "01100", "11100", "00100", "01100", "01100"]


@pytest.mark.parametrize("options", [{}, {"score": "response", "selection": "band", "redistribution": "none"}])
def test_a_given_graph_is_used_and_changes_nothing(options, monkeypatch):
    params, rule, weights = gaussians(), draws(**options), torch.ones(60)
    params["opacities"][4] = torch.nan
    usable = {name: value[torch.arange(60) != 4] for name, value in params.items()}
    expected, graph = decide_share(params, rule, 0.3, weights), gaussian_graph(usable, rule)
    monkeypatch.delattr(sundae_ns.pruning.decision, "gaussian_graph")
    found = decide_share(params, rule, 0.3, weights, graph)
    assert torch.equal(found.mask, expected.mask)
    close(found.values, expected.values, 0.0)
    # A rule without a graph ignores it.
    assert decide_share(params, draws(score=opacity, redistribution="none"), graph=graph).tau is None


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_primitives_that_are_not_finite_are_dropped_and_do_not_count(value):
    params = gaussians()
    params["features_rest"][7, 1, 2] = value
    params["means"][8] = value
    contribution = torch.ones(60)
    contribution[7] = torch.nan
    decision = decide_share(params, DEFAULT, 0.5, contribution)
    assert decision.dropped_nonfinite == 2
    assert int(decision.mask.sum()) == decision.kept == 29
    assert not decision.mask[[7, 8]].any()
    everything = decide_share(params, draws(), 1.0, contribution)
    assert everything.mask.nonzero().squeeze(1).tolist() == [i for i in range(60) if i not in (7, 8)]


@pytest.mark.parametrize("rule", [DEFAULT, PAPER], ids=["merged", "plain"])
def test_prune_leaves_what_the_decision_says_and_the_field_alone(rule):
    params = gaussians()
    params["means"][8] = torch.nan
    before = Gaussians({name: value.clone() for name, value in params.items()}, "logits")
    found = prune_gaussians(Gaussians(params, "logits"), rule, 12, torch.ones(60))
    decision = decide(before, rule, 12, torch.ones(60))
    assert torch.equal(found.decision.mask, decision.mask)
    assert found.gaussians.encoding == "logits"
    assert found.gaussians.num_gaussians == decision.kept == 12
    assert found.decision.dropped_nonfinite == 1
    assert (decision.values is None) == (rule.redistribution == "none")
    for name, value in params.items():
        expected = (decision.values or {}).get(name, before[name][decision.mask])
        assert torch.equal(found.gaussians[name], expected), name
        assert torch.equal(value.nan_to_num(), before[name].nan_to_num()), name
        assert value.data_ptr() != found.gaussians[name].data_ptr()


def test_invalid_input_raises_one_line():
    params, three, spoilt = gaussians(), draws(score=lambda _: torch.ones(3)), draws(score=opacity)
    spoilt.gamma = 2.0
    cases = [
        (DataError, "1 Gaussians cannot have 1 neighbours", lambda: response(gaussians(1), PAPER)),
        (DataError, "none of 60", lambda: decide_share({k: v * torch.nan for k, v in params.items()}, PAPER)),
        (ConfigError, "training views", lambda: decide_share(params, DEFAULT)),
        (ConfigError, "set redistribution to none", lambda: decide_share(params, draws(score="response"))),
        (DataError, r"shape \[59\] for 60", lambda: decide_share(params, DEFAULT, 0.1, torch.ones(59))),
        (ConfigError, "num_neighbors is 0: use at least 1", lambda: draws(num_neighbors=0)),
        (ConfigError, "gamma", lambda: decide(params, spoilt, 6)),
        (DataError, r"score has shape \[3\] for 60", lambda: decide(params, three, 6)),
        *((DataError, "cannot keep 0 of 60", lambda r=r: decide(params, r, 0, torch.ones(60))) for r in RULES.values()),
    ]
    for error, message, call in cases:
        with pytest.raises(error, match=f"^.*{message}.*$"):
            call()
    decide_share(params, RULES["a function"])  # it needs no contribution, nor does a field of which all stays
    decide_share(params, DEFAULT, 1.0)


@pytest.mark.parametrize("bad", [[], [0, 5, 18], [*range(18)]])
def test_a_field_in_training_loses_what_is_not_finite(bad):
    params, statistics = {name: Parameter(value) for name, value in gaussians(20).items()}, {"count": torch.arange(20)}
    optimizers = {name: torch.optim.Adam([value]) for name, value in params.items()}
    params["opacities"].data[bad], params["opacities"].data[19] = torch.nan, torch.inf
    assert Pruner(params, optimizers, [statistics]).drop_nonfinite() == len(bad)
    assert statistics["count"].tolist() == [row for row in range(20) if row not in bad]
    assert all(len(value) == 20 - len(bad) and value.isfinite().all() for value in params.values())
    assert params["opacities"][-1].sigmoid() > 1 - 1e-6
    assert optimizers["opacities"].param_groups[0]["params"][0] is params["opacities"]


def test_a_cut_leaves_the_field_that_prune_returns():
    params, statistics = {name: Parameter(value) for name, value in gaussians(20).items()}, {"count": torch.arange(20)}
    rule, weights = draws(score=opacity, num_neighbors=5), torch.linspace(1, 2, 20)
    expected = prune_gaussians(gaussians(20), rule, 10, weights)
    decision = Pruner(params, {}, [statistics]).cut(rule, 10, weights)
    assert decision.kept == len(params["means"]) == 10
    assert torch.equal(decision.mask, expected.decision.mask)
    assert torch.equal(statistics["count"], decision.mask.nonzero().squeeze(1))
    assert all(torch.equal(params[name], value) for name, value in expected.gaussians.items())
    assert not torch.equal(params["means"], gaussians(20)["means"][decision.mask])


@pytest.mark.gpu
@pytest.mark.parametrize("name", HARD)
def test_cpu_and_gpu_select_the_same_up_to_ties(rule, name):
    params = gaussians(means=HARD[name]())
    n = len(params["means"])
    contribution, on_device = torch.linspace(0.1, 1, n), {key: value.cuda() for key, value in params.items()}
    on_cpu = decide_share(params, rule, SHARE, contribution)
    on_gpu = decide_share(on_device, rule, SHARE, contribution.cuda())
    differing = on_gpu.mask.cpu() != on_cpu.mask
    assert on_gpu.kept == on_cpu.kept
    if on_gpu.values is not None:
        assert all(value.isfinite().all() for value in on_gpu.values.values())
    if rule.score == "response" and name == "two clusters 1e6 apart":
        return  # float32 leaves ties among the distances, and each device may settle them in another order
    if rule.score == "response":
        # Responses agree up to rounding, so only Gaussians within rounding of a threshold may differ.
        expected, found = response(params, rule), response(on_device, rule).cpu()
        largest = float(expected.nan_to_num().max())
        torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-6 * largest, equal_nan=True)
    assert int(differing.sum()) <= max(2, n // 500)
