"""The tree of boxes, and the kernel that walks through it: its very lines, compiled for the CPU."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Sequence
from typing import Protocol

import pytest
import torch
from torch import Tensor

from sundae_ns.errors import BackendError
from sundae_ns.gpu import nvrtc
from sundae_ns.gpu.nvrtc import Argument, Launch
from sundae_ns.graphs import knn, radius_neighbors
from sundae_ns.graphs.traversal import KERNEL, MAX_NEIGHBORS, OPTIONS, SOURCE, definitions, search_tree
from sundae_ns.graphs.tree import LEAF, build_tree

# A count of the points looked at, and a loop over the threads.
SHIM = """
extern "C" long long looked_at;
long long looked_at = 0;
%s
extern "C" void run(int threads, const REAL* points, const int* order, const REAL* boxes, const int* lowest, int n,
                    int depth, double limit, double missing, long long* indices, REAL* distances) {
    blockDim.x = 128;
    for (blockIdx.x = 0; blockIdx.x * 128 < threads; ++blockIdx.x)
        for (threadIdx.x = 0; threadIdx.x < 128; ++threadIdx.x)
            nearest(points, order, boxes, lowest, n, depth, limit, missing, indices, distances);
}
"""


class Compile(Protocol):
    """Gives the kernel for a dtype and a number of neighbours, as a launch on the CPU."""

    def __call__(self, dtype: torch.dtype, k: int, looked_at: list[int] | None = None) -> Launch:
        """A list gets the number of points looked at, at each launch."""


@pytest.fixture(scope="module")
def compiled(compile_for_cpu: Callable[..., ctypes.CDLL]) -> Compile:
    look = "const double dx = points"
    assert SOURCE.count(look) == 1
    source = SHIM % SOURCE.replace(look, "++looked_at; " + look)

    def compile_for(dtype: torch.dtype, k: int, looked_at: list[int] | None = None) -> Launch:
        kernel = compile_for_cpu(source, ["-ffp-contract=off", *definitions(dtype, k)])
        counter = ctypes.c_longlong.in_dll(kernel, "looked_at")

        def launch(threads: int, arguments: Sequence[Argument]) -> None:
            assert all(a.is_contiguous() for a in arguments if isinstance(a, Tensor))
            values = [nvrtc._as_c(argument, torch.device("cpu")) for argument in arguments]
            counter.value = 0
            kernel.run(ctypes.c_int(threads), *values)
            if looked_at is not None:
                looked_at.append(counter.value)

        return launch

    return compile_for


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("n", "k"), [(1500, 16), (130, 3), (40, 32)])
def test_kernel_finds_what_all_pairs_give(
    compiled: Compile, cloud: Callable, truth: Callable, dtype: torch.dtype, n: int, k: int
) -> None:
    points = cloud(n).to(dtype)
    indices, distances = search_tree(build_tree(points), k, torch.inf, compiled(dtype, k))
    expected, expected_distances = truth(points, k)
    assert torch.equal(indices, expected)
    assert torch.equal(distances, expected_distances)


@pytest.mark.parametrize("n", [1, 2, 15, 16, 17, 33, 63, 64, 65])
def test_kernel_on_every_shape_of_small_tree(compiled: Compile, truth: Callable, n: int) -> None:
    points = torch.randn(n, 3)
    indices, distances = search_tree(build_tree(points), 3, torch.inf, compiled(torch.float32, 3))
    expected, expected_distances = truth(points, 3)
    found = min(3, n - 1)
    assert torch.equal(indices[:, :found], expected[:, :found])
    assert torch.equal(distances[:, :found], expected_distances[:, :found])
    assert (indices[:, found:] == torch.arange(n)[:, None]).all()
    assert distances[:, found:].isinf().all()


def test_kernel_agrees_with_the_search_on_the_cpu_on_a_larger_field(compiled: Compile, cloud: Callable) -> None:
    points = cloud(30_000).float()
    found = knn(points, 16)
    indices, distances = search_tree(build_tree(points), 16, torch.inf, compiled(torch.float32, 16))
    assert torch.equal(indices, found.indices)
    assert torch.equal(distances, found.distances)


def test_kernel_within_a_radius(compiled: Compile, cloud: Callable) -> None:
    points = cloud(2000).float()
    # A distance that occurs, so that strictly closer means something; and a little more than it.
    occurring = float(knn(points, 6).distances.double().median().clamp_min(1e-6))
    for radius in (occurring, 1.5 * occurring):
        found = radius_neighbors(points, radius, 16)
        indices, distances = search_tree(build_tree(points), 16, radius * radius, compiled(torch.float32, 16))
        assert torch.equal(indices, found.indices)
        assert torch.equal(distances, found.distances)


def test_kernel_takes_the_smallest_number_as_a_radius(compiled: Compile) -> None:
    points = torch.cat([torch.zeros(4, 3), torch.full((1, 3), 1e-30)])
    found = radius_neighbors(points, 1e-170, 2)
    indices, distances = search_tree(build_tree(points), 2, math.ulp(0.0), compiled(torch.float32, 2))
    assert torch.equal(indices, found.indices)
    assert torch.equal(distances, found.distances)


def test_tree_holds_every_point_once_and_its_boxes_are_tight(cloud: Callable) -> None:
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


def test_clones_by_the_thousand_cost_no_more_than_other_points(compiled: Compile) -> None:
    # Counted in points looked at, not in seconds. Without the lowest index of each node, every clone would look at all.
    looked_at: list[int] = []
    for points in (torch.zeros(20_000, 3), torch.randn(20_000, 3)):
        search_tree(build_tree(points), 16, torch.inf, compiled(torch.float32, 16, looked_at))
    clones, others = (count / 20_000 for count in looked_at)
    assert clones < 2 * others  # measured 116 and 114 points a query


def test_kernel_compiles_for_gpus_from_turing_to_hopper() -> None:
    try:
        nvrtc._library("nvrtc")
    except BackendError as error:
        pytest.skip(f"no NVRTC here: {error}")
    cases = [("sm_75", torch.float32, 16), ("sm_90", torch.float64, 1), ("sm_90", torch.float32, MAX_NEIGHBORS)]
    for architecture, dtype, k in cases:
        code = nvrtc.compile_cubin(SOURCE, architecture, [*OPTIONS, *definitions(dtype, k)])
        assert code.startswith(b"\x7fELF")
        assert KERNEL.encode() in code
    with pytest.raises(BackendError, match="does not compile for sm_90.*REAL"):
        nvrtc.compile_cubin(SOURCE, "sm_90")
