"""Similarity transforms of Gaussians, and the order of their centres along a space-filling curve (Morton, 1966)."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sundae_ns.core.covariance import quaternions
from sundae_ns.core.gaussians import sh_degree
from sundae_ns.rasterize.reference import harmonic_basis

Direction = tuple[float, float, float]
MAX_BITS = 21  # of a coordinate; three fit in 64 bits
FINE_STEP = 1e-5  # of float32 at the centres, as a share of their distances: from it on they are moved
_SPREADS = [(32, 0x001F00000000FFFF), (16, 0x001F0000FF0000FF), (8, 0x100F00F00F00F00F)]
_SPREADS += [(4, 0x10C30C30C30C30C3), (2, 0x1249249249249249)]


def multiply_quaternions(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product of wxyz quaternions ``[..., 4]``: rotates by ``b``, then by ``a``."""
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    w = aw * bw - (av * bv).sum(dim=-1, keepdim=True)
    return torch.cat([w, aw * bv + bw * av + torch.linalg.cross(*torch.broadcast_tensors(av, bv))], dim=-1)


def rotate_spherical_harmonics(features_rest: Tensor, rotation: Tensor) -> Tensor:
    """SH coefficients of the rotated function: ``f'(R d) = f(d)``.

    A rotation maps the functions of each degree onto themselves. Its matrix follows from their values on 64 directions
    before and after the rotation, to 12 decimals: the errors of further ones differ between runs.

    ``features_rest`` are coefficients ``[N, K, 3]`` of degrees 1 and up. ``rotation`` ``[..., 3, 3]`` may be a
    reflection; the result is ``[..., N, K, 3]``.
    """
    max_degree = sh_degree(features_rest)
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(64, 3, generator=generator, dtype=torch.float64), dim=1)
    after = harmonic_basis(max_degree, directions @ rotation.double().cpu().mT)
    before = harmonic_basis(max_degree, directions).expand_as(after)
    rotated = features_rest.new_empty(*rotation.shape[:-2], *features_rest.shape)
    for degree in range(1, max_degree + 1):
        columns = slice(degree**2, (degree + 1) ** 2)
        matrix = torch.linalg.lstsq(after[..., columns], before[..., columns]).solution.round(decimals=12)
        rows = slice(degree**2 - 1, (degree + 1) ** 2 - 1)
        rotated[..., rows, :] = torch.einsum("...ij,njc->...nic", matrix.to(features_rest), features_rest[:, rows])
    return rotated


def similarity(params: Mapping[str, Tensor], transform: Tensor, scale: float) -> dict[str, Tensor]:
    """Gaussians moved by ``x -> scale * (R x + t)``; ``transform`` ``[..., 3, 4]`` has rotation R and translation t.

    R may be a reflection too. Opacities, SH coefficients of degree 0 and features are the tensors of ``params``; the
    others become ``[..., N, C]``, means in their own dtype.
    """
    rotation, translation = transform[..., :3].to(params["means"]), transform[..., None, :, 3].to(params["means"])
    # An ellipsoid is the same after a point reflection.
    proper = rotation * rotation.det().sign()[..., None, None]
    turn = quaternions(proper.double().reshape(-1, 3, 3)).reshape(*rotation.shape[:-2], 1, 4)
    moved = dict(params)
    moved["means"] = scale * (params["means"] @ rotation.mT + translation)
    moved["scales"] = params["scales"] + math.log(scale)
    moved["quats"] = multiply_quaternions(turn.to(params["quats"]), params["quats"])
    moved["features_rest"] = rotate_spherical_harmonics(params["features_rest"], rotation)
    return moved


