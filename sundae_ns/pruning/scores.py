"""Graph signals, their response, and scores: the importance of each primitive as one non-negative number."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from sundae_ns.errors import ConfigError
from sundae_ns.filters import high_pass, response_magnitude
from sundae_ns.gaussians.parameters import num_primitives, sh_to_rgb
from sundae_ns.graphs import NeighborGraph
from sundae_ns.pruning.edges import field_graph, graph_inputs
from sundae_ns.pruning.rule import PruneRule


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
    inputs = graph_inputs(params, rule)
    signal = attribute_signal(inputs) if rule.signal == "attributes" else inputs["means"].detach()
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


def attribute_signal(params: Mapping[str, Tensor]) -> Tensor:
    """Position, colour, opacity and log size, each without a unit and of similar spread ``[N, 10]``.

    Each group is divided by its own spread, so that no group dominates the response. The channels of a group share one
    spread: in a flat field, the flat axis must not be scaled up to the others.
    """
    groups = (
        params["means"],
        sh_to_rgb(params["features_dc"]),
        torch.sigmoid(params["opacities"]).reshape(-1, 1),
        params["scales"],
    )
    return torch.cat([_standardise(group.detach()) for group in groups], dim=1)


def _standardise(values: Tensor) -> Tensor:
    """Centre ``[N, C]`` on its medians and divide by the median norm; a constant group becomes 0.

    A few floaters or saturated colours would dominate a mean or a variance, but not a median. If more than half of the
    rows are equal, the median norm is 0 and the mean of the norms replaces it.
    """
    centred = values - values.median(dim=0).values
    norms = torch.linalg.vector_norm(centred, dim=1, dtype=torch.float64)
    spread = norms.median()
    if spread == 0:
        spread = norms.mean()
    return centred / spread if spread > 0 else torch.zeros_like(centred)
