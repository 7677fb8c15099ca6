"""Exact selection: turn scores into a mask that keeps exactly a given number of Gaussians.

Both functions take scores ``[N]`` of any floating dtype on any device and a ``count`` from 1 to N. They return a bool
mask ``[N]`` on that device with exactly ``count`` True entries. Among equal scores the lower index is selected first.
NaN means "unknown" and is selected last; ``+inf`` is the highest score. All work is done on the CPU in float64, so the
same scores give the same mask on every device.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sundae_ns.graph.neighbors import build_tree

LEAST_SHARE = 1e-200  # least score of a systematic sample, as a share of the largest; lower scores are raised to it


def select_band(magnitude: Tensor, count: int, gamma: float) -> Tensor:
    """Select the ``round(gamma * count)`` highest magnitudes, and the lowest for the rest; the ends never overlap.

    The paper's rule (paragraph "Controlling bandwidth with gamma"). NaN magnitudes, those of isolated Gaussians, belong
    to neither end.
    """
    values = magnitude.detach().cpu().double()
    mask = torch.zeros(len(values), dtype=torch.bool)
    # Both sorts ascend, so that NaN, which torch takes for the largest number, comes last in both.
    mask[torch.sort(-values, stable=True).indices[: round(gamma * count)]] = True
    others = (~mask).nonzero().squeeze(1)
    mask[others[torch.sort(values[others], stable=True).indices][: count - int(mask.sum())]] = True
    return mask.to(magnitude.device)


def inclusion_probabilities(score: Tensor, count: int) -> Tensor:
    """Probabilities ``min(1, c s_i)`` of positive finite scores ``[N]``, which sum to ``count``; exactly 1 or below."""
    values = score.detach().cpu().double()
    # The largest is 1, so that sums do not overflow; none is 0, so that no sum is.
    values = (values / values.max()).clamp_min(LEAST_SHARE)
    ordered = torch.sort(values, descending=True, stable=True).values
    rest = ordered.flip(0).cumsum(0).flip(0)
    left = count - torch.arange(count, dtype=torch.float64)
    # The fewest certain Gaussians such that no other has a probability above 1.
    certain = int((left * ordered[:count] <= rest[:count]).to(torch.uint8).argmax())
    probabilities = values * ((count - certain) / rest[certain])
    return probabilities.masked_fill(values > ordered[certain], 1.0).clamp_max(1.0)


def neighbor_order(points: Tensor) -> Tensor:
    """An order in which neighbours follow each other: leaves of a balanced tree of finite points, int64 ``[N]``."""
    return build_tree(points.detach()).order.cpu().long()


def select_systematic(score: Tensor, count: int, order: Tensor, seed: int) -> Tensor:
    """Draw one Gaussian in each stretch of an order ``[N]`` over which the inclusion probabilities sum to one.

    Systematic sampling with unequal probabilities (Madow, 1949): probabilities are summed along the order, and a
    Gaussian is selected whenever the sum passes ``u + j``, with one random u for all j. Each Gaussian is selected with
    probability ``min(1, c s_i)``, and any stretch of the order keeps its expected number, rounded up or down. Infinite
    scores are selected first, then positive ones. Scores that are NaN or at most 0 are drawn uniformly, after all
    others.
    """
    order = order.cpu()
    values = score.detach().cpu().double()[order]
    start = float(torch.rand((), generator=torch.Generator().manual_seed(seed), dtype=torch.float64))
    chosen = torch.zeros(len(values), dtype=torch.bool)
    infinite = values == torch.inf
    positive = (values > 0) & ~infinite
    left = count
    for tier in (infinite, positive, ~infinite & ~positive):
        members = tier.nonzero().squeeze(1)
        if left == 0:
            break
        if len(members) > left:
            weight = values[members] if tier is positive else torch.ones(len(members), dtype=torch.float64)
            members = members[_systematic_sample(inclusion_probabilities(weight, left), left, start)]
        chosen[order[members]] = True
        left -= len(members)
    return chosen.to(score.device)


def _systematic_sample(probabilities: Tensor, count: int, start: float) -> Tensor:
    """Indices ``[count]``, all different, at which the sum of the probabilities passes ``start + j``."""
    certain = probabilities >= 1
    uncertain, taken = (~certain).nonzero().squeeze(1), certain.nonzero().squeeze(1)
    if not (wanted := count - len(taken)):
        return taken
    sums = probabilities[uncertain].cumsum(0)
    steps = torch.arange(wanted)
    marks = (start + steps.double()) * (sums[-1] / wanted)
    # Rounding must not lose the last draw, nor draw one Gaussian twice.
    drawn = torch.searchsorted(sums, marks, right=True).minimum(steps + len(uncertain) - wanted)
    drawn = (drawn - steps).cummax(0).values + steps
    return torch.cat([taken, uncertain[drawn]])
