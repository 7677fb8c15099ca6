"""Primitives that are not finite, and what a cut writes into the kept ones."""

from __future__ import annotations

import pytest
import torch
from torch.nn import Parameter

from sundae_ns.errors import DataError
from sundae_ns.pruning import PruneRule, prune_field
from sundae_ns.pruning.cutting import FieldPruner

N = 20


def field() -> dict[str, Parameter]:
    generator = torch.Generator().manual_seed(0)
    shapes = {"means": 3, "scales": 3, "quats": 4, "features_dc": 3, "opacities": 1}
    params = {name: Parameter(torch.randn(N, width, generator=generator)) for name, width in shapes.items()}
    return {**params, "features_rest": Parameter(torch.zeros(N, 0, 3))}


@pytest.mark.parametrize(("bad", "removed"), [([], 0), ([3], 1), ([0, 5, 19], 3), (list(range(N - 1)), N - 1)])
def test_primitives_that_are_not_finite_are_removed_and_counted(bad: list[int], removed: int) -> None:
    params, statistics = field(), {"count": torch.arange(N)}
    params["opacities"].data[bad] = torch.nan
    assert FieldPruner(params, {}, [statistics]).drop_nonfinite() == removed
    kept = [row for row in range(N) if row not in bad]
    assert statistics["count"].tolist() == kept
    assert all(len(value) == len(kept) for value in params.values())


def test_a_field_without_a_finite_primitive_stays() -> None:
    params = field()
    params["means"].data[:, 1] = torch.inf
    with pytest.raises(DataError, match=f"none of {N} primitives is finite"):
        FieldPruner(params, {}).drop_nonfinite()
    assert len(params["means"]) == N


def test_a_cut_leaves_the_field_that_prune_returns() -> None:
    params, statistics = field(), {"count": torch.arange(N)}
    rule, weights = PruneRule(score="opacity", selection="top", num_neighbors=5), torch.linspace(1, 2, N)
    expected = prune_field(field(), rule, N // 2, weights)
    decision = FieldPruner(params, {}, [statistics]).cut(rule, N // 2, weights)
    assert decision.kept == len(params["means"]) == N // 2
    assert torch.equal(decision.mask, expected.decision.mask)
    assert torch.equal(statistics["count"], decision.mask.nonzero().squeeze(1))
    assert all(torch.equal(params[name], value) for name, value in expected.field.items())
    assert not torch.equal(params["means"], field()["means"][decision.mask])
