"""Scores: the importance of each primitive as one non-negative number."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from sundae_ns.errors import ConfigError
from sundae_ns.filters import high_pass, response_magnitude
from sundae_ns.gaussians.field import as_field
from sundae_ns.gaussians.parameters import num_primitives
from sundae_ns.graphs import NeighborGraph
from sundae_ns.pruning.config import PruningConfig
from sundae_ns.pruning.edges import field_graph
from sundae_ns.pruning.signals import attribute_signal, position_signal

SIGNALS = {"attributes": attribute_signal, "positions": position_signal}

Contribution = Callable[[], Tensor]
"""Returns the summed blending weights over the training views ``[N]``; expensive, so called only if needed."""


def for_graph(params: Mapping[str, Tensor], config: PruningConfig) -> Mapping[str, Tensor]:
    """The parameters that graphs and signals use: colours as harmonics, on the configured device."""
    params = as_field(params).as_harmonics()
    if config.graph_device == "field":
        return params
    return {name: params[name].detach().cpu() for name in ("means", "features_dc", "opacities", "scales", "quats")}


@torch.no_grad()
def response(params: Mapping[str, Tensor], config: PruningConfig, graph: NeighborGraph | None = None) -> Tensor:
    """Squared norm of the high-pass response of the configured signal, pi of the paper.

    Args:
        params: the field, all finite, N primitives.
        graph: graph of the field; built if not given.

    Returns:
        float64 on the field's device ``[N]``; NaN for primitives without neighbours.

    Raises:
        DataError: only one primitive, or positions that are not finite.
    """
    device = params["means"].device
    params = for_graph(params, config)
    graph = field_graph(params, config) if graph is None else graph
    return response_magnitude(high_pass(graph, SIGNALS[config.signal](params))).to(device)


@torch.no_grad()
def score(
    params: Mapping[str, Tensor],
    config: PruningConfig,
    magnitude: Tensor | None,
    contribution: Contribution | None,
) -> Tensor:
    """Configured score of each primitive, float64 ``[N]``.

    The response enters as the norm ``|f_i| = sqrt(pi_i)``. Its ranking is that of ``pi_i``, and sampling in proportion to the
    norm gives the least expected error (Chen et al., "Fast Resampling of Three-Dimensional Point Clouds via Graphs", 2018).

    A primitive without neighbours has no response. Its ``response`` score is NaN, which every selection ranks last. For
    ``response-contribution`` it gets the median response, so that its contribution decides: a large patch of sky stays and a
    faint floater does not.

    Args:
        params: the field, all finite, N primitives.
        magnitude: result of :func:`response` on the same field; needed by scores with a response.
        contribution: returns the blending weights ``[N]``; needed by scores with a contribution, otherwise not called.

    Raises:
        ConfigError: the score needs a contribution that is not given.
    """
    n = num_primitives(params)
    if config.score == "opacity":
        return torch.sigmoid(params["opacities"].detach().double()).reshape(n)
    if config.score == "random":
        return torch.ones(n, dtype=torch.float64, device=params["means"].device)
    if config.score == "contribution" or config.uses_detail:
        return _weights(contribution, config)
    assert magnitude is not None
    norm = magnitude.double().sqrt()
    return norm if config.score == "response" else _weights(contribution, config) * _filled_with_median(norm)


def _filled_with_median(norm: Tensor) -> Tensor:
    known = norm[~norm.isnan()]
    # On a graph without edges no response is known: one value for all leaves the choice to the contribution.
    filling = known.median() if known.numel() else norm.new_tensor(1.0)
    return torch.where(norm.isnan(), filling, norm)


def _weights(contribution: Contribution | None, config: PruningConfig) -> Tensor:
    if contribution is None:
        raise ConfigError(
            f"score {config.score!r} needs a pass over the training views and there are none: "
            "use response, opacity or random"
        )
    return torch.nan_to_num(contribution().detach().double(), nan=0.0)
