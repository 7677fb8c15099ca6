"""The neighbour graph of a field, with weights by distance, or by distance, overlap and colour."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from sundae_ns.gaussians.covariance import covariances_of, overlap
from sundae_ns.gaussians.field import as_field
from sundae_ns.gaussians.parameters import sh_to_rgb
from sundae_ns.graphs import NeighborGraph, build_graph
from sundae_ns.pruning.rule import PruneRule

LEAST_WIDTH = 0.25
"""Width added to primitives when their overlap is measured, as a share of the graph's sigma: some are flat."""

MOST_UNLIKE = 8.0
"""Largest difference of colours that counts, in typical differences. Weights fall to e^-32 and stay positive; otherwise
a primitive of an extreme colour would have no neighbour and could not be merged."""


def graph_inputs(params: Mapping[str, Tensor], rule: PruneRule) -> Mapping[str, Tensor]:
    """Parameters for graphs and signals: colours as harmonics, on the device of the graph."""
    params = as_field(params).as_harmonics()
    if rule.graph_device == "field":
        return params
    return {name: params[name].detach().cpu() for name in ("means", "features_dc", "opacities", "scales", "quats")}


@torch.no_grad()
def field_graph(params: Mapping[str, Tensor], rule: PruneRule) -> NeighborGraph:
    """Neighbour graph of a field, with the weights and on the device that the rule asks for.

    With ``centres``, as in the paper, weights fall with distance. ``appearance`` multiplies them by the overlap of the
    two primitives (Bhattacharyya) and by ``exp(-|c_i - c_j|^2 / (2 s^2))`` for their colours, s being the root mean
    square difference over all edges. As in a bilateral filter, primitives on two sides of an image edge are hardly
    neighbours.

    A field of at most ``num_neighbors`` primitives has the graph of all pairs within reach.

    Args:
        params: the field, all finite, N primitives.

    Raises:
        DataError: only one primitive, or positions that are not finite.
    """
    params = graph_inputs(params, rule)
    means = params["means"].detach()
    graph = build_graph(
        means,
        num_neighbors=min(rule.num_neighbors, max(len(means) - 1, 1)),
        rule=rule.bandwidth,
        tau=rule.tau,
        sigma=rule.sigma,
    )
    if rule.edges == "centres" or not rule.uses_edge_weights:
        return graph
    # In place: of a large field, each value per edge takes gigabytes.
    weights = graph.weights.mul_(_color_affinity(sh_to_rgb(params["features_dc"].detach()), graph))
    weights *= overlap(means, covariances_of(params), graph.indices, least_width=LEAST_WIDTH * graph.sigma)
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
