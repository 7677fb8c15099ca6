"""Real spherical harmonics as polynomials of the unit direction.

The constants normalise each polynomial over the sphere (P.-P. Sloan, "Efficient Spherical Harmonic Evaluation", JCGT
2013). The signs are those of 3DGS: odd orders m carry the Condon-Shortley phase.
"""

from __future__ import annotations

from math import pi, sqrt

import torch
from torch import Tensor
from torch.nn.functional import normalize


def harmonic_basis(degree: int, directions: Tensor) -> Tensor:
    """Values ``[N, (degree + 1) ** 2]`` of the harmonics for unit directions ``[N, 3]``; degree 0 to 4.

    Within a degree l the order m runs from -l to l.
    """
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, 0.5 / sqrt(pi))]
    if degree >= 1:
        c = sqrt(3 / (4 * pi))
        values += [-c * y, c * z, -c * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        xy, cos2 = x * y, xx - yy
        c1, c0 = sqrt(15 / (4 * pi)), sqrt(5 / (16 * pi))
        values += [c1 * xy, -c1 * y * z, c0 * (3 * zz - 1), -c1 * x * z, 0.5 * c1 * cos2]
    if degree >= 3:
        cos3, sin3 = x * (xx - 3 * yy), y * (3 * xx - yy)
        c3, c2, c1, c0 = sqrt(35 / (32 * pi)), sqrt(105 / (16 * pi)), sqrt(21 / (32 * pi)), sqrt(7 / (16 * pi))
        inner = 5 * zz - 1
        values += [-c3 * sin3, 2 * c2 * xy * z, -c1 * y * inner, c0 * z * (5 * zz - 3)]
        values += [-c1 * x * inner, c2 * z * cos2, -c3 * cos3]
    if degree >= 4:
        c4, c3 = sqrt(315 / (256 * pi)), sqrt(315 / (32 * pi))
        c2, c1, c0 = sqrt(45 / (64 * pi)), sqrt(45 / (32 * pi)), sqrt(9 / (256 * pi))
        inner2, inner1 = 7 * zz - 1, z * (7 * zz - 3)
        values += [4 * c4 * xy * cos2, -c3 * z * sin3, 2 * c2 * xy * inner2, -c1 * y * inner1]
        values += [c0 * (zz * (35 * zz - 30) + 3), -c1 * x * inner1, c2 * cos2 * inner2, -c3 * z * cos3]
        values += [c4 * (x * cos3 - y * sin3)]
    return torch.stack(values, dim=-1)


def evaluate_harmonics(degree: int, directions: Tensor, coeffs: Tensor) -> Tensor:
    """Weighted sum ``[N, 3]`` of harmonics for directions ``[N, 3]`` (not zero) and coefficients ``[N, K, 3]``."""
    basis = harmonic_basis(degree, normalize(directions, dim=-1))
    return (basis[..., None] * coeffs[:, : basis.shape[-1]]).sum(dim=-2)
