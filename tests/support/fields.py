"""A random field whose values are spread like those of a trained one."""

from __future__ import annotations

import torch
from torch import Tensor


def random_field(n: int = 600, degree: int = 2, features: int = 5, seed: int = 0) -> dict[str, Tensor]:
    """Parameters of ``n`` Gaussians, float32; quaternions are not normalised, and 0 leaves the features out."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(n, *shape, generator=generator)

    made = {
        "means": normal(3),
        "scales": normal(3) - 5,
        "quats": normal(4),
        "features_dc": normal(3),
        "features_rest": 0.1 * normal((degree + 1) ** 2 - 1, 3),
        "opacities": 2 * normal(1),
    }
    return made | ({"features": normal(features)} if features else {})
