"""The CPU backend: the stages of the reference in compiled loops, with hand-written derivatives.

The equations are in :mod:`sundae_ns.rasterize.reference`; this module has the backend, the projection and the
harmonics. Their loops compute in float64, which costs little next to the blending.
"""

from __future__ import annotations

from math import pi, sqrt
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sundae_ns.rasterize import reference
from sundae_ns.rasterize.cpu.compositing import composite
from sundae_ns.rasterize.cpu.parallel import as_array, borrowing, compiled, inlined, parallel_for
from sundae_ns.rasterize.cpu.tiles import MIN_PER_THREAD
from sundae_ns.rasterize.reference import BLUR, FOV_MARGIN, MAX_RADIUS, Projection, blended
from sundae_ns.rasterize.types import Inputs, Rasterization

_SHORTEST = 1e-12  # lower bound of a vector's divisor, as in torch's normalize()
_TERMS = 25  # harmonics of degree 4

_write_basis = borrowing(reference.write_basis)


class CpuBackend:
    """The reference in compiled loops, for tensors on a CPU."""

    name = "cpu"

    def rasterize(self, inputs: Inputs) -> Rasterization:
        """Render one view."""
        return blended(inputs, project(inputs), composite)

    def spherical_harmonics(self, degree: int, directions: Tensor, first: Tensor, rest: Tensor) -> Tensor:
        """See :meth:`.Backend.spherical_harmonics`."""
        outputs = (torch.empty_like(directions, memory_format=torch.contiguous_format),)
        loops = _evaluate, _evaluate_backward, MIN_PER_THREAD
        options = degree, rest.shape[1] * rest.requires_grad
        return cast("Tensor", _Loops.apply(loops, options, outputs, 1, directions, first, rest)[0])


class _Loops(torch.autograd.Function):
    """A function of N rows, once differentiable, from two compiled loops; its first outputs have gradients."""

    # They are called as forward(begin, end, options, *inputs, outputs) and
    # backward(begin, end, options, *inputs, gradients, outputs).

    @staticmethod
    def forward(
        ctx: Any, loops: Any, options: Any, outputs: tuple[Tensor, ...], differentiable: int, *inputs: Tensor
    ) -> tuple[Tensor, ...]:
        ctx.loops, ctx.options, ctx.differentiable = loops, options, differentiable
        arguments = (options, *map(as_array, inputs), tuple(map(as_array, outputs)))
        parallel_for(loops[0], len(inputs[0]), *arguments, min_per_thread=loops[2])
        ctx.save_for_backward(*inputs)
        ctx.mark_non_differentiable(*outputs[differentiable:])
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        inputs = ctx.saved_tensors
        outputs = [torch.empty_like(value, memory_format=torch.contiguous_format) for value in inputs]
        gradients = tuple(map(as_array, grads[: ctx.differentiable]))
        arguments = (ctx.options, *map(as_array, inputs), gradients, tuple(map(as_array, outputs)))
        parallel_for(ctx.loops[1], len(inputs[0]), *arguments, min_per_thread=ctx.loops[2])
        wanted = ctx.needs_input_grad[4:]
        return None, None, None, None, *(output if want else None for output, want in zip(outputs, wanted))


# ---------------------------------------------------------------------------------------------------------- projection


