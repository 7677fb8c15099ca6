"""Nothing lost: hand on what primitives that go away have to those that stay."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn.functional import softplus

from sundae_ns.gaussians.covariance import covariances, mean_shadow, scales_and_quaternions

MOST_OPACITY = 0.99
"""Opacities of merged primitives end here, where the logit still has a gradient."""

ROWS = 1 << 16
"""Primitives whose harmonics are added up at once."""


@torch.no_grad()
def merge(params: Mapping[str, Tensor], heir: Tensor, weight: Tensor) -> dict[str, Tensor]:
    """Replace each group of primitives by one with the same moments.

    With the weights w normalised within a group, that is

    - centre and covariance: ``m = sum w_i m_i`` and ``S = sum w_i (S_i + (m_i - m)(m_i - m)^T)``, those of the mixture;
    - harmonics and features: ``sum w_i c_i``;
    - opacity: optical depths ``-log(1 - alpha)`` add up where primitives lie behind each other, and what a
      primitive takes from pictures is its depth times its shadow. So ``t A = sum t_i A_i`` with A the mean shadow over all
      directions: a wall of many small primitives stays as dark, seen from afar, as it was. Volumes would say the same of
      fog, but primitives are flat. At most 0.99.

    Args:
        params: the field, all finite, N primitives.
        heir: index of the primitive that each one is merged into, int64 ``[N]``: the own index for those that stay, -1
            for those that are lost. All others name one that stays.
        weight: what each counts in the mean of its group, not negative ``[N]``.

    Returns:
        Parameters of those that stay, in order, computed in float64 on the CPU and returned like ``params``
        ``[M, ...]``. One whose group is itself alone, has no weight or overflows stays as it is, to the bit.
    """
    source = {name: value.detach().cpu() for name, value in params.items()}
    heir, w = heir.cpu(), weight.detach().double().cpu().nan_to_num(0.0, posinf=0.0).clamp_min(0)
    n = len(heir)
    stays = heir == torch.arange(n)
    place = stays.cumsum(0) - 1
    members = (heir >= 0).nonzero().squeeze(1)
    group = place[heir[members]]
    count = int(stays.sum())

    def total(values: Tensor) -> Tensor:
        return torch.zeros(count, *values.shape[1:], dtype=torch.float64).index_add_(0, group, values)

    w = w[members]
    # Relative to the largest of the group, so that no sum underflows.
    largest = torch.zeros(count, dtype=torch.float64).scatter_reduce_(0, group, w, "amax")
    w = torch.where(largest[group] > 0, w / largest[group], 0.0)
    share = w / total(w)[group].clamp_min(torch.finfo(torch.float64).tiny)

    def mean(values: Tensor) -> Tensor:
        result = torch.zeros(count, values[0].numel(), dtype=torch.float64)
        # In pieces: all harmonics in float64 at once would be twice the field.
        for part in torch.arange(len(members)).split(ROWS):
            flat = values[members[part]].double().reshape(len(part), -1)
            result.index_add_(0, group[part], share[part, None] * flat)
        return result.reshape(count, *values.shape[1:])

    kept = {name: value[stays] for name, value in source.items()}
    origin = kept["means"].double()
    offset = source["means"][members].double() - origin[group]
    shift = total(share[:, None] * offset)
    spread = offset - shift[group]
    scales = source["scales"][members].double().exp()
    covariance = covariances(scales, source["quats"][members].double()) + spread[:, :, None] * spread[:, None, :]
    covariance = total(share[:, None, None] * covariance)
    # Squares that overflow have no axes; the one that stays is left as it is.
    bounded = covariance.isfinite().all(dim=2).all(dim=1)
    deviations, quats = scales_and_quaternions(torch.where(bounded[:, None, None], covariance, 0.0))
    # An axis without any width would have no logarithm; none is made thinner than the thinnest member's.
    thinnest = torch.full((count,), torch.inf, dtype=torch.float64)
    thinnest = thinnest.scatter_reduce_(0, group, scales.amin(dim=1), "amin")
    deviations = deviations.maximum(thinnest[:, None])
    depth = softplus(source["opacities"][members].double().squeeze(1), threshold=40.0)
    merged_depth = total(depth * mean_shadow(scales)) / mean_shadow(deviations)

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
    """The logit of ``1 - exp(-depth)``, which is ``log(exp(depth) - 1)``; depths end at that of the most opacity."""
    most = -torch.log1p(torch.tensor(-MOST_OPACITY, dtype=depth.dtype))
    depth = depth.clamp(torch.finfo(depth.dtype).tiny, float(most))
    return depth + torch.log(-torch.expm1(-depth))
