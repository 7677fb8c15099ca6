"""Neighbour search against all pairs, on the CPU and by the kernel, also compiled for it: clones, floaters, ties."""

import tracemalloc
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sundae_ns.core.errors import BackendError, ConfigError, DataError
from sundae_ns.cuda import kernels
from sundae_ns.graph import neighbors
from sundae_ns.graph.neighbors import FILE, KERNEL, LEAF, MAX_NEIGHBORS, build_tree, kernel_options, knn, search_tree


def check(points, indices, distances):
    """Other points, each once, at the distances of the nearest ones, ascending; of one place the lowest indices."""
    n, k = indices.shape
    x, y, z = (points.double()[:, None] - points.double()[None]).unbind(2)
    squared = (x * x + y * y + z * z).fill_diagonal_(torch.inf)
    ordered = squared.sort(dim=1, stable=True)
    expected = ordered.values[:, :k].sqrt().to(points.dtype)
    torch.testing.assert_close(distances, expected, rtol=1e-6, atol=0)
    assert (distances.diff(dim=1) >= 0).all()
    assert (indices != torch.arange(n)[:, None]).all()
    assert (indices.sort(dim=1).values.diff(dim=1) > 0).all()
    torch.testing.assert_close(squared.gather(1, indices).sqrt().to(points.dtype), expected, rtol=1e-6, atol=0)
    clones = ordered.values[:, :k] == 0
    assert torch.equal(indices[clones], ordered.indices[:, :k][clones])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("n", "k"), [(700, 16), (130, 3), (40, 39), (2, 1)])
def test_every_hard_cloud(cloud, dtype, n, k, monkeypatch):
    points = cloud(n).to(dtype)
    for chunk in (neighbors.CHUNK, 10):
        monkeypatch.setattr(neighbors, "CHUNK", chunk)
        found = knn(points, k)
        assert found.indices.dtype == torch.int64
        check(points, *found)


@given(st.lists(st.integers(0, 2), min_size=2, max_size=40), st.integers(1, 10))
def test_any_clones(cells, k):
    points = torch.tensor(cells, dtype=torch.float32)[:, None].expand(-1, 3)
    check(points, *knn(points, min(k, len(cells) - 1)))


@pytest.mark.parametrize("place", [torch.zeros, torch.rand])
def test_memory_and_time_grow_with_points_also_of_clones(place):
    def peak(n):
        points = place(n, 3)
        tracemalloc.start()
        try:
            assert knn(points, 16).indices.shape == (n, 16)
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    assert peak(40_000) < 6 * peak(10_000)


@pytest.mark.parametrize(
    ("points", "k", "error", "words"),
    [
        *((torch.zeros(n, 3), k, DataError, f"{n} Gaussians cannot have {k} .*at most {max(n - 1, 0)}")
          for n, k in ((0, 1), (1, 1), (5, 5), (5, 9))),
        (torch.zeros(5, 3), 0, ConfigError, "at least 1"),
        (torch.zeros(5, 2), 1, DataError, r"\[5, 2\]"),
        (torch.tensor([[0.0] * 3, [torch.nan] * 3, [torch.inf] * 3]), 1, DataError, "2 of 3 positions are NaN"),
        (torch.full((5, 3), 1e200, dtype=torch.float64), 2, DataError, "1e.150"),
    ],
)  # fmt: skip
def test_wrong_input_is_refused(points, k, error, words):
    with pytest.raises(error, match=words):
        knn(points, k)


def test_without_a_kernel_the_cpu_searches_and_logs_one_line(monkeypatch, caplog):
    def broken(*_):
        raise BackendError("no compiler on board")

    monkeypatch.setattr(neighbors, "Kernel", broken)
    neighbors._kernel.cache_clear()
    device = torch.device("cuda", 0)
    with caplog.at_level("WARNING"):
        assert [neighbors._kernel(device, torch.float32, 16) for _ in range(3)] == [None] * 3
        assert neighbors._kernel(device, torch.float32, MAX_NEIGHBORS + 1) is None
    first, second = (record.getMessage() for record in caplog.records)
    assert "search runs on the CPU" in first
    assert "no compiler on board" in first
    assert f"at most {MAX_NEIGHBORS} neighbours, not {MAX_NEIGHBORS + 1}" in second
    neighbors._kernel.cache_clear()


def options_of(dtype, k):
    return ["-ffp-contract=off", *kernel_options(dtype, k)[1:]]


