"""Merging: replace groups of primitives by one primitive with the same moments."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn.functional import softplus

from sundae_ns.gaussians.covariance import covariances, mean_projected_area, scales_and_quaternions

MAX_OPACITY = 0.99
"""Upper limit of merged opacities, at which the logit still has a gradient."""

ROWS = 1 << 16
"""Primitives whose coefficients are converted to float64 at once."""


@torch.no_grad()
def merge(params: Mapping[str, Tensor], label: Tensor, weight: Tensor) -> dict[str, Tensor]:
    """Replace each group of primitives by one with the same moments.

    With weights w normalised within a group:

    - centre and covariance are those of the mixture: ``m = sum w_i m_i``, ``S = sum w_i (S_i + (m_i - m)(m_i - m)^T)``;
    - SH coefficients and features are ``sum w_i c_i``;
    - opacity follows from ``t A = sum t_i A_i``, with optical depth ``t = -log(1 - alpha)`` and mean projected area A:
      a wall of many small primitives absorbs as much light from afar as before. Limited to ``MAX_OPACITY``. Volumes in
      place of areas would suit fog, but primitives are flat.

    Args:
        params: the field, all finite, N primitives.
        label: index of the primitive that each one is merged into, int64 ``[N]``: its own index for a primitive that
            stays, -1 for one that is dropped, else the index of one that stays.
        weight: weight of each primitive in its group, not negative ``[N]``.

    Returns:
        Parameters ``[M, ...]`` of the primitives that stay, in order, with dtype and device of ``params``; computed in
        float64 on the CPU. A primitive whose group is itself alone, has no weight or overflows is unchanged, bit for
        bit.
    """
    source = {name: value.detach().cpu() for name, value in params.items()}
    label, w = label.cpu(), weight.detach().double().cpu().nan_to_num(0.0, posinf=0.0).clamp_min(0)
    n = len(label)
    stays = label == torch.arange(n)
    place = stays.cumsum(0) - 1
    members = (label >= 0).nonzero().squeeze(1)
    group = place[label[members]]
    count = int(stays.sum())

    def total(values: Tensor) -> Tensor:
        return torch.zeros(count, *values.shape[1:], dtype=torch.float64).index_add_(0, group, values)

    w = w[members]
    # Divide by the largest weight of the group first, so that no sum underflows.
    largest = torch.zeros(count, dtype=torch.float64).scatter_reduce_(0, group, w, "amax")
    w = torch.where(largest[group] > 0, w / largest[group], 0.0)
    normalized = w / total(w)[group].clamp_min(torch.finfo(torch.float64).tiny)

    def mean(values: Tensor) -> Tensor:
        result = torch.zeros(count, values[0].numel(), dtype=torch.float64)
        # In chunks: all coefficients in float64 would take twice the memory of the field.
        for chunk in torch.arange(len(members)).split(ROWS):
            flat = values[members[chunk]].double().reshape(len(chunk), -1)
            result.index_add_(0, group[chunk], normalized[chunk, None] * flat)
        return result.reshape(count, *values.shape[1:])

    kept = {name: value[stays] for name, value in source.items()}
    origin = kept["means"].double()
    offset = source["means"][members].double() - origin[group]
    shift = total(normalized[:, None] * offset)
    spread = offset - shift[group]
    scales = source["scales"][members].double().exp()
    covariance = covariances(scales, source["quats"][members].double()) + spread[:, :, None] * spread[:, None, :]
    covariance = total(normalized[:, None, None] * covariance)
    # A covariance that overflows has no axes; its primitive stays unchanged.
    bounded = covariance.isfinite().all(dim=2).all(dim=1)
    deviations, quats = scales_and_quaternions(torch.where(bounded[:, None, None], covariance, 0.0))
    # A width of zero has no logarithm; limit each axis to the thinnest axis of the members.
    thinnest = torch.full((count,), torch.inf, dtype=torch.float64)
    thinnest = thinnest.scatter_reduce_(0, group, scales.amin(dim=1), "amin")
    deviations = deviations.maximum(thinnest[:, None])
    depth = softplus(source["opacities"][members].double().squeeze(1), threshold=40.0)
    merged_depth = total(depth * mean_projected_area(scales)) / mean_projected_area(deviations)

    merged = {name: mean(value) for name, value in source.items() if name not in _WITH_MOMENTS}
    merged["means"] = origin + shift
    merged["scales"] = deviations.log()
    merged["quats"] = quats
    merged["opacities"] = _logit_of_depth(merged_depth)[:, None]
    changed = (torch.bincount(group, minlength=count) > 1) & (largest > 0) & bounded
    for value in merged.values():
        changed &= value.reshape(count, -1).isfinite().all(dim=1)
    result = {}
    for name, value in kept.items():
        value = value.clone()
        value[changed] = merged[name][changed].to(value.dtype)
        result[name] = value.to(params[name].device)
    return result


_WITH_MOMENTS = ("means", "scales", "quats", "opacities")


def _logit_of_depth(depth: Tensor) -> Tensor:
    """Logit of the opacity ``1 - exp(-depth)``, which is ``log(exp(depth) - 1)``; opacity at most ``MAX_OPACITY``."""
    max_depth = -torch.log1p(torch.tensor(-MAX_OPACITY, dtype=depth.dtype))
    depth = depth.clamp(torch.finfo(depth.dtype).tiny, float(max_depth))
    return depth + torch.log(-torch.expm1(-depth))
