"""Merging of pairs: the two primitives that differ least become one, again and again, until few enough are left."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from sundae_ns.gaussians.covariance import lower_entries, outer_entries, pair_overlap
from sundae_ns.gaussians.field import as_field
from sundae_ns.gaussians.parameters import sh_to_rgb
from sundae_ns.graphs import NeighborGraph

UNSEEN = 0.001
"""Share of all weight that is dropped, not merged: the lightest primitives."""
FLOOR = 1e-4
"""Least weight in a merge, as a share of the mean: primitives that nothing sees merge by their likeness."""
WIDTH = 0.01
"""Variance added to each axis, as a share of the sum of all three: two parallel flat primitives are alike too."""
PART = 0.5
"""Share of the possible merges of a round that happen; the others wait for what the better ones leave."""
MOST_ROUNDS = 256
"""Most rounds; a field needs about 60. Thousands of clones that share their neighbours would need many more."""


@torch.no_grad()
def pair_labels(params: Mapping[str, Tensor], graph: NeighborGraph, weight: Tensor, count: int) -> Tensor:
    """Label of each primitive after pairs along the edges of the graph have merged until ``count`` groups are left.

    Two groups of weights w and w' cost ``w w' / (w + w') (1 - overlap + |c - c'|^2)``: with the Bhattacharyya
    coefficient of their Gaussians as overlap, how much their images change if one of the same moments replaces both
    (Ward, 1963). A round merges pairs that cost less than any other pair of either group, the cheapest half of these.

    Args:
        params: the field, all finite, N primitives.
        graph: its edges are the pairs, whatever their weights.
        weight: of each primitive, such as its summed blending weight, not negative ``[N]``.
        count: number of groups, 1 to N.

    Returns:
        Labels as :func:`sundae_ns.gaussians.merging.merge` takes them, int64, on the graph's device ``[N]``: the index
        of a member, in each merge that of the heavier group; -1 for primitives that are dropped.
    """
    device, n = graph.indices.device, graph.N
    values = as_field(params).as_harmonics()
    w = weight.to(device).double().nan_to_num(0.0).clamp_min(0)
    label = torch.arange(n, device=device)
    order = torch.sort(w, stable=True).indices
    light = order[w[order].cumsum(0) <= UNSEEN * w.sum()][: n - count]
    label[light] = -1
    left = n - len(light)
    if left == count:
        return label

    groups = _Groups(values, w / w.mean().clamp_min(torch.finfo(torch.float64).tiny) + FLOOR, device)
    first, second = label[:, None].expand_as(graph.indices).flatten(), label[graph.indices].flatten()
    usable = (first >= 0) & (second >= 0)
    pairs = _unique(first[usable], second[usable], n)
    cost = groups.cost(*pairs)
    for _ in range(MOST_ROUNDS):
        if left == count or not len(cost):
            break
        chosen = _cheapest_of_both(pairs, cost, n)
        chosen = chosen[: min(left - count, max(1, round(PART * len(chosen))))]
        stays, goes = groups.join(pairs[0][chosen], pairs[1][chosen])
        left -= len(chosen)
        target = torch.arange(n, device=device)
        target[goes] = stays
        label = torch.where(label >= 0, target[label.clamp_min(0)], -1)
        # Only pairs of a changed group change.
        changed = torch.zeros(n, dtype=torch.bool, device=device)
        changed[stays] = changed[goes] = True
        moved = changed[pairs[0]] | changed[pairs[1]]
        renewed = _unique(target[pairs[0][moved]], target[pairs[1][moved]], n)
        cost = torch.cat([cost[~moved], groups.cost(*renewed)])
        pairs = torch.cat([pairs[0][~moved], renewed[0]]), torch.cat([pairs[1][~moved], renewed[1]])
    if left > count:  # of islands without a bridge, and of clones, the heaviest stay
        heads = (label == torch.arange(n, device=device)).nonzero().squeeze(1)
        lightest = heads[torch.sort(groups.weight[heads], stable=True).indices[: left - count]]
        gone = torch.zeros(n, dtype=torch.bool, device=device)
        gone[lightest] = True
        label = torch.where((label >= 0) & ~gone[label.clamp_min(0)], label, -1)
    return label


class _Groups:
    """Moments of the groups, each in the row that its label names, float64."""

    def __init__(self, field: Mapping[str, Tensor], weight: Tensor, device: torch.device) -> None:
        means = field["means"].detach().to(device).double()
        self.weight = weight
        self.mean = means - means.median(dim=0).values
        scales, quats = (field[name].detach().to(device).double() for name in ("scales", "quats"))
        self.entries = lower_entries(scales.exp(), quats)
        self.entries[:, :3] += WIDTH * self.entries[:, :3].sum(dim=1, keepdim=True)
        self.color = sh_to_rgb(field["features_dc"].detach().to(device).double()).clamp(0, 1)

    def cost(self, first: Tensor, second: Tensor) -> Tensor:
        """Cost of the merge of each pair ``[P]``."""
        unlike = 1 - pair_overlap(self.mean, self.entries, first, second)
        unlike += (self.color[first] - self.color[second]).square().sum(dim=1)
        # Of equal pairs, as in a grid of equal points, a random one is the cheapest; else a round would merge few.
        unlike += 1e-9 * ((first * 2_654_435_761 + second * 40_503) % 1_000_003) / 1_000_003
        return unlike / (1 / self.weight[first] + 1 / self.weight[second])

    def join(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
        """Merge pairs without a common group; returns the rows that stay and those that go."""
        lighter = self.weight[first] < self.weight[second]
        stays, goes = torch.where(lighter, second, first), torch.where(lighter, first, second)
        total = self.weight[stays] + self.weight[goes]
        share = (self.weight[goes] / total)[:, None]
        offset = self.mean[goes] - self.mean[stays]
        mixed = self.entries[stays] + share * (self.entries[goes] - self.entries[stays])
        self.entries[stays] = mixed + share * (1 - share) * outer_entries(offset)
        self.mean[stays] += share * offset
        self.color[stays] += share * (self.color[goes] - self.color[stays])
        self.weight[stays] = total
        return stays, goes


def _unique(first: Tensor, second: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """Each pair of two different groups once, the lower index first."""
    apart = first != second
    first, second = first[apart], second[apart]
    keys = torch.unique(torch.minimum(first, second) * n + torch.maximum(first, second))
    return keys.div(n, rounding_mode="floor"), keys % n


def _cheapest_of_both(pairs: tuple[Tensor, Tensor], cost: Tensor, n: int) -> Tensor:
    """Indices of the pairs that cost less than all others of both of their groups, cheapest first."""
    least = cost.new_full((n,), torch.inf)
    for ends in pairs:
        least.scatter_reduce_(0, ends, cost, "amin")
    found = ((cost <= least[pairs[0]]) & (cost <= least[pairs[1]])).nonzero().squeeze(1)
    found = found[torch.sort(cost[found], stable=True).indices]
    # Pairs of exactly equal cost may share a group: the earlier one has it.
    place = torch.arange(len(found), device=cost.device)
    earliest = torch.full((n,), len(found), device=cost.device)
    for ends in pairs:
        earliest.scatter_reduce_(0, ends[found], place, "amin")
    return found[(earliest[pairs[0][found]] == place) & (earliest[pairs[1][found]] == place)]
