"""The tree of boxes, and the kernel that searches it, compiled for the CPU from the same source."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from typing import Protocol

import pytest
import torch
from torch import Tensor

from sundae_ns.errors import BackendError
from sundae_ns.gpu import nvrtc
from sundae_ns.gpu.nvrtc import Argument, Launch
from sundae_ns.graphs import knn
from sundae_ns.graphs.traversal import FILE, KERNEL, MAX_NEIGHBORS, OPTIONS, definitions, search_tree
from sundae_ns.graphs.tree import LEAF, build_tree

# The kernel's source with a counter of visited points, and a loop over the threads.
SHIM = """
extern "C" long long visited;
long long visited = 0;
%s
extern "C" void run(int threads, const REAL* points, const int* order, const REAL* boxes, const int* lowest, int n,
                    int depth, double infinity, long long* indices, REAL* distances) {
    blockDim.x = 128;
    for (blockIdx.x = 0; blockIdx.x * 128 < threads; ++blockIdx.x)
        for (threadIdx.x = 0; threadIdx.x < 128; ++threadIdx.x)
            nearest(points, order, boxes, lowest, n, depth, infinity, indices, distances);
}
"""


class Compile(Protocol):
    """Compiles the kernel for a dtype and a number of neighbours; returns a launch on the CPU."""

    def __call__(self, dtype: torch.dtype, k: int, visited: list[int] | None = None) -> Launch:
        """Each launch appends the number of visited points to ``visited``."""


@pytest.fixture(scope="module")
def compiled(compile_for_cpu: Callable[..., ctypes.CDLL]) -> Compile:
    visit = "const double dx = points"
    source = nvrtc.read_source(FILE)
    assert source.count(visit) == 1
    source = SHIM % source.replace(visit, "++visited; " + visit)

    def compile_for(dtype: torch.dtype, k: int, visited: list[int] | None = None) -> Launch:
        kernel = compile_for_cpu(source, ["-ffp-contract=off", *definitions(dtype, k)])
        counter = ctypes.c_longlong.in_dll(kernel, "visited")

        def launch(threads: int, arguments: Sequence[Argument]) -> None:
            assert all(a.is_contiguous() for a in arguments if isinstance(a, Tensor))
            values = [nvrtc._as_c(argument, torch.device("cpu")) for argument in arguments]
            counter.value = 0
            kernel.run(ctypes.c_int(threads), *values)
            if visited is not None:
                visited.append(counter.value)

        return launch

    return compile_for


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("n", "k"), [(700, 16), (130, 3), (40, 32)])
def test_kernel_matches_all_pairs(
    compiled: Compile, cloud: Callable, truth: Callable, dtype: torch.dtype, n: int, k: int
) -> None:
    points = cloud(n).to(dtype)
    indices, distances = search_tree(build_tree(points), k, compiled(dtype, k))
    expected, expected_distances = truth(points, k)
    assert torch.equal(indices, expected)
    assert torch.equal(distances, expected_distances)


@pytest.mark.parametrize("n", [2, 15, 16, 17, 33, 63, 64, 65])
def test_kernel_on_every_shape_of_small_tree(compiled: Compile, truth: Callable, n: int) -> None:
    points, k = torch.randn(n, 3), min(3, n - 1)
    indices, distances = search_tree(build_tree(points), k, compiled(torch.float32, k))
    expected, expected_distances = truth(points, k)
    assert torch.equal(indices, expected)
    assert torch.equal(distances, expected_distances)


def test_kernel_agrees_with_the_search_on_the_cpu_on_a_larger_field(compiled: Compile, cloud: Callable) -> None:
    points = cloud(10_000).float()
    found = knn(points, 16)
    indices, distances = search_tree(build_tree(points), 16, compiled(torch.float32, 16))
    assert torch.equal(indices, found.indices)
    assert torch.equal(distances, found.distances)


def test_tree_holds_every_point_once_in_tight_boxes(cloud: Callable) -> None:
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


def test_thousands_of_clones_visit_no_more_points_than_others(compiled: Compile) -> None:
    # Counts visited points, not seconds. Without the lowest index of each node, every clone would visit all others.
    visited: list[int] = []
    for points in (torch.zeros(20_000, 3), torch.randn(20_000, 3)):
        search_tree(build_tree(points), 16, compiled(torch.float32, 16, visited))
    clones, others = (count / 20_000 for count in visited)
    assert clones < 2 * others  # measured 116 and 114 points per query


def test_kernel_compiles_for_gpus_from_turing_to_hopper() -> None:
    try:
        nvrtc._library("nvrtc")
    except BackendError as error:
        pytest.skip(f"no NVRTC here: {error}")
    cases = [("sm_75", torch.float32, 16), ("sm_90", torch.float64, 1), ("sm_90", torch.float32, MAX_NEIGHBORS)]
    for architecture, dtype, k in cases:
        code = nvrtc.compile_cubin(FILE, architecture, [*OPTIONS, *definitions(dtype, k)])
        assert code.startswith(b"\x7fELF")
        assert KERNEL.encode() in code
    with pytest.raises(BackendError, match="does not compile for sm_90.*REAL"):
        nvrtc.compile_cubin(FILE, "sm_90")
