"""Spherical harmonics and their derivatives, one compiled loop each.

The polynomials are those of :mod:`sundae_ns.rasterization.harmonics`. Loops read and write the tensors' dtype, and
compute in float64.
"""

from __future__ import annotations

from math import pi, sqrt
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sundae_ns.rasterization.cpu.parallel import as_array, compiled, parallel_for
from sundae_ns.rasterization.harmonics import write_basis

_MIN_PER_THREAD = 5_000  # primitives
_SHORTEST = 1e-12  # lower bound of a direction's divisor, as in torch's normalize()
_TERMS = 25  # of degree 4

_write_basis = compiled(write_basis)


class _Harmonics(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, degree: int, directions: Tensor, coeffs: Tensor) -> Tensor:
        colors = torch.empty_like(directions, memory_format=torch.contiguous_format)
        arrays = [as_array(value) for value in (directions, coeffs, colors)]
        parallel_for(_evaluate, len(directions), degree, *arrays, min_per_thread=_MIN_PER_THREAD)
        ctx.degree = degree
        ctx.save_for_backward(directions, coeffs)
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_colors: Tensor) -> tuple[Tensor | None, ...]:
        inputs = ctx.saved_tensors
        outputs = [torch.empty_like(value, memory_format=torch.contiguous_format) for value in inputs]
        arguments = (*map(as_array, (*inputs, grad_colors)), tuple(map(as_array, outputs)))
        parallel_for(_evaluate_backward, len(inputs[0]), ctx.degree, *arguments, min_per_thread=_MIN_PER_THREAD)
        return None, *(output if wanted else None for output, wanted in zip(outputs, ctx.needs_input_grad[1:]))


evaluate_harmonics = _Harmonics.apply
""":func:`sundae_ns.rasterization.harmonics.evaluate_harmonics`, once differentiable."""


@compiled
def _evaluate(begin: int, end: int, degree: int, directions: Any, coeffs: Any, colors: Any) -> None:
    basis = np.empty(_TERMS)
    terms = (degree + 1) ** 2
    for i in range(begin, end):
        x, y, z, _ = _unit(directions, i)
        _write_basis(degree, x, y, z, basis)
        red = green = blue = 0.0
        for k in range(terms):
            red += basis[k] * coeffs[i, k, 0]
            green += basis[k] * coeffs[i, k, 1]
            blue += basis[k] * coeffs[i, k, 2]
        colors[i, 0], colors[i, 1], colors[i, 2] = red, green, blue


@compiled
def _evaluate_backward(
    begin: int, end: int, degree: int, directions: Any, coeffs: Any, grad_colors: Any, outputs: Any
) -> None:
    grad_directions, grad_coeffs = outputs
    basis, gains = np.empty(_TERMS), np.empty(_TERMS)
    terms = (degree + 1) ** 2
    for i in range(begin, end):
        red, green, blue = float(grad_colors[i, 0]), float(grad_colors[i, 1]), float(grad_colors[i, 2])
        if red == 0 and green == 0 and blue == 0:
            grad_directions[i], grad_coeffs[i] = 0, 0
            continue
        x, y, z, length = _unit(directions, i)
        _write_basis(degree, x, y, z, basis)
        for k in range(terms):
            gains[k] = red * coeffs[i, k, 0] + green * coeffs[i, k, 1] + blue * coeffs[i, k, 2]
            grad_coeffs[i, k, 0] = red * basis[k]
            grad_coeffs[i, k, 1] = green * basis[k]
            grad_coeffs[i, k, 2] = blue * basis[k]
        grad_coeffs[i, terms:] = 0
        grad_x, grad_y, grad_z = _slope(degree, x, y, z, gains)
        # Only the part across the direction turns it.
        along = x * grad_x + y * grad_y + z * grad_z if length > _SHORTEST else 0.0
        grad_directions[i, 0] = (grad_x - x * along) / length
        grad_directions[i, 1] = (grad_y - y * along) / length
        grad_directions[i, 2] = (grad_z - z * along) / length


@compiled
def _unit(directions: Any, i: int) -> tuple[float, float, float, float]:
    """A direction's unit vector and its length."""
    x, y, z = float(directions[i, 0]), float(directions[i, 1]), float(directions[i, 2])
    length = max(sqrt(x * x + y * y + z * z), _SHORTEST)
    return x / length, y / length, z / length, length


@compiled
def _slope(degree: int, x: float, y: float, z: float, w: Any) -> tuple[float, float, float]:
    """Gradient of the harmonics' sum with weights ``w``: the derivatives of the polynomials."""
    grad_x = grad_y = grad_z = 0.0
    if degree >= 1:
        c = sqrt(3 / (4 * pi))
        grad_x, grad_y, grad_z = -c * w[3], -c * w[1], c * w[2]
    xx, yy, zz = x * x, y * y, z * z
    xy, cos2 = x * y, xx - yy
    if degree >= 2:
        c1, c0 = sqrt(15 / (4 * pi)), sqrt(5 / (16 * pi))
        grad_x += c1 * (y * w[4] - z * w[7] + x * w[8])
        grad_y += c1 * (x * w[4] - z * w[5] - y * w[8])
        grad_z += 6 * c0 * z * w[6] - c1 * (y * w[5] + x * w[7])
    cos3, sin3 = x * (xx - 3 * yy), y * (3 * xx - yy)
    if degree >= 3:
        c3, c2, c1, c0 = sqrt(35 / (32 * pi)), sqrt(105 / (16 * pi)), sqrt(21 / (32 * pi)), sqrt(7 / (16 * pi))
        inner = 5 * zz - 1
        grad_x += 2 * c2 * z * (y * w[10] + x * w[14]) - c1 * inner * w[13] - 3 * c3 * (2 * xy * w[9] + cos2 * w[15])
        grad_y += 2 * c2 * z * (x * w[10] - y * w[14]) - c1 * inner * w[11] - 3 * c3 * (cos2 * w[9] - 2 * xy * w[15])
        grad_z += c2 * (2 * xy * w[10] + cos2 * w[14]) - 10 * c1 * z * (y * w[11] + x * w[13])
        grad_z += 3 * c0 * inner * w[12]
    if degree >= 4:
        c4, c3 = sqrt(315 / (256 * pi)), sqrt(315 / (32 * pi))
        c2, c1, c0 = sqrt(45 / (64 * pi)), sqrt(45 / (32 * pi)), sqrt(9 / (256 * pi))
        inner2, inner1 = 7 * zz - 1, z * (7 * zz - 3)
        grad_x += 4 * c4 * (sin3 * w[16] + cos3 * w[24]) - 3 * c3 * z * (2 * xy * w[17] + cos2 * w[23])
        grad_x += 2 * c2 * inner2 * (y * w[18] + x * w[22]) - c1 * inner1 * w[21]
        grad_y += 4 * c4 * (cos3 * w[16] - sin3 * w[24]) - 3 * c3 * z * (cos2 * w[17] - 2 * xy * w[23])
        grad_y += 2 * c2 * inner2 * (x * w[18] - y * w[22]) - c1 * inner1 * w[19]
        grad_z += 14 * c2 * z * (2 * xy * w[18] + cos2 * w[22]) - c3 * (sin3 * w[17] + cos3 * w[23])
        grad_z += 20 * c0 * z * (7 * zz - 3) * w[20] - 3 * c1 * inner2 * (y * w[19] + x * w[21])
    return grad_x, grad_y, grad_z
