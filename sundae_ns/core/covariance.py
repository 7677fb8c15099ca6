"""Rotations and covariances of Gaussians, their overlap and their projected area."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor
from torch.nn.functional import normalize

PAIRS = 1 << 18  # pairs of Gaussians whose overlap is computed at once; they take about 50 MiB
ROWS = 1 << 16  # Gaussians whose matrices are computed at once; they take about 40 MiB
LOWER = ([0, 1, 2, 1, 2, 2], [0, 1, 2, 0, 0, 1])  # rows and columns of a symmetric matrix's entries, diagonal first


def rotation_matrices(quats: Tensor) -> Tensor:
    """Rotation matrices ``[N, 3, 3]`` of wxyz quaternions ``[N, 4]`` of any length; all-zero ones give the identity."""
    w, x, y, z = normalize(quats, dim=-1).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([entry for row in rows for entry in row], dim=-1).reshape(-1, 3, 3)


def covariances(scales: Tensor, quats: Tensor) -> Tensor:
    """Covariances ``R S S^T R^T`` ``[N, 3, 3]`` of standard deviations ``[N, 3]`` and wxyz quaternions ``[N, 4]``."""
    half = rotation_matrices(quats) * scales[:, None, :]
    return half @ half.transpose(1, 2)


def entries_of(params: Mapping[str, Tensor]) -> Tensor:
    """The six different entries of covariances, diagonal first, float64 on the device of the Gaussians ``[N, 6]``."""
    scales, quats = params["scales"].detach(), params["quats"].detach()
    result = torch.empty(len(scales), 6, dtype=torch.float64, device=scales.device)
    for rows in chunks(len(scales)):
        result[rows] = covariances(scales[rows].double().exp(), quats[rows].double())[:, LOWER[0], LOWER[1]]
    return result


def chunks(n: int, size: int | None = None) -> Iterator[slice]:
    """Consecutive slices of at most ``size`` of ``n`` rows, by default `ROWS`, to limit the memory of temporaries."""
    size = size or ROWS
    return (slice(first, min(first + size, n)) for first in range(0, n, size))


def quaternions(m: Tensor) -> Tensor:
    """Unit wxyz quaternions ``[N, 4]`` of rotation matrices ``m`` ``[N, 3, 3]``."""
    xx, yy, zz = m.diagonal(dim1=1, dim2=2).unbind(dim=1)
    squares = torch.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz], dim=1)
    wx, wy, wz = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    xy, xz, yz = m[:, 0, 1] + m[:, 1, 0], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 2] + m[:, 2, 1]
    w, x, y, z = squares.unbind(dim=1)
    # Row i is 4 q_i q.
    rows = (w, wx, wy, wz), (wx, x, xy, xz), (wy, xy, y, yz), (wz, xz, yz, z)
    products = torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)
    largest = squares.argmax(dim=1)  # at least one half; the others are divided by it
    chosen = products[torch.arange(len(m), device=m.device), largest]
    return chosen / torch.linalg.vector_norm(chosen, dim=1, keepdim=True)


def scales_and_quaternions(matrices: Tensor) -> tuple[Tensor, Tensor]:
    """Standard deviations ``[N, 3]``, ascending, and unit quaternions ``[N, 4]`` of covariances ``[N, 3, 3]``."""
    # By Jacobi's method: LAPACK takes the matrices one by one, and CUDA's solver limits their number.
    a = [list(row.unbind(dim=1)) for row in matrices.unbind(dim=1)]
    v = [list(row.unbind(dim=1)) for row in torch.eye(3).to(matrices).expand_as(matrices).unbind(dim=1)]
    for _ in range(6):  # the error squares with each sweep, and five reach the rounding of float64
        for p, q, r in ((0, 1, 2), (0, 2, 1), (1, 2, 0)):
            gap, twice = a[q][q] - a[p][p], 2 * a[p][q]
            below = gap.abs() + torch.hypot(gap, twice)
            tangent = torch.where(below > 0, twice * torch.where(gap < 0, -1.0, 1.0) / below, 0.0)
            cosine = (tangent.square() + 1).rsqrt()
            sine = tangent * cosine
            a[p][p], a[q][q] = a[p][p] - tangent * a[p][q], a[q][q] + tangent * a[p][q]
            a[p][q] = a[q][p] = torch.zeros_like(gap)
            a[p][r], a[q][r] = cosine * a[p][r] - sine * a[q][r], sine * a[p][r] + cosine * a[q][r]
            a[r][p], a[r][q] = a[p][r], a[q][r]
            for row in v:
                row[p], row[q] = cosine * row[p] - sine * row[q], sine * row[p] + cosine * row[q]
    values, order = torch.stack([a[axis][axis] for axis in range(3)], dim=1).sort(dim=1)
    axes = torch.stack([torch.stack(row, dim=1) for row in v], dim=1).gather(2, order[:, None].expand_as(matrices))
    axes[:, :, 2] = torch.linalg.cross(axes[:, :, 0], axes[:, :, 1])  # of determinant 1 in every order
    return values.clamp_min(0).sqrt(), quaternions(axes)


def mean_projected_area(scales: Tensor) -> Tensor:
    """Mean projected area of ellipsoids with half axes ``[N, 3]``, divided by pi ``[N]`` (Cauchy; Thomsen, to 1.1%)."""
    exponent = 1.6075
    a, b, c = (scales / scales.amax(dim=1, keepdim=True)).pow(exponent).unbind(dim=1)
    return scales.amax(dim=1).square() * ((a * b + a * c + b * c) / 3).pow(1 / exponent)


def overlap(means: Tensor, entries: Tensor, first: Tensor, second: Tensor, least_variance: float = 0.0) -> Tensor:
    """Bhattacharyya coefficient of Gaussians with others, in [0, 1]; 1 for equal ones, 0 where it overflows.

    ``exp(-(d^T S^-1 d) / 8) (|A| |B|)^(1/4) / |S|^(1/2)`` with ``S = (A + B) / 2`` (Bhattacharyya, 1943). ``entries``
    are by :func:`entries_of`; ``first`` and ``second`` are indices ``[P]``, or ``[P, 1]`` and ``[P, K]`` of neighbours.
    Without ``least_variance``, added to all axes, parallel flat Gaussians would not overlap however close they are.
    """
    first, second = first.to(means.device), second.to(means.device)
    entries = entries + least_variance * entries.new_tensor([1, 1, 1, 0, 0, 0]) if least_variance else entries
    log_det, points = entries.new_empty(len(means)), means.double()
    asked = torch.bincount(torch.cat([first.flatten(), second.flatten()]), minlength=len(means)).nonzero().squeeze(1)
    for rows in asked.split(ROWS):
        log_det[rows] = 2 * torch.stack(_cholesky(entries[rows], least_variance)[:3], dim=1).log().sum(dim=1)
    result = torch.empty(second.shape, dtype=means.dtype, device=means.device)
    for rows in chunks(len(second), max(1, PAIRS // max(1, second[:1].numel()))):
        i, j = first[rows], second[rows]
        a, b, c, ba, ca, cb = _cholesky((entries[i] + entries[j]) / 2, least_variance)
        x, y, z = (points[i] - points[j]).unbind(dim=-1)
        x = x / a
        y = (y - ba * x) / b
        z = (z - ca * x - cb * y) / c
        exponent = -(x * x + y * y + z * z) / 8 + (log_det[i] + log_det[j]) / 4 - (a.log() + b.log() + c.log())
        result[rows] = exponent.clamp_max(0).exp().nan_to_num(0.0).to(means.dtype)
    return result


def _cholesky(entries: Tensor, least_variance: float) -> tuple[Tensor, ...]:
    """Cholesky factors ``[...]`` of symmetric matrices with entries ``[..., 6]``, both in the order of ``LOWER``."""
    # Written out, because the batched function calls LAPACK once per matrix. A pivot is never below the least
    # eigenvalue, so clamping at a lower bound of it repairs pivots of needles that rounding made too small.
    xx, yy, zz, yx, zx, zy = entries.unbind(dim=-1)
    a = xx.clamp_min(least_variance).sqrt()
    ba, ca = yx / a, zx / a
    b = (yy - ba * ba).clamp_min(least_variance).sqrt()
    cb = (zy - ca * ba) / b
    return a, b, (zz - ca * ca - cb * cb).clamp_min(least_variance).sqrt(), ba, ca, cb
