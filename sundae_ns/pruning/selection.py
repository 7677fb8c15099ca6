"""Exact selection: turn scores into a mask that keeps exactly a given number of primitives.

All functions take scores ``[N]`` of any floating dtype on any device, and return a bool mask ``[N]`` on that device
with exactly ``count`` True entries. Among equal scores the lower index is selected first. NaN means "unknown" and is
selected last; ``+inf`` is the highest score. All work is done on the CPU in float64, so the same scores give the same
mask on every device.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sundae_ns.errors import ConfigError, DataError


def check_share(share: float) -> None:
    """Raise ``ConfigError`` for a share to keep that is not in (0, 1]."""
    if not 0 < share <= 1:
        raise ConfigError(f"keep_ratio is {share}: use a share in (0, 1], 0.1 to keep a tenth")


def kept_count(share: float, n: int) -> int:
    """Number of ``n`` primitives that a prune to a share keeps: ``round(share * n)``, at least 1.

    The one place that turns a share into a count.

    Raises:
        ConfigError: the share is not in (0, 1].
    """
    check_share(share)
    return max(1, round(share * n))


def select_top(score: Tensor, count: int) -> Tensor:
    """Select the ``count`` highest scores: ``[N]`` to bool ``[N]``."""
    values = as_scores(score, count)
    return _mask(_ranked(values)[:count], score)


def select_band(magnitude: Tensor, count: int, gamma: float) -> Tensor:
    """Select the ``round(gamma * count)`` highest magnitudes, and the lowest for the rest.

    The paper's rule (paragraph "Controlling bandwidth with gamma"). The two ends never overlap. NaN magnitudes, those
    of isolated primitives, belong to neither end.

    Args:
        count: number of primitives to keep, 1 to N.
        gamma: share of the high end, in [0, 1].

    Raises:
        DataError: ``count`` is not in 1 to N.
    """
    values = as_scores(magnitude, count)
    high = _ranked(values)[: round(gamma * count)]
    rest = torch.ones_like(values, dtype=torch.bool)
    rest[high] = False
    remaining = rest.nonzero().squeeze(1)
    low = remaining[_ranked(-values[remaining])][: count - len(high)]
    return _mask(torch.cat([high, low]), magnitude)


def select_sampled(score: Tensor, count: int, seed: int) -> Tensor:
    """Draw ``count`` primitives without replacement, each draw with probability proportional to the scores left.

    Gumbel top-k: the highest sums of log scores and independent Gumbel noise are distributed like successive draws
    (Efraimidis and Spirakis, 2006). The scale of the scores does not matter. Scores that are NaN or at most 0 are drawn
    uniformly, after all positive ones.

    Args:
        count: number of primitives to keep, 1 to N.
        seed: seed of the draw, independent of the global generator.

    Raises:
        DataError: ``count`` is not in 1 to N.
    """
    values = as_scores(score, count)
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(len(values), generator=generator, dtype=torch.float64)
    gumbel = -torch.log((-torch.log1p(-uniform)).clamp_min(torch.finfo(torch.float64).tiny))
    positive = values > 0
    first = positive.nonzero().squeeze(1)
    last = (~positive).nonzero().squeeze(1)
    keys = torch.log(values[first]) + gumbel[first]
    order = torch.cat([first[_ranked(keys)], last[_ranked(gumbel[last])]])
    return _mask(order[:count], score)


def select_random(n: int, count: int, seed: int, device: torch.device | str = "cpu") -> Tensor:
    """Draw ``count`` of ``n`` primitives uniformly, as a control for scores; bool ``[n]``."""
    return select_sampled(torch.ones(n, device=device), count, seed)


def as_scores(score: Tensor, count: int) -> Tensor:
    """Scores as float64 on the CPU ``[N]``.

    Raises:
        DataError: they have another shape, or ``count`` is not in 1 to N.
    """
    if score.ndim != 1:
        raise DataError(f"scores have shape {list(score.shape)}: pass one number per primitive, [N]")
    if not 1 <= count <= len(score):
        raise DataError(f"cannot keep {count} of {len(score)} primitives: ask for 1 to {len(score)}")
    return score.detach().to(device="cpu", dtype=torch.float64)


def _ranked(values: Tensor) -> Tensor:
    """Indices by falling value, lower index first among equals, NaN after everything else."""
    unknown = values.isnan()
    order = torch.sort(values.masked_fill(unknown, -torch.inf), descending=True, stable=True).indices
    # -inf and NaN tie in the sort, so a second stable pass moves NaN to the end.
    late = unknown[order]
    return torch.cat([order[~late], order[late]])


def _mask(chosen: Tensor, like: Tensor) -> Tensor:
    mask = torch.zeros(len(like), dtype=torch.bool)
    mask[chosen] = True
    return mask.to(like.device)
