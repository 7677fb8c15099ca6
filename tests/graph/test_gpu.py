"""Neighbour search on a GPU against the CPU, and the graph and response built on it."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from sundae_ns.graph import neighbors
from sundae_ns.graph.filters import high_pass, response_magnitude
from sundae_ns.graph.graph import build_graph
from sundae_ns.graph.neighbors import build_tree, knn

pytestmark = pytest.mark.gpu


@pytest.fixture(autouse=True)
def kernel_runs():
    """Without the kernel, the search on the CPU would be compared with itself."""
    assert neighbors._kernel(torch.device("cuda", torch.cuda.current_device()), torch.float32, 16) is not None


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("n", "k"), [(200_000, 16), (20_000, 32), (2000, 1), (300, 100), (2, 1)])
def test_same_neighbours(cloud, dtype, n, k):
    points = cloud(n).to(dtype)
    on_gpu, on_cpu = knn(points.cuda(), k), knn(points, k)
    assert on_gpu.indices.is_cuda
    assert on_gpu.distances.is_cuda
    assert torch.equal(on_gpu.distances.cpu(), on_cpu.distances)
    # Ties may come in any order on the CPU, also at the end of the list.
    apart = (on_cpu.distances.diff(dim=1) > 0).all(dim=1)
    assert torch.equal(on_gpu.indices.cpu()[apart, :-1], on_cpu.indices[apart, :-1])


def test_same_tree_as_on_the_cpu(cloud):
    points = cloud(50_000).float()
    on_gpu, on_cpu = build_tree(points.cuda()), build_tree(points)
    assert on_gpu.depth == on_cpu.depth
    for name in ("points", "order", "boxes", "lowest"):
        assert torch.equal(getattr(on_gpu, name).cpu(), getattr(on_cpu, name))


def test_a_million_clones_of_one_point():
    found = knn(torch.ones(1_000_000, 3, device="cuda"), 16)
    assert (found.distances == 0).all()
    assert torch.equal(found.indices[20:], torch.arange(16, device="cuda").expand(999_980, -1))
    for row in range(17):
        assert found.indices[row].tolist() == [other for other in range(17) if other != row]


def test_the_same_from_run_to_run(cloud):
    points = cloud(100_000).float().cuda()
    first = build_graph(points)
    response = high_pass(first, points)
    for _ in range(3):
        again = build_graph(points)
        assert torch.equal(again.indices, first.indices)
        assert torch.equal(again.weights, first.weights)
        assert again.sigma == first.sigma
        assert torch.equal(high_pass(again, points).nan_to_num(-1), response.nan_to_num(-1))


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


def test_other_streams_and_threads_and_a_search_without_the_kernel_agree(monkeypatch):
    points, stream = torch.rand(100_000, 3, device="cuda"), torch.cuda.Stream()
    expected = knn(points, 8)
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        beside = knn(points, 8)
    stream.synchronize()
    neighbors._kernel.cache_clear()
    with ThreadPoolExecutor(1) as pool:
        elsewhere = pool.submit(knn, points, 8).result()
    monkeypatch.setattr(neighbors, "_kernel", lambda *_: None)
    without = knn(points, 8)
    assert without.indices.is_cuda
    for found in (beside, elsewhere, without):
        assert torch.equal(found.indices, expected.indices)
        assert torch.equal(found.distances, expected.distances)
