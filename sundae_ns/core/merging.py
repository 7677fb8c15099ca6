"""Merging: replace groups of Gaussians by one Gaussian with the same moments."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import torch
from torch import Tensor
from torch.nn.functional import softplus

from sundae_ns.core.covariance import chunks, covariances, mean_projected_area, scales_and_quaternions

MAX_OPACITY = 0.99  # upper limit of merged opacities, at which the logit still has a gradient


@torch.no_grad()
def merge(params: Mapping[str, Tensor], label: Tensor, weight: Tensor) -> dict[str, Tensor]:
    """Replace each group of Gaussians by one with the same moments.

    With weights w normalised within a group:

    - centre and covariance are those of the mixture: ``m = sum w_i m_i``, ``S = sum w_i (S_i + (m_i - m)(m_i - m)^T)``;
    - SH coefficients and features are ``sum w_i c_i``;
    - opacity follows from ``t A = sum t_i A_i``, with optical depth ``t = -log(1 - alpha)`` and mean projected area A:
      a wall of many small Gaussians absorbs as much light from afar as before. Limited to ``MAX_OPACITY``.

    Of finite Gaussians, ``label`` ``[N]`` is the index of that which each one is merged into: its own if it stays, -1
    if it is dropped. ``weight`` ``[N]`` in its group is not negative. Returns those that stay, in order, computed in
    float64. One that is alone, has no weight or overflows is unchanged, bit for bit.
    """
    source = {name: value.detach() for name, value in params.items()}
    device = source["means"].device
    label = label.to(device)
    stays = label == torch.arange(len(label), device=device)
    members = (label >= 0).nonzero().squeeze(1)
    group = (stays.cumsum(0) - 1)[label[members]]
    count = int(stays.sum())

    def total(values: Callable[[slice], Tensor], *shape: int) -> Tensor:
        # In chunks: values of all members in float64 would take several times the memory of the scene.
        result = torch.zeros(count, *shape, dtype=torch.float64, device=device)
        for rows in chunks(len(members)):
            if result.is_cuda:  # there index_add_ adds in any order
                result.index_put_((group[rows],), values(rows), accumulate=True)
            else:
                result.index_add_(0, group[rows], values(rows))
        return result

    def of(name: str, rows: slice) -> Tensor:
        return source[name][members[rows]].double()

    w = weight.detach().to(device).double().nan_to_num(0.0, posinf=0.0).clamp_min(0)[members]
    # Divide by the largest weight of the group first, so that no sum underflows.
    largest = w.new_zeros(count).scatter_reduce_(0, group, w, "amax")
    w = torch.where(largest[group] > 0, w / largest[group], 0.0)
    normalized = w / total(lambda rows: w[rows])[group].clamp_min(torch.finfo(torch.float64).tiny)

    def mean(name: str) -> Tensor:
        shape = source[name].shape[1:]
        return total(lambda rows: normalized[rows, None] * of(name, rows).flatten(1), shape.numel()).view(count, *shape)

    kept = {name: value[stays] for name, value in source.items()}
    origin = kept["means"].double()

    def offset(rows: slice) -> Tensor:
        return of("means", rows) - origin[group[rows]]

    shift = total(lambda rows: normalized[rows, None] * offset(rows), 3)

    def moments(rows: slice) -> Tensor:
        spread = offset(rows) - shift[group[rows]]
        covariance = covariances(of("scales", rows).exp(), of("quats", rows)) + spread[:, :, None] * spread[:, None, :]
        return normalized[rows, None, None] * covariance

    # A covariance that overflows has no finite widths, so its Gaussian stays unchanged.
    deviations, quats = scales_and_quaternions(total(moments, 3, 3))
    # A width of zero has no logarithm; limit each axis to the thinnest axis of the members.
    thinnest = torch.full_like(largest, torch.inf)
    for rows in chunks(len(members)):
        thinnest.scatter_reduce_(0, group[rows], of("scales", rows).exp().amin(dim=1), "amin")
    deviations = deviations.maximum(thinnest[:, None])

    def cover(rows: slice) -> Tensor:
        depth = softplus(of("opacities", rows).squeeze(1), threshold=40.0)
        return depth * mean_projected_area(of("scales", rows).exp())

    merged = {name: mean(name) for name in source if name not in ("means", "scales", "quats", "opacities")}
    merged |= {"means": origin + shift, "scales": deviations.log(), "quats": quats}
    depth = (total(cover) / mean_projected_area(deviations)).clamp(torch.finfo(w.dtype).tiny, -math.log1p(-MAX_OPACITY))
    merged["opacities"] = (depth + torch.log(-torch.expm1(-depth)))[:, None]  # logit of 1 - exp(-depth)
    changed = (torch.bincount(group, minlength=count) > 1) & (largest > 0)
    for value in merged.values():
        changed &= value.reshape(count, -1).isfinite().all(dim=1)
    result = {name: value.clone() for name, value in kept.items()}
    for name, value in result.items():
        value[changed] = merged[name][changed].to(value.dtype)
    return result