def project(inputs: Inputs) -> Projection:
    """As the reference's, once differentiable; if a camera requires gradients, it is the reference's."""
    viewmat, K, width, height, _ = inputs.camera
    if torch.is_grad_enabled() and (viewmat.requires_grad or K.requires_grad):
        return reference.project(inputs)
    means = inputs.means
    lens = as_array(K)[[0, 1, 0, 1], [0, 1, 2, 2]].astype(np.float64)
    size = np.array([width, height], dtype=np.float64)
    # Footprints are linearised at slopes x / z and y / z from limits[0] to limits[1].
    focal, centre = lens[:2], lens[2:]
    margin = FOV_MARGIN * 0.5 * size / focal
    limits = np.stack([-centre / focal - margin, (size - centre) / focal + margin])
    # Round the planes to the tensors' dtype, as torch does when it compares a tensor with a number.
    planes = np.array([inputs.near_plane, inputs.far_plane], np.float32 if means.dtype == torch.float32 else np.float64)
    camera = (as_array(viewmat.double()), lens, size, planes.astype(np.float64), limits)
    n = len(means)
    new = (*(means.new_empty(n, *size) for size in ((2,), (3,), (), (), (3,))), means.new_empty(n, dtype=torch.int32))
    loops = _project, _project_backward, MIN_PER_THREAD
    outputs = _Loops.apply(loops, camera, new, 4, means, inputs.quats, inputs.scales)
    means2d, conics, depths, compensations, covars2d, radii = outputs
    return Projection(means2d, covars2d, conics, depths, compensations, radii)


