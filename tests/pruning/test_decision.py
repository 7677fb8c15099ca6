"""Signals, scores and the decision: exact counts, and no input changed or computed without need."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from prunes import decide_share
from torch import Tensor

from sundae_ns.errors import ConfigError, DataError, SundaeError
from sundae_ns.gaussians.field import Field
from sundae_ns.gaussians.parameters import rgb_to_sh
from sundae_ns.pruning import PruneRule, decide, prune_field, response
from sundae_ns.pruning.scores import attribute_signal, score

PLAIN = PruneRule(selection="sampled", score="response-contribution", edges="centres", redistribution="none")
"""Response times contribution and independent draws, without the additions of the default rule."""
PAPER = replace(PLAIN, selection="band", score="response", signal="positions")


def field(n: int = 60, seed: int = 0) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    shapes = {
        "means": (3,),
        "scales": (3,),
        "quats": (4,),
        "features_dc": (3,),
        "features_rest": (3, 3),
        "opacities": (1,),
    }
    return {name: torch.randn(n, *shape, generator=generator) for name, shape in shapes.items()}


def ones(n: int = 60) -> Tensor:
    return torch.ones(n)


@pytest.mark.parametrize("selection", ["band", "sampled", "top"])
@pytest.mark.parametrize("name", ["response-contribution", "response", "contribution", "opacity", "random"])
@pytest.mark.parametrize("keep_ratio", [0.001, 0.1, 0.25, 1.0])
def test_every_score_and_selection_keeps_the_exact_count(name: Any, selection: Any, keep_ratio: float) -> None:
    params = field()
    before = {key: value.clone() for key, value in params.items()}
    rule = replace(PLAIN, score=name, selection=selection)
    decision = decide_share(params, rule, keep_ratio, ones())
    assert int(decision.mask.sum()) == decision.kept == max(1, round(keep_ratio * 60))
    assert torch.equal(decide_share(params, rule, keep_ratio, ones()).mask, decision.mask)
    assert (decision.sigma is not None) == (rule.uses_graph and keep_ratio < 1)
    assert all(torch.equal(params[key], before[key]) for key in params)


def test_the_papers_rule_is_the_band_of_the_position_response() -> None:
    params = field()
    decision = decide_share(params, PAPER, 0.2)
    found = response(params, PAPER)
    ranked = found[~found.isnan()].sort().values
    assert sorted(found[decision.mask].tolist()) == torch.cat([ranked[:6], ranked[-6:]]).tolist()
    assert decision.isolated == int(found.isnan().sum())


def test_isolated_floaters_are_judged_by_contribution_or_not_kept() -> None:
    params = field()
    params["means"][[3, 40]] = torch.tensor([[500.0, 0, 0], [0, 500.0, 0]])
    for gamma in (0.0, 0.5, 1.0):
        assert not decide_share(params, replace(PAPER, gamma=gamma), 0.5).mask[[3, 40]].any()
    contribution = torch.ones(60)
    contribution[3], contribution[40] = 1e6, 0.0
    mask = decide_share(params, PLAIN, 0.5, contribution).mask
    assert mask[3]
    assert not mask[40]


def test_contribution_alone_decides_on_a_graph_without_edges() -> None:
    contribution = torch.arange(60).float()
    decision = decide_share(field(), replace(PLAIN, selection="top", tau=1e-12), 0.1, contribution)
    assert decision.isolated == 60
    assert decision.mask.nonzero().squeeze(1).tolist() == list(range(54, 60))


def test_attribute_response_finds_the_colour_edge() -> None:
    n = 400
    params = field(n)
    grid = torch.arange(20.0)
    params["means"] = torch.cartesian_prod(grid, grid, torch.zeros(1))
    left = params["means"][:, 0] < 10
    params["features_dc"] = rgb_to_sh(torch.where(left, 0.2, 0.8)[:, None].expand(-1, 3)).clone()
    params["scales"] = torch.zeros(n, 3)
    params["opacities"] = torch.zeros(n, 1)
    magnitude = response(params, replace(PLAIN, num_neighbors=8))
    edge = (params["means"][:, 0] - 9.5).abs() < 1
    assert magnitude[edge].min() > 10 * magnitude[~edge].max()


def test_signals_have_no_unit_and_no_dominating_group() -> None:
    params = field()
    signal = attribute_signal(params)
    assert signal.shape == (60, 10)
    for group in (slice(0, 3), slice(3, 6), slice(6, 7), slice(7, 10)):
        assert signal[:, group].norm(dim=1).median().item() == pytest.approx(1.0, rel=1e-5)
    scaled = {**params, "means": 1000 * params["means"] + 5, "scales": params["scales"] + 3}
    torch.testing.assert_close(attribute_signal(scaled), signal, rtol=1e-4, atol=1e-4)


def test_constant_and_almost_constant_attributes_are_finite() -> None:
    params = field()
    params["scales"] = torch.full((60, 3), 2.0)
    params["opacities"] = torch.zeros(60, 1)
    params["opacities"][0] = 3.0
    signal = attribute_signal(params)
    assert signal.isfinite().all()
    assert (signal[:, 7:] == 0).all()
    assert signal[0, 6] > 0
    assert (signal[1:, 6] == 0).all()


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_primitives_that_are_not_finite_are_dropped_and_do_not_count(value: float) -> None:
    params = field()
    params["features_rest"][7, 1, 2] = value
    params["means"][8] = value
    contribution = torch.ones(60)
    contribution[7] = torch.nan
    decision = decide_share(params, PLAIN, 0.5, contribution)
    assert decision.dropped_nonfinite == 2
    assert int(decision.mask.sum()) == decision.kept == 29
    assert not decision.mask[[7, 8]].any()
    everything = decide_share(params, PruneRule(), 1.0, contribution)
    assert everything.mask.nonzero().squeeze(1).tolist() == [i for i in range(60) if i not in (7, 8)]


def test_contribution_is_asked_for_only_if_needed() -> None:
    for name in ("response", "opacity", "random"):
        rule = replace(PLAIN, score=name)
        assert not rule.uses_contribution
        decide_share(field(), rule)
    assert PruneRule().uses_contribution
    decide_share(field(), PruneRule(), 1.0)


def test_exactly_count_primitives_are_kept_and_all_if_they_are_fewer() -> None:
    config = replace(PLAIN, score="opacity", selection="top")
    decision = decide(field(), config, 17)
    opacities = field()["opacities"].squeeze(1)
    assert torch.equal(decision.mask, opacities >= opacities.sort(descending=True).values[16])
    assert decide(field(), config, 1000).kept == 60


@pytest.mark.parametrize("rule", [PruneRule(), PLAIN], ids=["merged", "plain"])
def test_prune_leaves_what_the_decision_says_and_the_field_alone(rule: PruneRule) -> None:
    params = field()
    params["means"][8] = torch.nan
    before = Field({name: value.clone() for name, value in params.items()}, "logits")
    found = prune_field(Field(params, "logits"), rule, 12, ones())
    decision = decide(before, rule, 12, ones())
    assert torch.equal(found.decision.mask, decision.mask)
    assert found.field.encoding == "logits"
    assert found.field.num_primitives == decision.kept == 12
    assert found.decision.dropped_nonfinite == 1
    assert (decision.values is None) == (rule.redistribution == "none")
    for name, value in params.items():
        expected = (decision.values or {}).get(name, before[name][decision.mask])
        assert torch.equal(found.field[name], expected), name
        assert torch.equal(value.nan_to_num(), before[name].nan_to_num()), name
        assert value.data_ptr() != found.field[name].data_ptr()


def test_invalid_input_raises_one_line() -> None:
    cases: list[tuple[type[Exception], str, Any]] = [
        (DataError, "1 primitives cannot have 1 neighbours", lambda: response(field(1), PAPER)),
        (DataError, "none of 60", lambda: decide_share({k: v * torch.nan for k, v in field().items()}, PAPER)),
        (ConfigError, "training views", lambda: decide_share(field(), PruneRule())),
        (DataError, r"shape \[59\] for 60", lambda: decide_share(field(), PruneRule(), 0.1, ones(59))),
        (ConfigError, "keep_ratio", lambda: decide_share(field(), PruneRule(), 0.0)),
        (ConfigError, "gamma", lambda: decide_share(field(), PruneRule(gamma=2.0))),
    ]
    for error, message, call in cases:
        with pytest.raises(error, match=message) as caught:
            call()
        assert isinstance(caught.value, SundaeError)
        assert "\n" not in str(caught.value)


@pytest.mark.gpu
def test_decision_on_the_gpu_keeps_the_same_primitives() -> None:
    params = field(500)
    on_gpu = decide_share({name: value.cuda() for name, value in params.items()}, PAPER, 0.3)
    assert on_gpu.mask.is_cuda
    assert torch.equal(on_gpu.mask.cpu(), decide_share(params, PAPER, 0.3).mask)


def test_a_contribution_of_nan_counts_as_0() -> None:
    weights = torch.arange(60.0).index_fill(0, torch.tensor([7]), torch.nan)
    values = score(field(), PruneRule(score="contribution"), None, weights)
    assert values[7] == 0
    assert values[8] == 8


def test_scores_by_hand() -> None:
    params, weights = field(3), torch.tensor([2.0, 0.5, torch.nan])
    found = torch.tensor([4.0, torch.nan, 9.0])
    expected = {
        "contribution": [2.0, 0.5, 0.0],
        "detail-contribution": [2.0, 0.5, 0.0],
        "random": [1.0, 1.0, 1.0],
        # The second has no response and gets the lower median, 2.
        "response-contribution": [4.0, 1.0, 0.0],
    }
    for name, values in expected.items():
        config = replace(PLAIN, score=name)  # type: ignore[arg-type]
        assert score(params, config, found, weights).tolist() == pytest.approx(values), name
    assert score(params, replace(PLAIN, score="response"), found, None)[[0, 2]].tolist() == [2, 3]
    opacities = score(params, replace(PLAIN, score="opacity"), None, None)
    assert torch.equal(opacities, params["opacities"].double().sigmoid().flatten())
    nothing = torch.full((3,), torch.nan)
    assert score(params, replace(PLAIN, score="response-contribution"), nothing, weights)[0] == 2
