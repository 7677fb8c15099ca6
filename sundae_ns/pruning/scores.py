"""Scores: the importance of each primitive as one non-negative number."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from sundae_ns.errors import ConfigError
from sundae_ns.filters import high_pass, response_magnitude
from sundae_ns.gaussians.parameters import num_primitives
from sundae_ns.graphs import NeighborGraph
from sundae_ns.pruning.edges import field_graph, graph_inputs
from sundae_ns.pruning.rule import PruneRule
from sundae_ns.pruning.signals import attribute_signal, position_signal

SIGNALS = {"attributes": attribute_signal, "positions": position_signal}


@torch.no_grad()
def response(params: Mapping[str, Tensor], rule: PruneRule, graph: NeighborGraph | None = None) -> Tensor:
    """Squared norm of the high-pass response of the rule's signal, pi of the paper.

    Args:
        params: the field, all finite, N primitives.
        graph: graph of the field; built if not given.

    Returns:
        float64 on the field's device ``[N]``; NaN for primitives without neighbours.

    Raises:
        DataError: only one primitive, or positions that are not finite.
    """
    graph = field_graph(params, rule) if graph is None else graph
    signal = SIGNALS[rule.signal](graph_inputs(params, rule))
    return response_magnitude(high_pass(graph, signal)).to(params["means"].device)


@torch.no_grad()
def score(
    params: Mapping[str, Tensor], rule: PruneRule, magnitude: Tensor | None, contribution: Tensor | None
) -> Tensor:
    """Score of each primitive by the rule, float64 ``[N]``.

    The response enters as the norm ``|f_i| = sqrt(pi_i)``. Its ranking is that of ``pi_i``, and sampling in proportion
    to the norm gives the least expected error (Chen et al., "Fast Resampling of Three-Dimensional Point Clouds via
    Graphs", 2018).

    A primitive without neighbours has no response. Its ``response`` score is NaN, which every selection ranks last. For
    ``response-contribution`` it gets the median response, so that its contribution decides: a large patch of sky stays
    and a faint floater does not.

    Args:
        params: the field, all finite, N primitives.
        magnitude: result of :func:`response` on the same field; needed by scores with a response.
        contribution: blending weights ``[N]``; needed by scores with a contribution.

    Raises:
        ConfigError: the score needs a contribution that is not given.
    """
    n = num_primitives(params)
    if rule.score == "opacity":
        return torch.sigmoid(params["opacities"].detach().double()).reshape(n)
    if rule.score == "random":
        return torch.ones(n, dtype=torch.float64, device=params["means"].device)
    if rule.score == "response":
        assert magnitude is not None
        return magnitude.double().sqrt()
    if contribution is None:
        raise ConfigError(
            f"score {rule.score!r} needs a pass over the training views and there are none: "
            "use response, opacity or random"
        )
    weights = torch.nan_to_num(contribution.double(), nan=0.0)
    if not rule.uses_response:
        return weights
    assert magnitude is not None
    norm = magnitude.double().sqrt()
    known = norm[~norm.isnan()]
    # On a graph without edges no response is known: one value for all leaves the choice to the contribution.
    filling = known.median() if known.numel() else norm.new_tensor(1.0)
    return weights * torch.where(norm.isnan(), filling, norm)
