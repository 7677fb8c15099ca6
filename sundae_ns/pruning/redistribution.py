"""Merging of dropped primitives into kept ones along the graph."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from sundae_ns.gaussians.covariance import chunks
from sundae_ns.gaussians.field import as_field
from sundae_ns.gaussians.merging import merge
from sundae_ns.gaussians.parameters import rgb_to_logit
from sundae_ns.graphs import NeighborGraph

ROWS = 1 << 17
"""Primitives whose edges are followed at once; they take about 100 MiB."""

MOST_HOPS = 64
"""Most edges between a dropped primitive and its kept one; keep ratios from 0.001 on need about a dozen."""


@torch.no_grad()
def voronoi_labels(graph: NeighborGraph, mask: Tensor) -> Tensor:
    """Voronoi label of each primitive: the index of the nearest kept primitive along the edges of the graph.

    The length of an edge is ``-log W_ij``, so edges between primitives of different appearance are long if the graph
    weights by appearance. All edges are relaxed at once, hop by hop (Bellman and Ford). Among equally near kept
    primitives the one found in fewer hops wins, then the one over the earlier neighbour.

    Edges are followed from a primitive to its neighbours. Primitives that reach no kept one so follow edges in both
    directions: a thousand clones share the same few neighbours, and all of these may be dropped.

    Args:
        mask: True for primitives to keep, bool, any device ``[N]``.

    Returns:
        Labels, int64, on the graph's device ``[N]``: its own index for a kept primitive; -1 for primitives that are
        connected to no kept one.
    """
    device = graph.weights.device
    mask = mask.to(device)
    own = torch.arange(graph.N, device=device)
    label = torch.where(mask, own, -1)
    distance = torch.where(mask, 0.0, torch.inf).double()
    changed = mask
    for _ in range(MOST_HOPS):
        found = [_nearer(graph, rows, changed, distance) for rows in chunks(graph.N, ROWS)]
        rows, through, reached = (torch.cat(parts) for parts in zip(*found, strict=True))
        if not len(rows):
            break
        label[rows] = label[through]
        distance[rows] = reached
        changed = torch.zeros_like(mask)
        changed[rows] = True
    return _label_either_way(graph, label, distance)


def _nearer(graph: NeighborGraph, among: slice, changed: Tensor, distance: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Primitives that one hop brings nearer to a kept one, the neighbours that lead there, and the new distances."""
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
    """Label the primitives without a label, along edges in both directions."""
    unlabelled = label < 0
    rows, slots = ((unlabelled[:, None] | unlabelled[graph.indices]) & (graph.weights > 0)).nonzero(as_tuple=True)
    ends, length = graph.indices[rows, slots], _lengths(graph.weights[rows, slots])
    source, target, length = torch.cat([rows, ends]), torch.cat([ends, rows]), torch.cat([length, length])
    wanted = unlabelled[target]
    source, target, length = source[wanted], target[wanted], length[wanted]
    label, distance = label.clone(), distance.clone()
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
    """Merge the primitives of each Voronoi cell of the graph into its kept one; see :func:`voronoi_labels`, and
    :func:`sundae_ns.gaussians.merging.merge` for the result.

    A field that stores logits averages colours, not logits.

    Args:
        params: the field, all finite, N primitives.
        mask: True for primitives to keep, bool ``[N]``.
        weight: weight of each primitive in the merge, its summed blending weight over the training views ``[N]``.
        labels: of groups that take the place of the Voronoi cells, int64 ``[N]``; -1 for primitives that are dropped.

    Returns:
        Parameters of the kept primitives ``[M, ...]``.
    """
    labels = voronoi_labels(graph, mask) if labels is None else labels
    if as_field(params).encoding == "harmonics":
        return merge(params, labels, weight)
    own = params["features_dc"].detach()
    colors = own.sigmoid()
    values = merge({**params, "features_dc": colors}, labels, weight)
    stay, mixed = mask.to(own.device), values["features_dc"]
    # Unmerged colours keep their logits: a saturated colour does not survive the round trip.
    values["features_dc"] = torch.where(mixed == colors[stay], own[stay], rgb_to_logit(mixed))
    return values
