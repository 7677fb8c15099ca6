"""Similarity transforms of a field: centres, scales, rotations and spherical harmonics."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from sundae_ns.gaussians.covariance import quaternions
from sundae_ns.gaussians.parameters import sh_degree
from sundae_ns.rasterization.reference import harmonic_basis


def multiply_quaternions(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product of wxyz quaternions ``[..., 4]``: rotates by ``b``, then by ``a``."""
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    w = aw * bw - (av * bv).sum(dim=-1, keepdim=True)
    return torch.cat([w, aw * bv + bw * av + torch.linalg.cross(av.expand_as(bv), bv)], dim=-1)


def rotate_spherical_harmonics(features_rest: Tensor, rotation: Tensor) -> Tensor:
    """SH coefficients of the rotated function: ``f'(R d) = f(d)``.

    A rotation maps the functions of each degree onto themselves. Its matrix follows exactly from their values on 64
    directions before and after the rotation.

    Args:
        features_rest: ``[N, K, 3]`` coefficients of degrees 1 and up, K = (degree + 1)^2 - 1.
        rotation: ``[3, 3]``.
    """
    max_degree = sh_degree(features_rest)
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(64, 3, generator=generator, dtype=torch.float64), dim=1)
    before = harmonic_basis(max_degree, directions)
    after = harmonic_basis(max_degree, directions @ rotation.double().cpu().T)
    rotated = features_rest.clone()
    for degree in range(1, max_degree + 1):
        columns = slice(degree**2, (degree + 1) ** 2)
        matrix = torch.linalg.lstsq(after[:, columns], before[:, columns]).solution
        rows = slice(degree**2 - 1, (degree + 1) ** 2 - 1)
        rotated[:, rows] = torch.einsum("ij,njc->nic", matrix.to(features_rest), features_rest[:, rows])
    return rotated


def similarity(params: Mapping[str, Tensor], transform: Tensor, scale: float) -> dict[str, Tensor]:
    """A field moved by ``x -> scale * (R x + t)``; ``transform`` ``[3, 4]`` holds rotation R and translation t.

    Opacities, SH coefficients of degree 0 and features are the tensors of ``params``.
    """
    rotation, translation = transform[:, :3].to(params["means"]), transform[:, 3].to(params["means"])
    moved = dict(params)
    moved["means"] = scale * (params["means"] @ rotation.T + translation)
    turn = quaternions(rotation.double()[None])[0].to(rotation)
    moved["scales"] = params["scales"] + math.log(scale)
    moved["quats"] = multiply_quaternions(turn, params["quats"])
    moved["features_rest"] = rotate_spherical_harmonics(params["features_rest"], rotation)
    return moved