def _sample(means: Tensor, most: int) -> NDArray[np.float64]:
    """Up to ``most`` centres ``[M, 3]`` whose squares are in the range of float32, evenly from all."""
    points = means[:: -(-len(means) // most) or 1].double().numpy()
    return points[(np.abs(points) < 1e18).all(axis=1)]


def recentred(means: Tensor) -> tuple[Tensor, Direction | None]:
    """Centres ``[N, 3]`` in float32, and what was subtracted in float64 where float32 is too coarse; None for nothing.

    Survey coordinates lie millions of metres from the origin, where float32 has steps of half a metre.
    """
    points = _sample(means, 10_000)
    middle = np.median(points, axis=0) if len(points) else np.zeros(3)
    distance = float(np.median(np.linalg.norm(points - middle, axis=1))) if len(points) else 0.0
    step = float(np.spacing(np.float32(np.abs(middle).max().clip(max=1e30))))
    if not step > FINE_STEP * distance > 0:
        return means.float(), None
    unit = 2.0 ** math.floor(math.log2(distance))  # a short number, without rounding
    x, y, z = (np.round(middle / unit) * unit).tolist()
    return (means.double() - torch.tensor([x, y, z], dtype=torch.float64)).float(), (x, y, z)


def upward(means: Tensor, convention: Direction) -> tuple[Direction, bool]:
    """Upward direction of centres ``[N, 3]``, and whether the scene's ground shows it, not the ``convention``.

    The ground is the largest of planes through three centres (RANSAC; Fischler and Bolles, 1981), above which are most
    others. A ground within 45 degrees of the convention holds at least a fifth of the centres; of +z or +y, two fifths.
    """
    points = _sample(means, 1024).astype(np.float32)
    if len(points) < 100:
        return convention, False
    points = points - np.median(points, axis=0)
    corners = points[np.random.default_rng(0).integers(len(points), size=(3, 512))]
    normals = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-30)
    heights = points @ normals.T - (corners[0] * normals).sum(axis=1)
    reach = 0.02 * np.median(np.linalg.norm(points, axis=1))
    above, below = (heights > reach).mean(axis=0), (heights < -reach).mean(axis=0)
    share = np.where(np.abs(above - below) > 0.6 * (above + below), 1 - above - below, 0)
    normals = np.where(above < below, -normals.T, normals.T)
    for direction, least in ((convention, 0.2), ((0.0, 0.0, 1.0), 0.4), ((0.0, 1.0, 0.0), 0.4)):
        near = share * (direction @ normals > 0.7)  # within 45 degrees
        normal = normals[:, near.argmax()]
        if near.max() >= least:
            return direction if direction @ normal > 0.99 else tuple(normal.tolist()), True
    return convention, False


def interleave(cells: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Codes ``[N]`` of cells ``[N, 3]`` with coordinates below 2^21; the first coordinate takes the lowest bit."""
    code = np.zeros(len(cells), np.uint64)
    for axis in range(3):
        x = cells[:, axis].astype(np.uint64)
        for shift, mask in _SPREADS:
            x = (x | (x << np.uint64(shift))) & np.uint64(mask)
        code |= x << np.uint64(axis)
    return code


def separate(codes: NDArray[np.uint64], axis: int) -> NDArray[np.uint64]:
    """One coordinate ``[N]`` of the cells of codes ``[N]``."""
    x = codes >> np.uint64(axis)
    x &= np.uint64(_SPREADS[-1][1])
    masks = [mask for _, mask in _SPREADS[-2::-1]] + [(1 << MAX_BITS) - 1]
    for (shift, _), mask in zip(_SPREADS[::-1], masks, strict=True):
        x |= x >> np.uint64(shift)
        x &= np.uint64(mask)
    return x


def scene_order(means: NDArray[np.float32]) -> tuple[NDArray[np.int64], int]:
    """Permutation ``[N]`` of finite centres ``[N, 3]`` along a space-filling curve, far ones last; number of others.

    Coordinates are centred on their medians and compressed by an inverse hyperbolic sine, so that a few far Gaussians
    do not push all others into one cell. Far ones, beyond 30 times the spread, come by powers of two of the distance.
    """
    centred = means.astype(np.float64) - np.median(means, axis=0)
    reach = np.abs(centred)
    # Of a street, two coordinates of three are small: those along it are not far away.
    spread = max(np.median(reach), np.median(reach.max(axis=1)) / 8) or reach.mean() or 1.0
    bent = np.arcsinh(centred / spread)
    low, extent = bent.min(axis=0), np.ptp(bent, axis=0).max() or 1.0
    shells = np.ceil(np.log2((reach.max(axis=1) / spread / 30).clip(min=1)))
    codes = interleave(((bent - low) / extent * (2**MAX_BITS - 1)).astype(np.uint64))
    return np.lexsort((codes, shells)), int((shells == 0).sum())
