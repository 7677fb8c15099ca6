"""Point sets to measure on: one like a trained field, and ones that are hard for neighbour searches."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

import torch
from torch import Tensor

from sundae_ns.errors import ConfigError

Distribution = Literal["field", "clusters", "duplicates", "uniform"]


def draw(distribution: Distribution, n: int, seed: int) -> Tensor:
    """Draw positions, float32 on the CPU ``[n, 3]``.

    - ``field``: a thousand discs with equal counts, 0.001 to 3 units wide and a fiftieth as thick, so spacings differ a
      thousandfold; one point in 50 is a floater, out to 100 units; one in 100 is a clone of another, as after
      densification.
    - ``clusters``: half in clusters of 1e-5, a quarter in clusters of 1e-2, the rest spread over 1e3.
    - ``duplicates``: as ``clusters``, but half of all points coincide with another.
    - ``uniform``: in the unit cube.

    Raises:
        ConfigError: the distribution is unknown, or ``n`` is less than 1.
    """
    if distribution not in get_args(Distribution):
        raise ConfigError(f"unknown distribution {distribution!r}: use one of {', '.join(get_args(Distribution))}")
    if n < 1:
        raise ConfigError(f"{n} points cannot be measured: use at least 1")
    generator = torch.Generator().manual_seed(seed)
    makers: dict[str, Callable[[int, torch.Generator], Tensor]] = {
        "field": _field,
        "clusters": _clusters,
        "duplicates": lambda n, g: _cloned(_clusters(n, g), 0.5, g),
        "uniform": lambda n, g: torch.rand(n, 3, generator=g, dtype=torch.float64),
    }
    return makers[distribution](n, generator).float()


def _normal(n: int, generator: torch.Generator) -> Tensor:
    return torch.randn(n, 3, generator=generator, dtype=torch.float64)


def _field(n: int, generator: torch.Generator) -> Tensor:
    patches = 1000
    frames = torch.linalg.qr(torch.randn(patches, 3, 3, generator=generator, dtype=torch.float64)).Q
    radii = 10 ** (3.5 * torch.rand(patches, generator=generator, dtype=torch.float64) - 3)
    frames = frames * torch.stack([radii, radii, radii / 50], dim=1)[:, None, :]
    centres = _normal(patches, generator)
    patch = torch.randint(patches, (n,), generator=generator)
    points = centres[patch] + torch.einsum("nij,nj->ni", frames[patch], _normal(n, generator))
    fog = n // 50
    reach = 10 ** (2 * torch.rand(fog, 1, generator=generator, dtype=torch.float64))
    points[:fog] = torch.nn.functional.normalize(_normal(fog, generator)) * reach
    return _cloned(points, 0.01, generator)


def _clusters(n: int, generator: torch.Generator) -> Tensor:
    points = _normal(n, generator)
    for part, clusters, width in ((slice(0, n // 2), 50, 1e-5), (slice(n // 2, 3 * n // 4), 50, 1e-2)):
        # Near the origin: float32 must tell the points of a cluster of 1e-5 apart.
        centres = 1e-3 * _normal(clusters, generator)
        cluster = torch.randint(clusters, (len(points[part]),), generator=generator)
        points[part] = centres[cluster] + width * points[part]
    points[3 * n // 4 :] *= 1e3
    return points[torch.randperm(n, generator=generator)]


def _cloned(points: Tensor, share: float, generator: torch.Generator) -> Tensor:
    """The points, with a share of them moved onto others."""
    order = torch.randperm(len(points), generator=generator)
    count = min(round(share * len(points)), len(points) // 2)
    cloned = points.clone()
    cloned[order[:count]] = points[order[len(points) - count :]]
    return cloned
