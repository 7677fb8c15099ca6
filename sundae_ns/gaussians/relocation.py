"""Growth of a field by copies, as in "3D Gaussian Splatting as Markov Chain Monte Carlo" (Kheradmand et al., 2024).

N copies of a primitive at its place must render like the primitive. Opacities ``o' = 1 - (1 - o)^(1/N)`` preserve the
opacity at the centre; equation 9 of the paper gives the scale that preserves the integral along a ray. Its double sum
over binomials is a single sum, because ``sum_{i=1..N} C(i-1, k) = C(N, k+1)``:

    sigma' = sigma * o / sum_{j=1..N} C(N, j) (-1)^(j-1) o'^j / sqrt(j)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, MutableMapping

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

from sundae_ns.gaussians.surgery import change_parameter, moments_of

MAX_COPIES = 51
"""Larger numbers of copies are clamped to this: the terms of the alternating sum grow with N."""


def split_evenly(opacities: Tensor, scales: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity and scale of each of ``copies`` primitives that together render like one.

    Args:
        opacities: in (0, 1) ``[M]``.
        scales: standard deviations, any unit ``[M, 3]``.
        copies: number of copies including the original, at least 1 ``[M]``.

    Returns:
        Opacities ``[M]`` and scales ``[M, 3]``, with the dtype of the arguments.
    """
    n = copies.clamp(1, MAX_COPIES).to(torch.float64)
    old = opacities.to(torch.float64)
    new = 1 - (1 - old) ** (1 / n)
    j = torch.arange(1, MAX_COPIES + 1, dtype=torch.float64, device=old.device)
    table = torch.tensor(
        [[math.comb(size, order) for order in range(1, MAX_COPIES + 1)] for size in range(MAX_COPIES + 1)],
        dtype=torch.float64,
        device=old.device,
    )
    signs = torch.where(j % 2 == 1, 1.0, -1.0)
    total = (table[n.long()] * signs * new[:, None] ** j / j.sqrt()).sum(dim=1)
    return new.to(opacities), scales * (old / total)[:, None].to(scales)


def draw_sources(weights: Tensor, count: int) -> Tensor:
    """Indices ``[count]`` drawn with replacement in proportion to ``weights`` ``[M]``, with torch's global generator.

    By inversion in float64, because ``torch.multinomial`` takes at most 2^24 weights.
    """
    cumulative = weights.to(torch.float64).cumsum(dim=0)
    uniform = torch.rand(count, dtype=torch.float64, device=weights.device) * cumulative[-1]
    return torch.searchsorted(cumulative, uniform, right=True).clamp_max(len(weights) - 1)


@torch.no_grad()
def grow(
    params: MutableMapping[str, Parameter], optimizers: Mapping[str, Optimizer], count: int, min_opacity: float
) -> None:
    """Add ``count`` copies of primitives, drawn by opacity; the rendered image stays the same.

    Replaces the parameter objects, as :func:`sundae_ns.gaussians.surgery.keep` does.

    Args:
        optimizers: by parameter name; the moments of the copies are 0.
        min_opacity: lower limit of the new opacities.
    """
    if count <= 0:
        return
    sources = draw_sources(params["opacities"].sigmoid().flatten(), count)
    _split_sources(params, sources, min_opacity)
    for name in list(params):
        change_parameter(params, optimizers, name, lambda value: torch.cat([value, value[sources]]))
        for moment in moments_of(optimizers, name, params[name]).values():
            moment[-count:] = 0


def _split_sources(params: Mapping[str, Tensor], sources: Tensor, min_opacity: float) -> None:
    """Give each source that was drawn k times the opacity and scale of one of k + 1 copies."""
    times = torch.bincount(sources, minlength=len(params["means"]))
    chosen = times.nonzero().squeeze(1)
    opacities, scales = split_evenly(
        params["opacities"][chosen].sigmoid().flatten(), params["scales"][chosen].exp(), times[chosen] + 1
    )
    eps = torch.finfo(opacities.dtype).eps
    params["opacities"].data[chosen] = torch.logit(opacities.clamp(min_opacity, 1 - eps))[:, None]
    params["scales"].data[chosen] = scales.log()
