"""Random fields: one whose values are spread like those of a trained one, and one of normal values."""

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


def normal_field(
    n: int = 60,
    means: Tensor | None = None,
    *,
    degree: int = 1,
    features: int = 0,
    seed: int = 0,
    dtype: torch.dtype = torch.float32,
) -> dict[str, Tensor]:
    """Normal parameters, centres too unless they are given; then with their number and dtype."""
    generator = torch.Generator().manual_seed(seed)
    rest = (degree + 1) ** 2 - 1
    shapes = {"means": (3,), "scales": (3,), "quats": (4,), "features_dc": (3,), "features_rest": (rest, 3)}
    shapes |= {"opacities": (1,)} | ({"features": (features,)} if features else {})
    n, dtype = (n, dtype) if means is None else (len(means), means.dtype)
    made = {name: torch.randn(n, *shape, generator=generator).to(dtype) for name, shape in shapes.items()}
    return made if means is None else {**made, "means": means}
