"""The CPU backend: the stages of the reference in compiled loops, with hand-written derivatives.

The equations are in :mod:`sundae_ns.rasterize.reference`; this module has the backend, the projection and the
harmonics. Their loops read and write the tensors' dtype and compute in float64, which costs little next to the
blending.
"""

from __future__ import annotations

from math import pi, sqrt
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sundae_ns.core.errors import BackendError
from sundae_ns.rasterize import reference
from sundae_ns.rasterize.cpu.compositing import composite
from sundae_ns.rasterize.cpu.parallel import as_array, compiled, parallel_for
from sundae_ns.rasterize.cpu.tiles import build_lists
from sundae_ns.rasterize.reference import BLUR, FOV_MARGIN, MAX_RADIUS, Projection, blended_values
from sundae_ns.rasterize.types import Inputs, Rasterization, result_of, strategy_radii

_MIN_PER_THREAD = 2_500  # Gaussians to project: below 0.1 ms of work, waking a thread costs more than it saves
_MIN_TO_EVALUATE = 5_000
_SHORTEST = 1e-12  # lower bound of a vector's divisor, as in torch's normalize()
_TERMS = 25  # harmonics of degree 4

_write_basis = compiled(reference.write_basis)


class CpuBackend:
    """The reference in compiled loops, for float32 and float64 on a CPU; independent of the number of threads."""

    name = "cpu"

    def rasterize(self, inputs: Inputs) -> Rasterization:
        """Render one view.

        Raises:
            BackendError: The tensors are not float32 or float64 on a CPU.
        """
        _check(inputs.means)
        projection = project(inputs)
        opacities, colors = blended_values(inputs, projection)
        means2d = projection.means2d[None]
        lists = build_lists(projection, opacities, inputs.width, inputs.height)
        image, alpha = composite(means2d, projection.conics, opacities, colors, lists, inputs.absgrad)
        return result_of(image, alpha, means2d, strategy_radii(projection.radii), inputs)

    def spherical_harmonics(self, degree: int, directions: Tensor, coeffs: Tensor) -> Tensor:
        """Sum of harmonics ``[N, 3]`` for directions ``[N, 3]`` (not zero) and coefficients ``[N, K, 3]``.

        Raises:
            BackendError: The tensors are not float32 or float64 on a CPU.
        """
        _check(directions)
        return cast("Tensor", _Harmonics.apply(degree, directions, coeffs))


def _check(tensor: Tensor) -> None:
    if tensor.dtype not in (torch.float32, torch.float64) or tensor.device.type != "cpu":
        raise BackendError(
            f"the cpu rasterizer takes float32 or float64 on a CPU, not {tensor.dtype} on {tensor.device}; "
            "convert, or use 'reference'"
        )


# ---------------------------------------------------------------------------------------------------------- projection


def project(inputs: Inputs) -> Projection:
    """As the reference's, once differentiable; if a camera requires gradients, it is the reference's."""
    if torch.is_grad_enabled() and (inputs.viewmat.requires_grad or inputs.K.requires_grad):
        return reference.project(inputs)
    means = inputs.means
    matrix = as_array(inputs.viewmat.double())
    lens = as_array(inputs.K)[[0, 1, 0, 1], [0, 1, 2, 2]].astype(np.float64)
    size = np.array([inputs.width, inputs.height], dtype=np.float64)
    # Round the planes to the tensors' dtype, as torch does when it compares a tensor with a number.
    planes = np.array([inputs.near_plane, inputs.far_plane], np.float32 if means.dtype == torch.float32 else np.float64)
    camera = (matrix, lens, size, planes.astype(np.float64))
    outputs = _Project.apply(means, inputs.quats, inputs.scales, camera)
    means2d, conics, depths, compensations, covars2d, radii = outputs
    return Projection(means2d, covars2d, conics, depths, compensations, radii)


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quats: Tensor, scales: Tensor, camera: tuple[Any, Any, Any, Any]
    ) -> tuple[Tensor, ...]:
        n = means.shape[0]
        means2d, conics, covars2d = means.new_empty(n, 2), means.new_empty(n, 3), means.new_empty(n, 3)
        depths, compensations = means.new_empty(n), means.new_empty(n)
        radii = torch.empty(n, dtype=torch.int32)
        outputs = (means2d, conics, depths, compensations, covars2d, radii)
        arguments = (*map(as_array, (means, quats, scales)), camera, tuple(map(as_array, outputs)))
        parallel_for(_project, n, *arguments, min_per_thread=_MIN_PER_THREAD)
        ctx.save_for_backward(means, quats, scales)
        ctx.camera = camera
        ctx.mark_non_differentiable(covars2d, radii)
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        inputs = ctx.saved_tensors
        outputs = [torch.empty_like(value, memory_format=torch.contiguous_format) for value in inputs]
        grads_in, grads_out = tuple(map(as_array, grads[:4])), tuple(map(as_array, outputs))
        arguments = (*map(as_array, inputs), grads_in, ctx.camera, grads_out)
        parallel_for(_project_backward, inputs[0].shape[0], *arguments, min_per_thread=_MIN_PER_THREAD)
        return *outputs, None


