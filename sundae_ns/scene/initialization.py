"""Initial Gaussians: from a sparse point cloud, or random."""

from __future__ import annotations

import torch
from torch import Tensor

from sundae_ns.core.errors import DataError
from sundae_ns.core.gaussians import rgb_to_sh
from sundae_ns.graph.neighbors import knn

INITIAL_OPACITY = 0.1


def random_quaternions(n: int, generator: torch.Generator | None = None) -> Tensor:
    """Uniformly distributed unit quaternions ``[n, 4]`` (Shoemake, 1992)."""
    u, v, w = torch.rand(3, n, generator=generator)
    a, b = (1 - u).sqrt(), u.sqrt()
    v, w = 2 * torch.pi * v, 2 * torch.pi * w
    return torch.stack([a * v.sin(), a * v.cos(), b * w.sin(), b * w.cos()], dim=-1)


def random_points(n: int, extent: float, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
    """Random points ``[n, 3]`` in a cube of side ``extent`` around the origin, and colours ``[n, 3]`` in [0, 1]."""
    return (torch.rand(n, 3, generator=generator) - 0.5) * extent, torch.rand(n, 3, generator=generator)


def from_points(
    points: Tensor, rgb: Tensor, *, sh_degree: int, num_features: int, generator: torch.Generator | None = None
) -> dict[str, Tensor]:
    """Parameters of one Gaussian for each point, float32, on the device of ``points`` ``[N, 3]``; ``rgb`` is in [0, 1].

    The standard deviation is the mean distance to the three nearest neighbours (3DGS, Kerbl et al. 2023); of coincident
    points the smallest positive one. Points or colours that are not finite are dropped; ``DataError`` if all are.
    """
    finite = torch.isfinite(points).all(dim=1) & torch.isfinite(rgb).all(dim=1)
    points, rgb = points[finite].float(), rgb[finite].float()
    n = points.shape[0]
    if n == 0:
        raise DataError("the point cloud holds no finite point; check the capture, or start with --random-init True")
    device = points.device
    width = torch.ones(n, device=device)
    if n > 1:
        width = knn(points, min(3, n - 1)).distances.mean(dim=1).to(points)
        positive = width[width > 0]
        width = width.clamp_min(float(positive.min()) if len(positive) else 1e-3)
    params = {
        "means": points.clone(),
        "scales": width.log()[:, None].repeat(1, 3),
        "quats": random_quaternions(n, generator).to(device),
        "features_dc": rgb_to_sh(rgb),
        "features_rest": torch.zeros(n, (sh_degree + 1) ** 2 - 1, 3, device=device),
        "opacities": torch.logit(torch.full((n, 1), INITIAL_OPACITY, device=device)),
    }
    if num_features:
        params["features"] = initial_features(params["features_dc"], num_features, generator)
    return params


def initial_features(features_dc: Tensor, num_features: int, generator: torch.Generator | None = None) -> Tensor:
    """Initial feature vectors ``[N, F]``: small noise, plus ``features_dc`` ``[N, 3]`` in the first three channels."""
    features = (0.05 * torch.randn(len(features_dc), num_features, generator=generator)).to(features_dc)
    channels = min(3, num_features)
    features[:, :channels] += features_dc[:, :channels]
    return features
