"""Random fields, like trained ones or of normal values, and the comparison of two."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import normalize

from sundae_ns.core.covariance import covariances
from sundae_ns.core.gaussians import sh_degree
from sundae_ns.rasterize.reference import harmonic_basis


def random_field(n: int = 600, degree: int = 2, features: int = 5, seed: int = 0) -> dict[str, Tensor]:
    """Parameters of ``n`` Gaussians, float32; quaternions are not normalised, and 0 leaves the features out."""
    made = normal_field(n, degree=degree, features=features, seed=seed)
    for name, factor, shift in (("scales", 1, -5), ("features_rest", 0.1, 0), ("opacities", 2, 0)):
        made[name] = factor * made[name] + shift
    return made


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


def matched(found: Mapping[str, Tensor], truth: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The Gaussians that were found, in the order of the true ones, by the nearest centres."""
    rows = torch.from_numpy(cKDTree(found["means"].numpy()).query(truth["means"].numpy())[1])
    assert len(rows.unique()) == len(truth["means"])
    return {name: value[rows] for name, value in found.items()}


def assert_close(found: Mapping[str, Tensor], truth: Mapping[str, Tensor], tolerances: Mapping[str, float]) -> None:
    """Compare fields in any order: opacities as shares, rotations up to length and sign."""
    assert set(tolerances) <= set(found) == set(truth)
    for name, value in matched(found, truth).items():
        expected = truth[name]
        if name == "opacities":
            value, expected = value.sigmoid(), expected.sigmoid()
        elif name == "quats":
            value, expected = normalize(value), normalize(expected)
            value = value * (value * expected).sum(dim=1, keepdim=True).sign()
        tolerance = tolerances.get(name, 0.0)
        torch.testing.assert_close(value, expected, rtol=0, atol=tolerance, msg=lambda text, n=name: f"{n}: {text}")


def normal_points(n: int = 60, seed: int = 0) -> Tensor:
    """Points of a normal distribution, float64 ``[n, 3]``."""
    return torch.randn(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def assert_moved(
    found: Mapping[str, Tensor],
    truth: Mapping[str, Tensor],
    turn: Tensor,
    shift: Tensor | float = 0.0,
    scale: float = 1.0,
    atol: float = 1e-5,
) -> None:
    """Compare a field with another one that is turned, then shifted and scaled: centres, shapes and colours."""
    directions = normalize(torch.randn(9, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    shapes, colors = [], []
    for field, seen in ((found, directions @ turn.T.double()), (truth, directions)):
        shapes.append(covariances(field["scales"].double().exp(), field["quats"].double()))
        rest = field["features_rest"].double()
        colors.append(torch.einsum("dk,nkc->ndc", harmonic_basis(sh_degree(rest), seen)[:, 1:], rest))
    turn = turn.double()
    means = scale * (truth["means"].double() @ turn.T + shift)
    torch.testing.assert_close(found["means"].double(), means, rtol=0, atol=atol)
    torch.testing.assert_close(shapes[0], scale**2 * turn @ shapes[1] @ turn.T, rtol=0, atol=atol)
    torch.testing.assert_close(colors[0], colors[1], rtol=0, atol=atol)
    for name in ("opacities", "features_dc"):
        assert torch.equal(found[name], truth[name]), name
