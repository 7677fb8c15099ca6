"""The graph of a field, and the groups of Gaussians that one Gaussian replaces: pairs, or Voronoi cells.

Edges weigh distance, or distance, overlap and colour. Pairs: the two Gaussians that differ least become one, again and
again, until few enough are left. Cells: each dropped Gaussian joins the kept one that is nearest along the edges.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from sundae_ns.core.covariance import LOWER, chunks, entries_of, overlap
from sundae_ns.core.gaussians import as_gaussians, rgb_to_logit, sh_to_rgb
from sundae_ns.core.merging import merge
from sundae_ns.graph.graph import NeighborGraph, build_graph
from sundae_ns.pruning.rule import PruneRule

LEAST_WIDTH = 0.25  # width added to Gaussians whose overlap is measured, in sigmas of the graph: some are flat
MOST_UNLIKE = 8.0  # largest difference of colours that counts, in typical ones; no weight falls below e^-32, or to 0
UNSEEN = 0.001  # share of all weight that is dropped, not merged: the lightest Gaussians
FLOOR = 1e-4  # least weight in a merge, as a share of the mean: Gaussians that nothing sees merge by their likeness
WIDTH = 0.01  # variance added to each axis, as a share of the sum of all: two parallel flat Gaussians are alike too
PART = 0.5  # share of the possible merges of a round that happen; the others wait for what the better ones leave
MOST_ROUNDS = 256  # a field needs about 60; thousands of clones that share their neighbours would need many more
ROWS = 1 << 17  # Gaussians whose edges are followed at once; they take about 100 MiB
MOST_HOPS = 64  # most edges between a dropped Gaussian and its kept one; keep ratios from 0.001 on need about a dozen


@torch.no_grad()
def gaussian_graph(params: Mapping[str, Tensor], rule: PruneRule) -> NeighborGraph:
    """Neighbour graph of a finite field, with the weights that the rule asks for (docs/method.md, "The graph").

    As in a bilateral filter, Gaussians on two sides of an image edge are hardly neighbours by ``appearance``. A field
    of at most ``num_neighbors`` Gaussians has the graph of all pairs within reach. ``DataError`` for a single Gaussian.
    """
    params = as_gaussians(params).as_harmonics()
    means = params["means"].detach()
    # Pairs lose nothing by the nearer half, and take half of the time; merges into cells lose 0.8 dB.
    wanted = rule.num_neighbors if rule.uses_edge_weights else (rule.num_neighbors + 1) // 2
    graph = build_graph(means, num_neighbors=min(wanted, max(len(means) - 1, 1)))
    if rule.edges == "centres" or not rule.uses_edge_weights:
        return graph
    # In place: of a large field, each value per edge takes gigabytes.
    weights = graph.weights.mul_(_color_affinity(sh_to_rgb(params["features_dc"].detach()), graph))
    rows = torch.arange(len(means), device=means.device)[:, None]
    weights *= overlap(means, entries_of(params), rows, graph.indices, (LEAST_WIDTH * graph.sigma) ** 2)
    return replace(graph, weights=weights, dw=weights.sum(dim=1))


def _color_affinity(colors: Tensor, graph: NeighborGraph) -> Tensor:
    squares = torch.empty_like(graph.weights)
    total = torch.zeros((), dtype=torch.float64, device=squares.device)
    for column, (neighbor, weight) in enumerate(zip(graph.indices.unbind(dim=1), graph.weights.unbind(dim=1))):
        squares[:, column] = (colors - colors[neighbor]).square().sum(dim=1)
        total += (squares[:, column] * (weight > 0)).sum(dtype=torch.float64)
    typical = total / (graph.weights > 0).sum().clamp_min(1)
    if not typical > 0:
        return torch.ones_like(squares)
    return squares.div_(typical.to(squares.dtype)).clamp_max_(MOST_UNLIKE**2).mul_(-0.5).exp_()


@torch.no_grad()
def pair_labels(params: Mapping[str, Tensor], graph: NeighborGraph, weight: Tensor, count: int) -> Tensor:
    """Label of each Gaussian after pairs along the edges of the graph have merged until ``count`` groups are left.

    Two groups of weights w and w' cost ``w w' / (w + w') (1 - overlap + |c - c'|^2)``: with the Bhattacharyya
    coefficient of their Gaussians as overlap, how much their images change if one of the same moments replaces both
    (Ward, 1963). A round merges pairs that cost less than any other pair of either group, the cheapest half of these.
    ``weight`` ``[N]`` is not negative. Labels ``[N]`` are as :func:`sundae_ns.core.merging.merge` takes them: the index
    of a member, in each merge that of the heavier group; -1 for Gaussians that are dropped.
    """
    device, n = graph.indices.device, graph.N
    values = as_gaussians(params).as_harmonics()
    w = weight.to(device).double().nan_to_num(0.0).clamp_min(0)
    label = torch.arange(n, device=device)
    order = torch.sort(w, stable=True).indices
    light = order[w[order].cumsum(0) <= UNSEEN * w.sum()][: n - count]
    label[light] = -1
    if (left := n - len(light)) == count:
        return label

    groups = _Groups(values, w / w.mean().clamp_min(torch.finfo(torch.float64).tiny) + FLOOR, device)
    near = label.index_select(0, graph.indices.flatten())
    pairs: tuple[Tensor, ...] = _unique((label[:, None].expand_as(graph.indices).flatten(), near), n)
    cost = groups.cost(*pairs)
    for _ in range(MOST_ROUNDS):
        if left == count or not len(cost):
            break
        chosen = _cheapest_of_both(pairs, cost, n)
        chosen = chosen[: min(left - count, max(1, round(PART * len(chosen))))]
        stays, goes = groups.join(pairs[0][chosen], pairs[1][chosen])
        left -= len(chosen)
        target = torch.arange(n, device=device).index_copy_(0, goes, stays)
        label = torch.where(label >= 0, target[label.clamp_min(0)], -1)
        # Only pairs of a changed group change.
        changed = torch.zeros(n, dtype=torch.bool, device=device).index_fill_(0, torch.cat([stays, goes]), True)
        moved = changed.index_select(0, pairs[0]) | changed.index_select(0, pairs[1])
        rest, moved = (mask.nonzero().squeeze(1) for mask in (~moved, moved))
        renewed = _unique(tuple(target.index_select(0, ends.index_select(0, moved)) for ends in pairs), n)
        cost = torch.cat([cost.index_select(0, rest), groups.cost(*renewed)])
        pairs = tuple(torch.cat([old.index_select(0, rest), new]) for old, new in zip(pairs, renewed, strict=True))
    if left > count:  # of islands without a bridge, and of clones, the heaviest stay
        heads = (label == torch.arange(n, device=device)).nonzero().squeeze(1)
        lightest = heads[torch.sort(groups.weight[heads], stable=True).indices[: left - count]]
        label[torch.isin(label, lightest)] = -1
    return label


class _Groups:
    """Moments of the groups, each in the row that its label names, float64."""

    def __init__(self, gaussians: Mapping[str, Tensor], weight: Tensor, device: torch.device) -> None:
        means = gaussians["means"].detach().to(device).double()
        self.weight = weight
        self.mean = means - means.median(dim=0).values
        self.entries = entries_of(gaussians).to(device)
        self.entries[:, :3] += WIDTH * self.entries[:, :3].sum(dim=1, keepdim=True)
        self.color = sh_to_rgb(gaussians["features_dc"].detach().to(device).double()).clamp(0, 1)

    def cost(self, first: Tensor, second: Tensor) -> Tensor:
        """Cost of the merge of each pair ``[P]``."""
        unlike = 1 - overlap(self.mean, self.entries, first, second)
        unlike += (self.color.index_select(0, first) - self.color.index_select(0, second)).square().sum(dim=1)
        # Of equal pairs, as in a grid of equal points, a random one is the cheapest; else a round would merge few.
        unlike += 1e-9 * ((first * 2_654_435_761 + second * 40_503) % 1_000_003).float() / 1_000_003
        return unlike / (1 / self.weight.index_select(0, first) + 1 / self.weight.index_select(0, second))

    def join(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
        """Merge pairs without a common group; returns the rows that stay and those that go."""
        lighter = self.weight[first] < self.weight[second]
        stays, goes = torch.where(lighter, second, first), torch.where(lighter, first, second)
        total = self.weight[stays] + self.weight[goes]
        share = (self.weight[goes] / total)[:, None]
        offset = self.mean[goes] - self.mean[stays]
        mixed = self.entries[stays] + share * (self.entries[goes] - self.entries[stays])
        self.entries[stays] = mixed + share * (1 - share) * offset[:, LOWER[0]] * offset[:, LOWER[1]]
        self.mean[stays] += share * offset
        self.color[stays] += share * (self.color[goes] - self.color[stays])
        self.weight[stays] = total
        return stays, goes


def _unique(ends: tuple[Tensor, ...], n: int) -> tuple[Tensor, Tensor]:
    """Each pair of two different groups once, the lower index first; none of a negative index."""
    # All of pairs is picked by index_select: a CPU takes twice as long by brackets.
    low, high = torch.minimum(*ends), torch.maximum(*ends)
    keys = (low * n + high).masked_select((low >= 0) & (low < high))
    keys = torch.from_numpy(np.unique(keys.numpy())) if keys.is_cpu else torch.unique(keys)  # torch's takes four times
    return keys.div(n, rounding_mode="floor"), keys % n


def _cheapest_of_both(pairs: tuple[Tensor, ...], cost: Tensor, n: int) -> Tensor:
    """Indices of the pairs that cost less than all others of both of their groups, cheapest first."""
    least = cost.new_full((n,), torch.inf)
    for ends in pairs:
        least.scatter_reduce_(0, ends, cost, "amin")
    cheapest = (cost <= torch.minimum(*(least.index_select(0, ends) for ends in pairs))).nonzero().squeeze(1)
    cheapest = cheapest[torch.sort(cost[cheapest], stable=True).indices]
    # Pairs of exactly equal cost may share a group: the earlier one has it.
    rank = torch.arange(len(cheapest), device=cost.device)
    earliest = torch.full((n,), len(cheapest), device=cost.device)
    for ends in pairs:
        earliest.scatter_reduce_(0, ends[cheapest], rank, "amin")
    return cheapest[(earliest[pairs[0][cheapest]] == rank) & (earliest[pairs[1][cheapest]] == rank)]


@torch.no_grad()
def voronoi_labels(graph: NeighborGraph, mask: Tensor) -> Tensor:
    """Voronoi label of each Gaussian: the index of the nearest Gaussian under ``mask`` along edges, int64 ``[N]``.

    The length of an edge is ``-log W_ij``. All edges are relaxed at once, hop by hop (Bellman and Ford). Among equally
    near kept Gaussians the one found in fewer hops wins, then the one over the earlier neighbour.

    Gaussians that reach no kept one so follow edges in both directions: a thousand clones share the same few
    neighbours, and all of these may be dropped. Gaussians that are connected to no kept one have the label -1.
    """
    device = graph.weights.device
    mask = mask.to(device)
    label = torch.where(mask, torch.arange(graph.N, device=device), -1)
    distance = torch.where(mask, 0.0, torch.inf).double()
    changed = mask
    for _ in range(MOST_HOPS):
        relaxed = [_nearer(graph, rows, changed, distance) for rows in chunks(graph.N, ROWS)]
        rows, through, reached = (torch.cat(values) for values in zip(*relaxed, strict=True))
        if not len(rows):
            break
        label[rows] = label[through]
        distance[rows] = reached
        changed = torch.zeros_like(mask)
        changed[rows] = True
    return _label_either_way(graph, label, distance)


def _nearer(graph: NeighborGraph, among: slice, changed: Tensor, distance: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Gaussians that one hop brings nearer to a kept one, the neighbours that lead there, and the new distances."""
    # A distance can only shrink if that of a neighbour has shrunk.
    rows = changed[graph.indices[among]].any(dim=1).nonzero().squeeze(1).add_(among.start)
    near = graph.indices[rows]
    reached, over = (distance[near] + _lengths(graph.weights[rows])).min(dim=1)
    nearer = reached < distance[rows]
    return rows[nearer], near.gather(1, over[:, None]).squeeze(1)[nearer], reached[nearer]


