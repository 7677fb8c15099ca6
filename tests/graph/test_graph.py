"""Edge weights, their width and reach, and the invariances of graph and response on hard point sets."""

import math

import pytest
import torch
from fields import normal_points as normal
from hypothesis import given
from hypothesis import strategies as st

from sundae_ns.graph import graph
from sundae_ns.graph.filters import high_pass, response_magnitude
from sundae_ns.graph.graph import build_graph


def dense(graph):
    return torch.zeros(graph.N, graph.N, dtype=graph.weights.dtype).scatter_add(1, graph.indices, graph.weights)


def edges(graph):
    return int((graph.weights > 0).sum())


def magnitude(points):
    return response_magnitude(high_pass(build_graph(points, num_neighbors=8), points))


def check(graph, signal):
    """Properties of every graph: weights in [0, 1], and a response that is finite exactly for nodes with an edge."""
    assert ((graph.weights >= 0) & (graph.weights <= 1)).all()
    assert (graph.indices != torch.arange(graph.N)[:, None])[graph.weights > 0].all()
    response = high_pass(graph, signal)
    assert torch.equal(response.isfinite().all(dim=1), ~graph.isolated)
    # A mean of differences is at most as long as the longest difference.
    reach = (signal[graph.indices] - signal[:, None]).norm(dim=2).amax(dim=1)
    assert (response.norm(dim=1) <= reach * (1 + 1e-5))[~graph.isolated].all()


def test_weights_follow_the_equation_of_the_paper():
    points = normal(40) ** 3  # a few lie beyond the reach of others
    graph = build_graph(points, num_neighbors=39)
    squared = (points[:, None] - points[None]).square().sum(-1)
    expected = torch.where(squared < graph.tau, torch.exp(-squared / (2 * graph.sigma**2)), 0.0).fill_diagonal_(0)
    torch.testing.assert_close(dense(graph), expected)
    torch.testing.assert_close(graph.dw, expected.sum(1))
    assert 40 < edges(graph) == int((expected > 0).sum()) < 40 * 38


def test_the_median_ignores_clones_and_floaters():
    points = normal(120)
    clean = build_graph(points)
    spoiled = build_graph(torch.cat([points, points[:20], torch.full((5, 3), 1e9, dtype=torch.float64)]))
    assert clean.tau == pytest.approx((3 * clean.sigma) ** 2)
    assert spoiled.sigma == pytest.approx(clean.sigma, rel=0.25)
    assert edges(spoiled) > edges(clean)
    apart = build_graph(torch.cat([normal(200), torch.full((1, 3), 50.0, dtype=torch.float64)]))
    assert apart.isolated[-1]
    assert apart.isolated.sum() < 10


