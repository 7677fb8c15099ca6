"""Even coverage: unequal probabilities, and one draw a stratum in place of independent draws.

Independent draws leave holes and clumps by chance; what is drawn one a stratum along an order in which neighbours follow
each other does not. The chance of each primitive stays what its score says. As in :mod:`sundae_ns.pruning.selection`, the
work is done on the CPU in float64.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sundae_ns.errors import DataError
from sundae_ns.graphs.tree import build_tree

OCTAVES = 4
"""Bands reach this many octaves of the response to either side of its median; what lies beyond joins the last ones."""


LEAST_SHARE = 1e-200
"""Scores below this share of the largest count as much."""


def inclusion_probabilities(score: Tensor, count: int) -> Tensor:
    """Chances ``pi_i = min(1, c s_i)`` that sum to ``count``.

    Args:
        score: positive finite scores ``[N]``.
        count: 1 to N.

    Returns:
        float64, on the CPU ``[N]``; exactly 1 for those that are certain.

    Raises:
        DataError: a score is not positive and finite, or ``count`` is out of range.
    """
    values = score.detach().to(device="cpu", dtype=torch.float64)
    n = len(values)
    if not 1 <= count <= n:
        raise DataError(f"cannot keep {count} of {n} primitives: ask for 1 to {n}")
    if not bool((values > 0).all()) or bool(values.isinf().any()):
        raise DataError("chances need positive finite scores: leave out the others first")
    # The largest is 1, and so sums cannot overflow; the smallest are not 0, and so neither can what divides by their sum.
    values = (values / values.max()).clamp_min(LEAST_SHARE)
    ordered = torch.sort(values, descending=True, stable=True).values
    rest = ordered.flip(0).cumsum(0).flip(0)
    room = count - torch.arange(count, dtype=torch.float64)
    # The fewest certain ones, such that no other would be more than certain.
    certain = int((room * ordered[:count] <= rest[:count]).to(torch.uint8).argmax())
    chances = values * ((count - certain) / rest[certain])
    return chances.masked_fill(values > ordered[certain], 1.0).clamp_max(1.0)


def neighbor_order(points: Tensor) -> Tensor:
    """An order in which neighbours follow each other: that of the leaves of a balanced tree, int64 on the CPU ``[N]``.

    Like a Morton curve's, but cells are halved at the median of their widest axis: clusters of any size are walked through
    in as many steps as they have points, where the bits of a Morton code would put them into one cell.

    Args:
        points: finite positions ``[N, 3]``, N at least 1.
    """
    return build_tree(points.detach()).order.cpu().long()


def select_systematic(score: Tensor, count: int, order: Tensor, seed: int) -> Tensor:
    """Draw one primitive in each stretch of an order over which the chances add up to one.

    Systematic sampling with unequal probabilities (Madow, 1949): chances are added up along the order, and a primitive is
    taken whenever the sum passes ``u + j``, with one random u for all j. It is error feedback in one dimension: what a
    primitive lacks to a whole one is carried over to the next. Each primitive has the chance
    ``min(1, c s_i)``, and any stretch of the order keeps its expected number, rounded up or down.

    Infinite scores come first, then the positive ones; scores of zero or less and NaN are drawn alike, and only after all
    others.

    Args:
        score: scores ``[N]``.
        count: number of primitives to keep, 1 to N.
        order: permutation of the primitives, int64 ``[N]``.
        seed: of the draw.

    Returns:
        bool, on the device of the scores ``[N]``, with ``count`` True entries.

    Raises:
        DataError: ``count`` is not in 1 to N, or shapes do not fit.
    """
    n = len(score)
    if score.ndim != 1 or order.shape != score.shape:
        raise DataError(f"scores are {list(score.shape)} and their order {list(order.shape)}: pass [N] and [N]")
    if not 1 <= count <= n:
        raise DataError(f"cannot keep {count} of {n} primitives: ask for 1 to {n}")
    order = order.cpu()
    values = score.detach().to(device="cpu", dtype=torch.float64)[order]
    start = float(torch.rand((), generator=torch.Generator().manual_seed(seed), dtype=torch.float64))
    chosen = torch.zeros(n, dtype=torch.bool)
    infinite = values == torch.inf
    positive = (values > 0) & ~infinite
    left = count
    for tier in (infinite, positive, ~infinite & ~positive):
        members = tier.nonzero().squeeze(1)
        if len(members) > left:
            weight = values[members] if tier is positive else torch.ones(len(members), dtype=torch.float64)
            members = members[_passed(inclusion_probabilities(weight, left), left, start)] if left else members[:0]
        chosen[order[members]] = True
        left -= len(members)
    return chosen.to(score.device)


def band_shares(score: Tensor, response: Tensor) -> tuple[Tensor, Tensor]:
    """Scores that give every band of the response a share, and the bands.

    Bands are octaves of the response around its median; one more holds what has no response. Half of the budget goes by the
    scores alone; the other half is dealt out in equal parts to the bands, and by the scores within each.

    Args:
        score: scores ``[N]``; NaN, infinite ones and those of zero or less are returned as they are.
        response: norm of the response, any device; NaN where it is not defined ``[N]``.

    Returns:
        Scores float64 and bands int64, both on the CPU ``[N]``.
    """
    values = score.detach().to(device="cpu", dtype=torch.float64)
    norm = response.detach().to(device="cpu", dtype=torch.float64)
    known = norm[norm > 0]
    middle = known.median() if len(known) else norm.new_tensor(1.0)
    octaves = (norm / middle).log2().floor().clamp(-OCTAVES, OCTAVES - 1).nan_to_num(nan=OCTAVES)
    band = octaves.long() + OCTAVES
    usable = (values > 0) & ~values.isinf()
    scaled = (
        torch.where(usable, values / values[usable].max(), 0.0) if bool(usable.any()) else values.new_zeros(len(values))
    )
    sums = torch.zeros(2 * OCTAVES + 1, dtype=torch.float64).index_add_(0, band, scaled)
    filled = int((sums > 0).sum())
    shared = scaled / sums.sum() + scaled / (filled * sums[band]).clamp_min(torch.finfo(torch.float64).tiny)
    return torch.where(usable, shared, values), band


def _passed(chances: Tensor, count: int, start: float) -> Tensor:
    """Places where the sum of the chances passes ``start + j``: exactly ``count``, all different."""
    certain = chances >= 1
    places = (~certain).nonzero().squeeze(1)
    wanted = count - int(certain.sum())
    sums = chances[places].cumsum(0)
    taken = certain.nonzero().squeeze(1)
    if wanted:
        # Rounding must neither lose the last draw nor let two fall on one place.
        marks = (start + torch.arange(wanted, dtype=torch.float64)) * (sums[-1] / wanted)
        steps = torch.arange(wanted)
        drawn = torch.searchsorted(sums, marks, right=True).minimum(steps + len(places) - wanted)
        drawn = (drawn - steps).cummax(0).values + steps
        taken = torch.cat([taken, places[drawn]])
    return taken
