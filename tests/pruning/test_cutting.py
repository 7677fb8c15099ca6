"""Primitives that are not finite, and what a cut writes into the kept ones."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import Parameter

from sundae_ns.pruning import PruningConfig
from sundae_ns.pruning.cutting import cut, drop_nonfinite

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
    assert drop_nonfinite(params, {}, [statistics]) == removed
    kept = [row for row in range(N) if row not in bad]
    assert statistics["count"].tolist() == kept
    assert all(len(value) == len(kept) for value in params.values())


def test_a_field_without_a_finite_primitive_stays() -> None:
    params = field()
    params["means"].data[:, 1] = torch.inf
    assert drop_nonfinite(params, {}, []) == 0
    assert len(params["means"]) == N


def test_a_cut_merges_into_what_stays_and_counts_itself() -> None:
    params, before = field(), {name: value.detach().clone() for name, value in field().items()}
    state = {"pruned_at": -1, "num_prunes": 0, "peak": N}
    config = PruningConfig(score="opacity", selection="top", num_neighbors=5)

    def weights() -> Tensor:
        return torch.linspace(1, 2, N)

    decision = cut(params, {}, state, config, weights, step=7, count=lambda n: n // 2)
    assert decision.kept == len(params["means"]) == N // 2
    assert state == {"pruned_at": 7, "num_prunes": 1, "peak": N}
    assert decision.values is not None
    assert all(torch.equal(params[name], value) for name, value in decision.values.items())
    assert not torch.equal(params["means"], before["means"][decision.mask])