@compiled
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


@compiled
def _slope_limits(lens: Any, size: Any) -> tuple[float, float, float, float]:
    """Bounds of the slopes at which footprints are linearised: min and max of x / z, min and max of y / z."""
    margin_x, margin_y = FOV_MARGIN * 0.5 * size[0] / lens[0], FOV_MARGIN * 0.5 * size[1] / lens[1]
    return (
        -lens[2] / lens[0] - margin_x,
        (size[0] - lens[2]) / lens[0] + margin_x,
        -lens[3] / lens[1] - margin_y,
        (size[1] - lens[3]) / lens[1] + margin_y,
    )


@compiled
def _to_camera(camera: Any, means: Any, i: int) -> tuple[float, float, float]:
    """Camera coordinates of a centre; z is rounded to the dtype of the centres, in which it is compared."""
    x = camera[0, 0] * means[i, 0] + camera[0, 1] * means[i, 1] + camera[0, 2] * means[i, 2] + camera[0, 3]
    y = camera[1, 0] * means[i, 0] + camera[1, 1] * means[i, 1] + camera[1, 2] * means[i, 2] + camera[1, 3]
    z = camera[2, 0] * means[i, 0] + camera[2, 1] * means[i, 1] + camera[2, 2] * means[i, 2] + camera[2, 3]
    return x, y, float(means.dtype.type(z))


@compiled
def _to_view(camera: Any, rotation: Any, out: Any) -> None:
    """Write a Gaussian's axes in camera coordinates ``[3, 3]``."""
    for r in range(3):
        for c in range(3):
            out[r, c] = camera[r, 0] * rotation[0, c] + camera[r, 1] * rotation[1, c] + camera[r, 2] * rotation[2, c]


@compiled
def _footprint(row_x: Any, row_y: Any, normal: Any) -> tuple[float, float, float, float, float]:
    """Covariance xx, xy, yy before the blur from the rows of its root, and its determinants before and after the blur.

    ``normal`` receives the cross product of the rows.
    """
    xx = row_x[0] * row_x[0] + row_x[1] * row_x[1] + row_x[2] * row_x[2]
    xy = row_x[0] * row_y[0] + row_x[1] * row_y[1] + row_x[2] * row_y[2]
    yy = row_y[0] * row_y[0] + row_y[1] * row_y[1] + row_y[2] * row_y[2]
    normal[0] = row_x[1] * row_y[2] - row_x[2] * row_y[1]
    normal[1] = row_x[2] * row_y[0] - row_x[0] * row_y[2]
    normal[2] = row_x[0] * row_y[1] - row_x[1] * row_y[0]
    sharp_det = normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]
    return xx, xy, yy, sharp_det, sharp_det + BLUR * (xx + yy) + BLUR * BLUR