def _lengths(weights: Tensor) -> Tensor:
    """Lengths of edges, float64; infinite without an edge."""
    return torch.where(weights > 0, -weights.double().log(), torch.inf).clamp_min_(0)


def _label_either_way(graph: NeighborGraph, label: Tensor, distance: Tensor) -> Tensor:
    """Label the Gaussians without a label, in place, along edges in both directions."""
    unlabelled = label < 0
    rows, slots = ((unlabelled[:, None] | unlabelled[graph.indices]) & (graph.weights > 0)).nonzero(as_tuple=True)
    ends, length = graph.indices[rows, slots], _lengths(graph.weights[rows, slots])
    source, target, length = torch.cat([rows, ends]), torch.cat([ends, rows]), torch.cat([length, length])
    wanted = unlabelled[target]
    source, target, length = source[wanted], target[wanted], length[wanted]
    for _ in range(MOST_HOPS):
        over = distance[source] + length
        reached = distance.scatter_reduce(0, target, over, "amin")
        best = (over == reached[target]) & (over < distance[target])
        if not bool(best.any()):
            break
        # The lowest index among equally near sources, on every device.
        through = torch.full_like(label, graph.N).scatter_reduce_(0, target[best], source[best], "amin")
        nearer = reached < distance
        label[nearer] = label[through[nearer]]
        distance = reached
    return label


@torch.no_grad()
def merged(
    params: Mapping[str, Tensor], graph: NeighborGraph, mask: Tensor, weight: Tensor, labels: Tensor | None = None
) -> dict[str, Tensor]:
    """Merge the dropped Gaussians of a finite field into those under ``mask`` (:func:`sundae_ns.core.merging.merge`).

    ``weight`` ``[N]`` is the summed blending weight. Groups are ``labels``, int64 ``[N]``, -1 for what is dropped; by
    default the cells of :func:`voronoi_labels`. A field that stores logits averages colours, not logits.
    """
    labels = voronoi_labels(graph, mask) if labels is None else labels
    if as_gaussians(params).encoding == "harmonics":
        return merge(params, labels, weight)
    logits = params["features_dc"].detach()
    colors = logits.sigmoid()
    values = merge({**params, "features_dc": colors}, labels, weight)
    kept = mask.to(logits.device)
    mixed = values["features_dc"]
    # Unmerged colours keep their logits: a saturated colour does not survive the round trip.
    values["features_dc"] = torch.where(mixed == colors[kept], logits[kept], rgb_to_logit(mixed))
    return values
