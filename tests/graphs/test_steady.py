"""Graph and filters on hard point sets."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from sundae_ns.filters import high_pass, response_magnitude
from sundae_ns.graphs import NeighborGraph, build_graph


def magnitude(points: Tensor, k: int = 8, **options: float) -> Tensor:
    return response_magnitude(high_pass(build_graph(points, num_neighbors=k, **options), points))


def check(graph: NeighborGraph, signal: Tensor) -> None:
    """Properties of every graph: weights in [0, 1], and a response that is finite exactly for nodes with an edge."""
    assert ((graph.weights >= 0) & (graph.weights <= 1)).all()
    assert (graph.indices != torch.arange(graph.N)[:, None])[graph.weights > 0].all()
    response = high_pass(graph, signal)
    assert torch.equal(response.isfinite().all(dim=1), ~graph.isolated)
    # A mean of differences is at most as long as the longest difference.
    reach = (signal[graph.indices] - signal[:, None]).norm(dim=2).amax(dim=1)
    assert (response.norm(dim=1) <= reach * (1 + 1e-5))[~graph.isolated].all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("rule", ["robust", "literal"])
def test_every_hard_cloud(cloud: Callable, dtype: torch.dtype, rule: str) -> None:
    points = cloud(1500).to(dtype)
    check(build_graph(points, rule=rule), points)  # type: ignore[arg-type]


@given(
    st.lists(st.tuples(st.integers(-2, 2), st.integers(-2, 2), st.integers(0, 1)), min_size=3, max_size=60),
    st.integers(-30, 15),
    st.sampled_from([0.0, 1.0, 1e5]),
    st.sampled_from([None, 0.0, 1e-30, 1.0, float("inf")]),
    st.booleans(),
)
def test_any_cells_at_any_scale(cells: list, exponent: int, shift: float, tau: float | None, double: bool) -> None:
    points = torch.tensor(cells, dtype=torch.float64 if double else torch.float32) * 2.0**exponent + shift
    graph = build_graph(points, num_neighbors=min(4, len(cells) - 1), tau=tau)
    check(graph, points)
    assert tau != 0 or not graph.weights.any()
    assert tau != float("inf") or not graph.isolated.any()


def test_collinear_and_coplanar_points_respond_within_their_line_and_plane(cloud: Callable) -> None:
    points = cloud(400)
    points[:, 1] = 0.25
    response = high_pass(build_graph(points), points)
    assert (response[:, 1].nan_to_num() == 0).all()


def test_two_clusters_1e6_apart_are_independent() -> None:
    cluster = (torch.randn(300, 3) * 16).round() / 16
    both = torch.cat([cluster, cluster + 1e6])
    assert torch.equal(both[300:] - 1e6, cluster)
    found = magnitude(both)
    torch.testing.assert_close(found[:300], found[300:], rtol=0, atol=0, equal_nan=True)
    torch.testing.assert_close(found[:300], magnitude(cluster), rtol=0, atol=0, equal_nan=True)


def test_a_shift_by_1e5_changes_no_bit_of_the_response_in_float32() -> None:
    points = (torch.randn(2000, 3) * 64).round() / 64
    shifted = points + 1e5
    assert torch.equal(shifted - 1e5, points)
    assert torch.equal(magnitude(shifted).nan_to_num(-1), magnitude(points).nan_to_num(-1))


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_scale_changes_the_response_by_its_square(scale: float) -> None:
    points = torch.randn(2000, 3)
    found, scaled = magnitude(points), magnitude(points * scale)
    known = ~found.isnan()
    # Rounding may add or remove an edge at the cutoff; its weight is 0.011, and such edges are rare.
    off = ((scaled.double() / scale**2 - found).abs() > 1e-4 * found)[known]
    assert off.sum() <= 4  # measured 0
    assert (scaled.isnan() != found.isnan()).sum() == 0


def test_rotation_and_permutation_are_followed() -> None:
    points = torch.randn(1000, 3, dtype=torch.float64)
    rotation = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64)).Q
    order = torch.randperm(1000)
    found = magnitude(points)
    torch.testing.assert_close(magnitude(points @ rotation.T), found, rtol=1e-9, atol=1e-15, equal_nan=True)
    assert torch.equal(magnitude(points[order]).nan_to_num(-1), found[order].nan_to_num(-1))
    single = points.float()
    assert torch.equal(magnitude(single[order]).nan_to_num(-1), magnitude(single)[order].nan_to_num(-1))


def test_two_nodes_at_any_distance() -> None:
    for distance in (0.0, 1e-30, 1.0, 1e18):
        points = torch.tensor([[0.0, 0, 0], [distance, 0, 0]])
        graph = build_graph(points, num_neighbors=1)
        check(graph, points)
        assert (graph.weights > 0).all()


def test_thousands_of_points_at_one_spot_do_not_respond() -> None:
    points = torch.cat([torch.full((5000, 3), 0.1), torch.randn(500, 3)])
    found = magnitude(points, 16)
    assert (found[:5000] == 0).all()
    assert (found[5000:].nan_to_num(1) > 0).all()


def test_an_overflowing_distance_and_an_infinite_width_give_no_nan() -> None:
    points = torch.cat([torch.randn(20, 3), torch.tensor([[3e38, 3e38, 3e38]])])
    graph = build_graph(points, num_neighbors=6, sigma=float("inf"))
    assert set(graph.weights.unique().tolist()) == {0.0, 1.0}
