"""Not losing what is dropped: what those that stay become when the others go."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from sundae_ns.gaussians.merging import merge
from sundae_ns.gaussians.parameters import rgb_to_logit
from sundae_ns.graphs import NeighborGraph, knn

MOST_HOPS = 64
"""Edges that an inheritance may pass; shares of a thousandth and above need a dozen."""

SPACING_NEIGHBORS = 3
"""The spacing of primitives is the mean distance to so many nearest ones, as in the initialisation of 3DGS."""


@torch.no_grad()
def heirs(graph: NeighborGraph, mask: Tensor) -> Tensor:
    """Who inherits from whom: the nearest kept primitive along the edges of the graph.

    The length of an edge is ``-log W_ij``, so that edges between unlike primitives are long where the graph knows
    appearance; the cells are those of a Voronoi diagram on the graph. Found by relaxing all edges at once, hop by hop
    (Bellman and Ford). Of equally near heirs the one found over the earlier neighbour, and in fewer hops, counts.

    Edges are followed from a primitive to its neighbours. Where nobody that stays is found so, they are followed either way:
    of a thousand clones all have the same few for neighbours, and none of those need stay.

    Args:
        graph: N nodes.
        mask: True for primitives that stay, bool, any device ``[N]``.

    Returns:
        Index of the heir, int64, on the graph's device ``[N]``: the own one for those that stay, -1 for those that are
        joined to no kept primitive.
    """
    device = graph.weights.device
    mask = mask.to(device)
    own = torch.arange(graph.N, device=device)
    heir = torch.where(mask, own, -1)
    lengths = torch.where(graph.weights > 0, -graph.weights.double().log(), torch.inf).clamp_min(0)
    distance = torch.where(mask, 0.0, torch.inf).double()
    changed = mask
    for _ in range(MOST_HOPS):
        # Only what has a neighbour that has come nearer can come nearer itself.
        rows = changed[graph.indices].any(dim=1).nonzero().squeeze(1)
        near = graph.indices[rows]
        reached, over = (distance[near] + lengths[rows]).min(dim=1)
        nearer = reached < distance[rows]
        if not bool(nearer.any()):
            break
        rows, through = rows[nearer], near.gather(1, over[:, None]).squeeze(1)[nearer]
        heir[rows] = heir[through]
        distance[rows] = reached[nearer]
        changed = torch.zeros_like(mask)
        changed[rows] = True
    return _either_way(graph, heir, distance, lengths)


def _either_way(graph: NeighborGraph, heir: Tensor, distance: Tensor, lengths: Tensor) -> Tensor:
    """Heirs of those that have none, over edges of both directions."""
    heirless = heir < 0
    rows, slots = ((heirless[:, None] | heirless[graph.indices]) & (graph.weights > 0)).nonzero(as_tuple=True)
    ends, length = graph.indices[rows, slots], lengths[rows, slots]
    source, target, length = torch.cat([rows, ends]), torch.cat([ends, rows]), torch.cat([length, length])
    wanted = heirless[target]
    source, target, length = source[wanted], target[wanted], length[wanted]
    heir, distance = heir.clone(), distance.clone()
    for _ in range(MOST_HOPS):
        over = distance[source] + length
        reached = distance.scatter_reduce(0, target, over, "amin")
        best = (over == reached[target]) & (over < distance[target])
        if not bool(best.any()):
            break
        # The lowest index among equally near ones, on every device.
        through = torch.full_like(heir, graph.N).scatter_reduce_(0, target[best], source[best], "amin")
        nearer = reached < distance
        heir[nearer] = heir[through[nearer]]
        distance = reached
    return heir


@torch.no_grad()
def merged(
    params: Mapping[str, Tensor], graph: NeighborGraph, mask: Tensor, weight: Tensor, *, logits: bool = False
) -> dict[str, Tensor]:
    """Those that stay, with what their neighbours leave them: see :func:`heirs` and :func:`sundae_ns.gaussians.merge`.

    Args:
        params: the field, all finite, N primitives.
        graph: its graph.
        mask: True for primitives that stay, bool ``[N]``.
        weight: what each primitive counts ``[N]``: its blending weight in the training views.
        logits: whether ``features_dc`` holds logits of colours: the mean is that of the colours, as pictures have it.

    Returns:
        Parameters of those that stay ``[M, ...]``.
    """
    heir = heirs(graph, mask)
    if not logits:
        return merge(params, heir, weight)
    own = params["features_dc"].detach()
    colors = own.sigmoid()
    values = merge({**params, "features_dc": colors}, heir, weight)
    stay, mixed = mask.to(own.device), values["features_dc"]
    # There and back the logit of a saturated colour would be another.
    values["features_dc"] = torch.where(mixed == colors[stay], own[stay], rgb_to_logit(mixed))
    return values


@torch.no_grad()
def grown(params: Mapping[str, Tensor], mask: Tensor) -> dict[str, Tensor]:
    """Those that stay, larger by as much as their neighbours have moved away.

    All axes grow by the ratio of the spacing among those that stay to the spacing among all, but by no less than 1 and no
    more than ``sqrt(N / M)``, which is what the spacing on a surface grows by. Other parameters stay.

    Args:
        params: the field, all finite, N primitives.
        mask: True for primitives that stay, bool ``[N]``.

    Returns:
        Parameters of those that stay ``[M, ...]``.
    """
    kept = {name: value.detach()[mask.to(value.device)].clone() for name, value in params.items()}
    if len(kept["means"]) <= SPACING_NEIGHBORS:
        return kept
    before = (
        knn(params["means"].detach(), SPACING_NEIGHBORS).distances.double().mean(dim=1)[mask.to(params["means"].device)]
    )
    after = knn(kept["means"], SPACING_NEIGHBORS).distances.double().mean(dim=1)
    most = (len(mask) / len(after)) ** 0.5
    # 0 / 0 among clones of which several stay: nothing has moved away.
    factor = (after / before).nan_to_num(nan=1.0, posinf=most).clamp(1.0, most)
    kept["scales"] += factor.log()[:, None].to(kept["scales"].dtype)
    return kept