@borrowing
def _rotation(quats: Any, i: int, out: Any) -> float:
    """Write a quaternion's rotation matrix ``[3, 3]`` and its unit form ``[3, :]``; return its length."""
    w, x, y, z = float(quats[i, 0]), float(quats[i, 1]), float(quats[i, 2]), float(quats[i, 3])
    length = max(sqrt(w * w + x * x + y * y + z * z), _SHORTEST)
    w, x, y, z = w / length, x / length, y / length, z / length
    out[0, 0], out[0, 1], out[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    out[1, 0], out[1, 1], out[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    out[2, 0], out[2, 1], out[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    out[3, 0], out[3, 1], out[3, 2], out[3, 3] = w, x, y, z
    return length


@borrowing
def _to_camera(camera: Any, means: Any, i: int) -> tuple[float, float, float, bool]:
    """Camera coordinates of a centre, and whether z, rounded to the dtype of the centres, is between the planes."""
    matrix, _, _, planes, _ = camera
    x = matrix[0, 0] * means[i, 0] + matrix[0, 1] * means[i, 1] + matrix[0, 2] * means[i, 2] + matrix[0, 3]
    y = matrix[1, 0] * means[i, 0] + matrix[1, 1] * means[i, 1] + matrix[1, 2] * means[i, 2] + matrix[1, 3]
    z = matrix[2, 0] * means[i, 0] + matrix[2, 1] * means[i, 1] + matrix[2, 2] * means[i, 2] + matrix[2, 3]
    z = float(means.dtype.type(z))
    return x, y, z, z >= planes[0] and z <= planes[1] and z > 0


@compiled
def _arrays() -> Any:
    """Arrays that :func:`_footprint` fills for a Gaussian: rotation, axes, two rows before and after zoom, normal."""
    return np.empty((4, 4)), np.empty((3, 3)), np.empty((2, 3)), np.empty((2, 3)), np.empty(3)


@inlined
def _footprint(camera: Any, quats: Any, scales: Any, i: int, x: float, y: float, z: float, arrays: Any) -> Any:
    """Length of the quaternion, slopes, zooms, covariance before the blur, and its determinants before and after."""
    # The zoomed rows are a root of the covariance; normal is their cross product.
    matrix, lens, _, _, limits = camera
    rotation, axes, sharp, rows, normal = arrays
    length = _rotation(quats, i, rotation)
    slope_x, slope_y = min(max(x / z, limits[0, 0]), limits[1, 0]), min(max(y / z, limits[0, 1]), limits[1, 1])
    zoom_x, zoom_y = lens[0] / z, lens[1] / z
    for c in range(3):
        for r in range(3):
            axes[r, c] = matrix[r, 0] * rotation[0, c] + matrix[r, 1] * rotation[1, c] + matrix[r, 2] * rotation[2, c]
        across, down, along = axes[0, c] * scales[i, c], axes[1, c] * scales[i, c], axes[2, c] * scales[i, c]
        sharp[0, c], sharp[1, c] = across - slope_x * along, down - slope_y * along
        rows[0, c], rows[1, c] = zoom_x * sharp[0, c], zoom_y * sharp[1, c]
    xx = rows[0, 0] * rows[0, 0] + rows[0, 1] * rows[0, 1] + rows[0, 2] * rows[0, 2]
    xy = rows[0, 0] * rows[1, 0] + rows[0, 1] * rows[1, 1] + rows[0, 2] * rows[1, 2]
    yy = rows[1, 0] * rows[1, 0] + rows[1, 1] * rows[1, 1] + rows[1, 2] * rows[1, 2]
    for k in range(3):
        n, m = (k + 1) % 3, (k + 2) % 3
        normal[k] = rows[0, n] * rows[1, m] - rows[0, m] * rows[1, n]
    sharp_det = normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]
    return length, slope_x, slope_y, zoom_x, zoom_y, xx, xy, yy, sharp_det, sharp_det + BLUR * (xx + yy) + BLUR * BLUR


@compiled
def _project(begin: int, end: int, camera: Any, means: Any, quats: Any, scales: Any, outputs: Any) -> None:
    _, lens, size, _, _ = camera
    means2d, conics, depths, compensations, covars2d, radii = outputs
    arrays = _arrays()
    for i in range(begin, end):
        x, y, z, in_range = _to_camera(camera, means, i)
        if not in_range:
            means2d[i], conics[i], covars2d[i] = 0, 0, 0
            depths[i], compensations[i], radii[i] = 0, 0, 0
            continue
        centre_x, centre_y = lens[0] * x / z + lens[2], lens[1] * y / z + lens[3]
        _, _, _, _, _, xx, xy, yy, sharp_det, det = _footprint(camera, quats, scales, i, x, y, z, arrays)
        xx, yy = xx + BLUR, yy + BLUR
        means2d[i, 0], means2d[i, 1], depths[i] = centre_x, centre_y, z
        covars2d[i, 0], covars2d[i, 1], covars2d[i, 2] = xx, xy, yy
        conics[i, 0], conics[i, 1], conics[i, 2] = yy / det, -xy / det, xx / det
        compensations[i] = sqrt(sharp_det / det)

        spread = sqrt(max(0.25 * (xx - yy) * (xx - yy) + xy * xy, 0.01))
        radius = min(np.ceil(3.0 * sqrt(0.5 * (xx + yy) + spread)), MAX_RADIUS)
        inside_x = centre_x + radius > 0 and centre_x - radius < size[0]
        inside_y = centre_y + radius > 0 and centre_y - radius < size[1]
        radii[i] = np.int32(radius) if inside_x and inside_y else 0


@compiled
def _project_backward(
    begin: int, end: int, camera: Any, means: Any, quats: Any, scales: Any, gradients: Any, outputs: Any
) -> None:
    matrix, _, _, _, limits = camera
    grad_means2d, grad_conics, grad_depths, grad_compensations = gradients
    grad_means, grad_quats, grad_scales = outputs
    arrays = _arrays()
    rotation, axes, sharp, rows, normal = arrays
    grad_rows, grad_axes, g = np.empty((2, 3)), np.empty((3, 3)), np.empty((3, 3))
    for i in range(begin, end):
        u, v, depth, blur = grad_means2d[i, 0], grad_means2d[i, 1], grad_depths[i], grad_compensations[i]
        a, b, c = float(grad_conics[i, 0]), float(grad_conics[i, 1]), float(grad_conics[i, 2])
        x, y, z, in_range = _to_camera(camera, means, i)
        no_gradient = u == 0 and v == 0 and depth == 0 and blur == 0 and a == 0 and b == 0 and c == 0
        if no_gradient or not in_range:
            grad_means[i], grad_quats[i], grad_scales[i] = 0, 0, 0
            continue

        # Recompute the forward pass ...
        footprint = _footprint(camera, quats, scales, i, x, y, z, arrays)
        length, slope_x, slope_y, zoom_x, zoom_y, xx, xy, yy, sharp_det, det = footprint

        # ... and differentiate: from conic and compensation to the covariance and its determinants,
        grad_det = -(a * (yy + BLUR) - b * xy + c * (xx + BLUR)) / (det * det)
        grad_xx, grad_xy, grad_yy = c / det, -b / det, a / det
        grad_sharp_det = 0.0
        ratio = sharp_det / det
        if ratio > 0:
            grad_ratio = 0.5 * blur / sqrt(ratio)
            grad_sharp_det += grad_ratio / det
            grad_det -= grad_ratio * ratio / det
        grad_sharp_det += grad_det
        grad_xx += BLUR * grad_det
        grad_yy += BLUR * grad_det
        # to the rows of its root (the sharp determinant is the squared length of their cross product),
        for k in range(3):
            n, m = (k + 1) % 3, (k + 2) % 3
            grad_rows[0, k] = 2 * grad_sharp_det * (rows[1, n] * normal[m] - rows[1, m] * normal[n])
            grad_rows[0, k] += 2 * rows[0, k] * grad_xx + rows[1, k] * grad_xy
            grad_rows[1, k] = 2 * grad_sharp_det * (normal[n] * rows[0, m] - normal[m] * rows[0, n])
            grad_rows[1, k] += 2 * rows[1, k] * grad_yy + rows[0, k] * grad_xy
        # to zoom, slopes, scales and the rotated axes,
        grad_zoom_x = grad_zoom_y = grad_slope_x = grad_slope_y = 0.0
        for k in range(3):
            grad_zoom_x += grad_rows[0, k] * sharp[0, k]
            grad_zoom_y += grad_rows[1, k] * sharp[1, k]
            inner_x, inner_y = zoom_x * grad_rows[0, k], zoom_y * grad_rows[1, k]
            inner_z = -(slope_x * inner_x + slope_y * inner_y)
            grad_slope_x -= inner_x * axes[2, k] * scales[i, k]
            grad_slope_y -= inner_y * axes[2, k] * scales[i, k]
            grad_scales[i, k] = inner_x * axes[0, k] + inner_y * axes[1, k] + inner_z * axes[2, k]
            grad_axes[0, k], grad_axes[1, k], grad_axes[2, k] = inner_x, inner_y, inner_z
        for r in range(3):
            for k in range(3):
                along = matrix[0, r] * grad_axes[0, k] + matrix[1, r] * grad_axes[1, k] + matrix[2, r] * grad_axes[2, k]
                g[r, k] = along * scales[i, k]
        # to the centre in camera and world coordinates,
        cam_x, cam_y = zoom_x * u, zoom_y * v
        cam_z = depth - (cam_x * x + cam_y * y + grad_zoom_x * zoom_x + grad_zoom_y * zoom_y) / z
        if limits[0, 0] <= x / z <= limits[1, 0]:
            cam_x += grad_slope_x / z
            cam_z -= grad_slope_x * x / (z * z)
        if limits[0, 1] <= y / z <= limits[1, 1]:
            cam_y += grad_slope_y / z
            cam_z -= grad_slope_y * y / (z * z)
        for k in range(3):
            grad_means[i, k] = matrix[0, k] * cam_x + matrix[1, k] * cam_y + matrix[2, k] * cam_z
        # and to the quaternion, through its unit form.
        w, p, q, s = rotation[3, 0], rotation[3, 1], rotation[3, 2], rotation[3, 3]
        grad_w = 2 * (s * (g[1, 0] - g[0, 1]) + q * (g[0, 2] - g[2, 0]) + p * (g[2, 1] - g[1, 2]))
        grad_p = 2 * (q * (g[0, 1] + g[1, 0]) + s * (g[0, 2] + g[2, 0]) + w * (g[2, 1] - g[1, 2]))
        grad_p -= 4 * p * (g[1, 1] + g[2, 2])
        grad_q = 2 * (p * (g[0, 1] + g[1, 0]) + s * (g[1, 2] + g[2, 1]) + w * (g[0, 2] - g[2, 0]))
        grad_q -= 4 * q * (g[0, 0] + g[2, 2])
        grad_s = 2 * (p * (g[0, 2] + g[2, 0]) + q * (g[1, 2] + g[2, 1]) + w * (g[1, 0] - g[0, 1]))
        grad_s -= 4 * s * (g[0, 0] + g[1, 1])
        radial = w * grad_w + p * grad_p + q * grad_q + s * grad_s if length > _SHORTEST else 0.0
        grad_quats[i, 0], grad_quats[i, 1] = (grad_w - w * radial) / length, (grad_p - p * radial) / length
        grad_quats[i, 2], grad_quats[i, 3] = (grad_q - q * radial) / length, (grad_s - s * radial) / length


# ----------------------------------------------------------------------------------------------------------- harmonics


@compiled
def _evaluate(begin: int, end: int, options: Any, directions: Any, first: Any, rest: Any, outputs: Any) -> None:
    (degree, _), (colors,) = options, outputs
    basis = np.empty(_TERMS)
    for i in range(begin, end):
        x, y, z, _ = _unit(directions, i)
        _write_basis(degree, x, y, z, basis)
        red, green, blue = basis[0] * first[i, 0], basis[0] * first[i, 1], basis[0] * first[i, 2]
        for k in range((degree + 1) ** 2 - 1):
            red += basis[k + 1] * rest[i, k, 0]
            green += basis[k + 1] * rest[i, k, 1]
            blue += basis[k + 1] * rest[i, k, 2]
        colors[i, 0], colors[i, 1], colors[i, 2] = red, green, blue


@compiled
def _evaluate_backward(
    begin: int, end: int, options: Any, directions: Any, first: Any, rest: Any, gradients: Any, outputs: Any
) -> None:
    (degree, wanted), (grad_colors,) = options, gradients
    grad_directions, grad_first, grad_rest = outputs
    basis, gains = np.empty(_TERMS), np.empty(_TERMS)
    terms = (degree + 1) ** 2
    for i in range(begin, end):
        red, green, blue = float(grad_colors[i, 0]), float(grad_colors[i, 1]), float(grad_colors[i, 2])
        if red == 0 and green == 0 and blue == 0:
            grad_directions[i], grad_first[i], grad_rest[i, :wanted] = 0, 0, 0
            continue
        x, y, z, length = _unit(directions, i)
        _write_basis(degree, x, y, z, basis)
        grad_first[i, 0], grad_first[i, 1], grad_first[i, 2] = red * basis[0], green * basis[0], blue * basis[0]
        for k in range(terms - 1):
            gains[k + 1] = red * rest[i, k, 0] + green * rest[i, k, 1] + blue * rest[i, k, 2]
            if wanted:
                grad_rest[i, k, 0] = red * basis[k + 1]
                grad_rest[i, k, 1] = green * basis[k + 1]
                grad_rest[i, k, 2] = blue * basis[k + 1]
        grad_rest[i, terms - 1 : wanted] = 0
        grad_x, grad_y, grad_z = _slope(degree, x, y, z, gains)
        # Only the part across the direction turns it.
        radial = x * grad_x + y * grad_y + z * grad_z if length > _SHORTEST else 0.0
        grad_directions[i, 0] = (grad_x - x * radial) / length
        grad_directions[i, 1] = (grad_y - y * radial) / length
        grad_directions[i, 2] = (grad_z - z * radial) / length


@borrowing
def _unit(directions: Any, i: int) -> tuple[float, float, float, float]:
    """A direction's unit vector and its length."""
    x, y, z = float(directions[i, 0]), float(directions[i, 1]), float(directions[i, 2])
    length = max(sqrt(x * x + y * y + z * z), _SHORTEST)
    return x / length, y / length, z / length, length


@borrowing
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
