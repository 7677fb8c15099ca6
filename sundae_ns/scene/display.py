"""Colours for the viewer: depth, features and filter responses as values in [0, 1]."""

from __future__ import annotations

import torch
from torch import Tensor

COMPONENTS = 3


def fill_depth(depth: Tensor, alpha: Tensor) -> Tensor:
    """Depth ``[H, W, 1]`` with the largest rendered depth in pixels where ``alpha`` is 0."""
    return torch.where(alpha > 0, depth, depth.max())


def principal_components(features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean ``[F]``, first three principal directions ``[F, 3]`` and standard deviations ``[3]`` of features ``[N, F]``.

    With fewer than three channels, the missing directions are zero. Signs are fixed, so displayed colours are stable.
    """
    mean = features.mean(dim=0)
    centred = features - mean
    covariance = centred.T @ centred / max(len(features), 1)
    variances, directions = torch.linalg.eigh(covariance)
    k = min(COMPONENTS, features.shape[1])
    directions = directions[:, -k:].flip(-1)
    signs = torch.where(directions.sum(dim=0) < 0, -1.0, 1.0)
    basis = features.new_zeros(features.shape[1], COMPONENTS)
    basis[:, :k] = directions * signs
    deviations = features.new_zeros(COMPONENTS)
    deviations[:k] = variances[-k:].flip(-1).clamp_min(0).sqrt()
    return mean, basis, deviations


def feature_colors(features: Tensor, mean: Tensor, basis: Tensor, deviations: Tensor, alpha: Tensor) -> Tensor:
    """Rendered features as colours ``[H, W, 3]``; [0, 1] spans three standard deviations to each side of the mean.

    Args:
        features: rendered features ``[H, W, F]``, already weighted by ``alpha``.
        mean, basis, deviations: from :func:`principal_components` of the Gaussians' features.
        alpha: accumulation ``[H, W, 1]``; colours are black where it is 0.
    """
    components = (features - alpha * mean) @ basis
    scaled = components / (6 * deviations.clamp_min(1e-8)) + 0.5 * alpha
    return scaled.clamp(0, 1)


def response_values(response: Tensor) -> Tensor:
    """Rank of each response magnitude ``[N]``, scaled to (0, 1], float32; 0 where the response is not finite."""
    known = torch.isfinite(response)
    order = response[known].argsort().argsort()
    values = torch.zeros_like(response, dtype=torch.float32)
    values[known] = (order + 1).float() / max(int(known.sum()), 1)
    return values