@pytest.fixture
def compiled(load_on_cpu):
    """Compiles the kernel for a dtype and a number of neighbours."""
    return lambda dtype, k: load_on_cpu(FILE, [KERNEL], options_of(dtype, k))[KERNEL]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("n", "k"), [(700, 16), (130, 3), (40, 32)])
def test_kernel_matches_all_pairs(compiled, cloud, dtype, n, k):
    points = cloud(n).to(dtype)
    check(points, *search_tree(build_tree(points), k, compiled(dtype, k)))


@pytest.mark.parametrize("n", [2, 15, 16, 17, 33, 63, 64, 65])
def test_kernel_on_every_shape_of_small_tree(compiled, n):
    points, k = torch.randn(n, 3), min(3, n - 1)
    check(points, *search_tree(build_tree(points), k, compiled(torch.float32, k)))


def test_tree_holds_every_point_once_in_tight_boxes(cloud):
    for n in (1, 15, 1000):
        tree = build_tree(cloud(n).float())
        assert torch.equal(tree.order.long().sort().values, torch.arange(n))
        assert torch.equal(tree.points, cloud(n).float()[tree.order.long()])
        for node in range(1, 2 ** (tree.depth + 1)):
            level = node.bit_length() - 1
            begin, end = ((node - 2**level + i) * n // 2**level for i in (0, 1))
            inside = tree.points[begin:end]
            assert torch.equal(tree.boxes[node], torch.cat([inside.amin(0), inside.amax(0)]))
            assert tree.lowest[node] == tree.order[begin:end].min()
            assert level < tree.depth or n < 2 * LEAF or LEAF <= end - begin <= 2 * LEAF


def test_thousands_of_clones_visit_no_more_points_than_others(compiled, compile_for_cpu, monkeypatch):
    # Counts visited points, not seconds. Without the lowest index of each node, every clone would visit all others.
    visit, visited = "const double dx = points", []
    source = kernels.read_source(FILE)
    assert source.count(visit) == 1
    source = 'static long long total; extern "C" long long visited() { return total; }\n' + source
    source = source.replace(visit, f"++total; {visit}")
    monkeypatch.setattr(kernels, "read_source", lambda _: source)
    for points in (torch.zeros(20_000, 3), torch.randn(20_000, 3)):
        search_tree(build_tree(points), 16, compiled(torch.float32, 16))
        visited.append(compile_for_cpu(source, options_of(torch.float32, 16)).visited())
    clones, both = (count / 20_000 for count in visited)
    assert clones < 2 * (both - clones)  # measured 116 and 114 points per query


def test_kernel_compiles_for_gpus_from_turing_to_hopper(compile_for_gpu):
    cases = [("sm_75", torch.float32, 16), ("sm_90", torch.float64, 1), ("sm_90", torch.float32, MAX_NEIGHBORS)]
    for architecture, dtype, k in cases:
        assert KERNEL.encode() in compile_for_gpu(FILE, architecture, kernel_options(dtype, k))
    with pytest.raises(BackendError, match="does not compile for sm_90.*REAL"):
        compile_for_gpu(FILE, "sm_90", ())


@pytest.mark.gpu
@pytest.mark.usefixtures("on_gpu")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("n", "k"), [(200_000, 16), (20_000, 32), (2000, 1), (300, 100), (2, 1)])
def test_same_neighbours_on_a_gpu(cloud, dtype, n, k):
    points = cloud(n).to(dtype)
    on_gpu, on_cpu = knn(points.cuda(), k), knn(points, k)
    assert all(value.is_cuda for value in on_gpu)
    assert torch.equal(on_gpu.distances.cpu(), on_cpu.distances)
    # Ties may come in any order on the CPU, also at the end of the list.
    apart = (on_cpu.distances.diff(dim=1) > 0).all(dim=1)
    assert torch.equal(on_gpu.indices.cpu()[apart, :-1], on_cpu.indices[apart, :-1])


@pytest.mark.gpu
@pytest.mark.usefixtures("on_gpu")
def test_same_tree_as_on_the_cpu(cloud):
    points = cloud(50_000).float()
    on_gpu, on_cpu = build_tree(points.cuda()), build_tree(points)
    assert on_gpu.depth == on_cpu.depth
    for name in ("points", "order", "boxes", "lowest"):
        assert torch.equal(getattr(on_gpu, name).cpu(), getattr(on_cpu, name))


@pytest.mark.gpu
@pytest.mark.usefixtures("on_gpu")
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