@compiled
def _project(begin: int, end: int, means: Any, quats: Any, scales: Any, camera: Any, outputs: Any) -> None:
    matrix, lens, size, planes = camera
    means2d, conics, depths, compensations, covars2d, radii = outputs
    rotation, root, row_x, row_y, normal = np.empty((4, 4)), np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    min_x, max_x, min_y, max_y = _slope_limits(lens, size)
    for i in range(begin, end):
        x, y, z = _to_camera(matrix, means, i)
        if not (z >= planes[0] and z <= planes[1] and z > 0):
            means2d[i], conics[i], covars2d[i] = 0, 0, 0
            depths[i], compensations[i], radii[i] = 0, 0, 0
            continue
        centre_x, centre_y = lens[0] * x / z + lens[2], lens[1] * y / z + lens[3]
        _rotation(quats, i, rotation)
        _to_view(matrix, rotation, root)
        slope_x, slope_y = min(max(x / z, min_x), max_x), min(max(y / z, min_y), max_y)
        for c in range(3):
            across, down, along = root[0, c] * scales[i, c], root[1, c] * scales[i, c], root[2, c] * scales[i, c]
            row_x[c], row_y[c] = lens[0] / z * (across - slope_x * along), lens[1] / z * (down - slope_y * along)
        xx, xy, yy, sharp_det, det = _footprint(row_x, row_y, normal)
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
    begin: int, end: int, means: Any, quats: Any, scales: Any, gradients: Any, camera: Any, outputs: Any
) -> None:
    matrix, lens, size, planes = camera
    grad_means2d, grad_conics, grad_depths, grad_compensations = gradients
    grad_means, grad_quats, grad_scales = outputs
    rotation, root, row_x, row_y = np.empty((4, 4)), np.empty((3, 3)), np.empty(3), np.empty(3)
    normal, sharp_x, sharp_y = np.empty(3), np.empty(3), np.empty(3)
    grad_row_x, grad_row_y, grad_root, grad_rotation = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    min_x, max_x, min_y, max_y = _slope_limits(lens, size)
    for i in range(begin, end):
        u, v, depth, blur = grad_means2d[i, 0], grad_means2d[i, 1], grad_depths[i], grad_compensations[i]
        a, b, c = float(grad_conics[i, 0]), float(grad_conics[i, 1]), float(grad_conics[i, 2])
        x, y, z = _to_camera(matrix, means, i)
        culled = not (z >= planes[0] and z <= planes[1] and z > 0)
        no_gradient = u == 0 and v == 0 and depth == 0 and blur == 0 and a == 0 and b == 0 and c == 0
        if culled or no_gradient:
            grad_means[i], grad_quats[i], grad_scales[i] = 0, 0, 0
            continue

        # Recompute the forward pass ...
        length = _rotation(quats, i, rotation)
        _to_view(matrix, rotation, root)
        slope_x, slope_y = min(max(x / z, min_x), max_x), min(max(y / z, min_y), max_y)
        zoom_x, zoom_y = lens[0] / z, lens[1] / z
        for k in range(3):
            sharp_x[k] = (root[0, k] - slope_x * root[2, k]) * scales[i, k]
            sharp_y[k] = (root[1, k] - slope_y * root[2, k]) * scales[i, k]
            row_x[k], row_y[k] = zoom_x * sharp_x[k], zoom_y * sharp_y[k]
        xx, xy, yy, sharp_det, det = _footprint(row_x, row_y, normal)

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
            grad_row_x[k] = 2 * grad_sharp_det * (row_y[n] * normal[m] - row_y[m] * normal[n])
            grad_row_x[k] += 2 * row_x[k] * grad_xx + row_y[k] * grad_xy
            grad_row_y[k] = 2 * grad_sharp_det * (normal[n] * row_x[m] - normal[m] * row_x[n])
            grad_row_y[k] += 2 * row_y[k] * grad_yy + row_x[k] * grad_xy
        # to zoom, slopes, scales and the rotated axes,
        grad_zoom_x = grad_zoom_y = grad_slope_x = grad_slope_y = 0.0
        for k in range(3):
            grad_zoom_x += grad_row_x[k] * sharp_x[k]
            grad_zoom_y += grad_row_y[k] * sharp_y[k]
            inner_x, inner_y = zoom_x * grad_row_x[k], zoom_y * grad_row_y[k]
            inner_z = -(slope_x * inner_x + slope_y * inner_y)
            grad_slope_x -= inner_x * root[2, k] * scales[i, k]
            grad_slope_y -= inner_y * root[2, k] * scales[i, k]
            grad_scales[i, k] = inner_x * root[0, k] + inner_y * root[1, k] + inner_z * root[2, k]
            grad_root[0, k], grad_root[1, k], grad_root[2, k] = inner_x, inner_y, inner_z
        for r in range(3):
            for k in range(3):
                grad_axis = (
                    matrix[0, r] * grad_root[0, k] + matrix[1, r] * grad_root[1, k] + matrix[2, r] * grad_root[2, k]
                )
                grad_rotation[r, k] = grad_axis * scales[i, k]
        # to the centre in camera and world coordinates,
        cam_x, cam_y = zoom_x * u, zoom_y * v
        cam_z = depth - (cam_x * x + cam_y * y + grad_zoom_x * zoom_x + grad_zoom_y * zoom_y) / z
        if min_x <= x / z <= max_x:
            cam_x += grad_slope_x / z
            cam_z -= grad_slope_x * x / (z * z)
        if min_y <= y / z <= max_y:
            cam_y += grad_slope_y / z
            cam_z -= grad_slope_y * y / (z * z)
        for k in range(3):
            grad_means[i, k] = matrix[0, k] * cam_x + matrix[1, k] * cam_y + matrix[2, k] * cam_z
        # and to the quaternion, through its unit form.
        w, p, q, s = rotation[3, 0], rotation[3, 1], rotation[3, 2], rotation[3, 3]
        g = grad_rotation
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


class _Harmonics(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, degree: int, directions: Tensor, coeffs: Tensor) -> Tensor:
        colors = torch.empty_like(directions, memory_format=torch.contiguous_format)
        arrays = [as_array(value) for value in (directions, coeffs, colors)]
        parallel_for(_evaluate, len(directions), degree, *arrays, min_per_thread=_MIN_TO_EVALUATE)
        ctx.degree = degree
        ctx.save_for_backward(directions, coeffs)
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_colors: Tensor) -> tuple[Tensor | None, ...]:
        inputs = ctx.saved_tensors
        outputs = [torch.empty_like(value, memory_format=torch.contiguous_format) for value in inputs]
        arguments = (*map(as_array, (*inputs, grad_colors)), tuple(map(as_array, outputs)))
        parallel_for(_evaluate_backward, len(inputs[0]), ctx.degree, *arguments, min_per_thread=_MIN_TO_EVALUATE)
        return None, *(output if wanted else None for output, wanted in zip(outputs, ctx.needs_input_grad[1:]))


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
