"""Hard point sets for neighbour searches."""

import numpy as np
import pytest
import torch
from fields import normal_points

from sundae_ns.graph import neighbors


def _clusters(n):
    """Clusters of 1e-5 and of 1e-2 beside a background of 1e3."""
    points = normal_points(n)
    points[: n // 2] = points[: n // 2] * 1e-5 + 0.5
    points[n // 2 : 3 * n // 4] = points[n // 2 : 3 * n // 4] * 1e-2 - 0.25
    points[3 * n // 4 :] *= 1e3
    return points


def _half_duplicated(n):
    points = _clusters(n)
    points[torch.randperm(n, generator=torch.Generator().manual_seed(1))[: n // 2]] = points[: n // 2].clone()
    return points


def _piles(n):
    """Most points at three spots, one of them the origin with both signs of zero."""
    points = normal_points(n)
    points[: n // 3] = 0.0
    points[: n // 6] = -0.0
    points[n // 3 : n // 2] = 1.0
    points[n // 2 : 3 * n // 4] = torch.tensor([1.0, 1.0, 1.0 + 1e-9], dtype=torch.float64)
    return points


def _lattice(n):
    cells = torch.cartesian_prod(*[torch.arange(int(np.ceil(n ** (1 / 3))), dtype=torch.float64)] * 3)
    return cells[torch.randperm(len(cells), generator=torch.Generator().manual_seed(2))[:n]]


def _sphere(n):
    """Points at the corners of a cube, with many clones, all equally far from the first point."""
    points = torch.zeros(n, 3, dtype=torch.float64)
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=torch.float64)] * 3)
    points[1:] = corners.repeat(n // 8 + 1, 1)[: n - 1]
    return points


CLOUDS = {
    "normal": normal_points,
    "clusters": _clusters,
    "half duplicated": _half_duplicated,
    "piles": _piles,
    "all at one spot": lambda n: torch.full((n, 3), 0.1, dtype=torch.float64),
    "lattice": _lattice,
    "sphere": _sphere,
    "line": lambda n: torch.linspace(-1, 1, n, dtype=torch.float64)[:, None] * torch.eye(3, dtype=torch.float64)[0],
    "plane": lambda n: normal_points(n) * torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64),
    "two clusters 1e6 apart": lambda n: normal_points(n) + torch.arange(n)[:, None] % 2 * 1e6,
    "far from the origin": lambda n: normal_points(n) + 1e5,
    "one floater": lambda n: torch.cat([normal_points(n - 1), torch.full((1, 3), 1e20, dtype=torch.float64)]),
    "tiny": lambda n: normal_points(n) * 1e-30,
}


@pytest.fixture(params=CLOUDS, ids=[name.replace(" ", "-") for name in CLOUDS])
def cloud(request):
    """One distribution: maps a number N to its first N points, float64 ``[N, 3]``."""
    return CLOUDS[request.param]


@pytest.fixture
def on_gpu():
    """Without the kernel, the search on the CPU would be compared with itself."""
    assert neighbors._kernel(torch.device("cuda", torch.cuda.current_device()), torch.float32, 16) is not None
