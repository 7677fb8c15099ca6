"""Real spherical harmonics as polynomials of the unit direction.

The constants normalise each polynomial over the sphere (P.-P. Sloan, "Efficient Spherical Harmonic Evaluation", JCGT
2013). The signs are those of 3DGS: odd orders m carry the Condon-Shortley phase.
"""

from __future__ import annotations

from math import pi, sqrt
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize


def write_basis(degree: int, x: Any, y: Any, z: Any, out: Any) -> None:
    """Write the harmonics of a unit vector to ``out``; numbers, in the cpu backend's loops, or tensors; degree 0 to 4.

    Within a degree l the order m runs from -l to l.
    """
    out[0] = 0.5 / sqrt(pi)
    if degree < 1:
        return
    c = sqrt(3 / (4 * pi))
    out[1], out[2], out[3] = -c * y, c * z, -c * x
    if degree < 2:
        return
    xx, yy, zz = x * x, y * y, z * z
    xy, cos2 = x * y, xx - yy
    c1, c0 = sqrt(15 / (4 * pi)), sqrt(5 / (16 * pi))
    out[4], out[5], out[6], out[7] = c1 * xy, -c1 * y * z, c0 * (3 * zz - 1), -c1 * x * z
    out[8] = 0.5 * c1 * cos2
    if degree < 3:
        return
    cos3, sin3 = x * (xx - 3 * yy), y * (3 * xx - yy)
    c3, c2, c1, c0 = sqrt(35 / (32 * pi)), sqrt(105 / (16 * pi)), sqrt(21 / (32 * pi)), sqrt(7 / (16 * pi))
    inner = 5 * zz - 1
    out[9], out[10], out[11] = -c3 * sin3, 2 * c2 * xy * z, -c1 * y * inner
    out[12], out[13], out[14], out[15] = c0 * z * (5 * zz - 3), -c1 * x * inner, c2 * z * cos2, -c3 * cos3
    if degree < 4:
        return
    c4, c3 = sqrt(315 / (256 * pi)), sqrt(315 / (32 * pi))
    c2, c1, c0 = sqrt(45 / (64 * pi)), sqrt(45 / (32 * pi)), sqrt(9 / (256 * pi))
    inner2, inner1 = 7 * zz - 1, z * (7 * zz - 3)
    out[16], out[17], out[18], out[19] = 4 * c4 * xy * cos2, -c3 * z * sin3, 2 * c2 * xy * inner2, -c1 * y * inner1
    out[20], out[21] = c0 * (zz * (35 * zz - 30) + 3), -c1 * x * inner1
    out[22], out[23], out[24] = c2 * cos2 * inner2, -c3 * z * cos3, c4 * (x * cos3 - y * sin3)


def harmonic_basis(degree: int, directions: Tensor) -> Tensor:
    """Values ``[N, (degree + 1) ** 2]`` of the harmonics for unit directions ``[N, 3]``; see :func:`write_basis`."""
    x, y, z = directions.unbind(-1)
    values: list[Any] = [None] * (degree + 1) ** 2
    write_basis(degree, x, y, z, values)
    return torch.stack([torch.full_like(x, values[0]), *values[1:]], dim=-1)


def evaluate_harmonics(degree: int, directions: Tensor, coeffs: Tensor) -> Tensor:
    """Weighted sum ``[N, 3]`` of harmonics for directions ``[N, 3]`` (not zero) and coefficients ``[N, K, 3]``."""
    basis = harmonic_basis(degree, normalize(directions, dim=-1))
    return (basis[..., None] * coeffs[:, : basis.shape[-1]]).sum(dim=-2)