@pytest.mark.parametrize("sampled", [2**22, 64])
def test_the_width_is_the_lower_median_of_positive_distances(sampled, monkeypatch):
    monkeypatch.setattr(graph, "SAMPLED", sampled)
    odd = torch.tensor([1e-40, 1e30, torch.inf, torch.nan])
    values = torch.cat([normal(300).abs().flatten(), torch.zeros(40), odd])
    values = values[torch.randperm(len(values), generator=torch.Generator().manual_seed(0))].reshape(-1, 4)
    rows = values[:: 1 if sampled > 1000 else values.numel() // sampled]
    positive = sorted(value for value in rows.flatten().tolist() if 0 < value < math.inf)
    assert graph._typical_distance(values) == positive[(len(positive) - 1) // 2]
    assert graph._typical_distance(torch.zeros(3, 2)) == graph._typical_distance(torch.zeros(0, 2)) == 1.0


def test_two_points_are_the_smallest_graph():
    two = build_graph(torch.tensor([[0.0, 0, 0], [1.0, 0, 0]]), num_neighbors=1)
    assert two.sigma == 1.0
    torch.testing.assert_close(two.weights, torch.full((2, 1), math.exp(-0.5)))


def test_symmetries_are_followed():
    points, order = normal(120), torch.randperm(120, generator=torch.Generator().manual_seed(3))
    rotation = torch.linalg.qr(normal(3, seed=5)).Q
    found, shuffled, scaled = build_graph(points), build_graph(points[order]), build_graph(points * 1e-6)
    torch.testing.assert_close(dense(shuffled), dense(found)[order][:, order])
    torch.testing.assert_close(dense(build_graph(points @ rotation.T + 7.0)), dense(found))
    torch.testing.assert_close(dense(scaled), dense(found))
    assert shuffled.sigma == pytest.approx(found.sigma, rel=1e-12)
    assert scaled.sigma == pytest.approx(1e-6 * found.sigma)
    assert scaled.tau == pytest.approx(1e-12 * found.tau)
    expected = magnitude(points)
    torch.testing.assert_close(magnitude(points @ rotation.T), expected, rtol=1e-9, atol=1e-15, equal_nan=True)
    assert torch.equal(magnitude(points[order]).nan_to_num(-1), expected[order].nan_to_num(-1))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_every_hard_cloud(cloud, dtype):
    points = cloud(1500).to(dtype)
    check(build_graph(points), points)


@given(
    st.lists(st.tuples(st.integers(-2, 2), st.integers(-2, 2), st.integers(0, 1)), min_size=2, max_size=60),
    st.integers(-30, 15),
    st.sampled_from([0.0, 1.0, 1e5]),
    st.booleans(),
)
def test_any_cells_at_any_scale(cells, exponent, shift, double):
    points = torch.tensor(cells, dtype=torch.float64 if double else torch.float32) * 2.0**exponent + shift
    check(build_graph(points, num_neighbors=min(4, len(cells) - 1)), points)


@pytest.mark.gpu
@pytest.mark.usefixtures("on_gpu")
def test_the_same_from_run_to_run(cloud):
    points = cloud(100_000).float().cuda()
    first = build_graph(points)
    response = high_pass(first, points)
    for _ in range(3):
        again = build_graph(points)
        assert all(torch.equal(getattr(again, name), getattr(first, name)) for name in ("indices", "weights"))
        assert again.sigma == first.sigma
        assert torch.equal(high_pass(again, points).nan_to_num(-1), response.nan_to_num(-1))


@pytest.mark.gpu
@pytest.mark.usefixtures("on_gpu")
def test_same_bandwidth_and_close_responses(cloud):
    points = cloud(20_000).float()
    on_gpu, on_cpu = build_graph(points.cuda()), build_graph(points)
    assert (on_gpu.tau, on_gpu.sigma) == (on_cpu.tau, on_cpu.sigma)
    torch.testing.assert_close(on_gpu.weights.cpu(), on_cpu.weights, rtol=1e-5, atol=1e-6)
    magnitude = [response_magnitude(high_pass(graph, x)) for graph, x in ((on_gpu, points.cuda()), (on_cpu, points))]
    known = ~magnitude[1].isnan()
    assert torch.equal(~magnitude[0].cpu().isnan(), known)
    # Among neighbours at equal distances each device may take others.
    known &= (on_gpu.indices.cpu().sort(dim=1).values == on_cpu.indices.sort(dim=1).values).all(dim=1)
    scale = magnitude[1][known].max().clamp_min(1e-38) if known.any() else 1.0
    torch.testing.assert_close(magnitude[0].cpu()[known] / scale, magnitude[1][known] / scale, rtol=1e-4, atol=1e-6)


@pytest.mark.gpu
@pytest.mark.usefixtures("on_gpu")
def test_extra_memory_grows_with_the_number_of_points_only():
    peaks = []
    for n in (250_000, 500_000):
        points = torch.rand(n, 3, device="cuda")
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        high_pass(build_graph(points), points)
        peaks.append((torch.cuda.max_memory_allocated() - before) / n)
    # 2 GiB at 5,000,000 points are 429 bytes per point; the 8 MiB chunks add more at this size.
    assert max(peaks) < 600
    assert peaks[1] < 1.1 * peaks[0]
