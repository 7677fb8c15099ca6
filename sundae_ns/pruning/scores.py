"""Scores: the importance of each primitive as one non-negative number."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from sundae_ns.errors import ConfigError, DataError
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


@dataclass(frozen=True, eq=False)
class Response:
    """High-pass response of a field, and figures of its graph."""

    magnitude: Tensor
    """Squared norm of the response, pi of the paper, float64 ``[N]``; NaN for primitives without neighbours."""
    tau: float
    """Threshold of the graph on squared distances, squared scene units."""
    sigma: float
    """Width of the graph's weights, scene units."""
    isolated: int
    """Number of primitives without a neighbour within the threshold."""


def for_graph(params: Mapping[str, Tensor], config: PruningConfig) -> Mapping[str, Tensor]:
    """The parameters that graphs and signals use: colours as harmonics, on the configured device."""
    params = as_field(params).as_harmonics()
    if config.graph_device == "field":
        return params
    return {name: params[name].detach().cpu() for name in ("means", "features_dc", "opacities", "scales", "quats")}


@torch.no_grad()
def response(params: Mapping[str, Tensor], config: PruningConfig, graph: NeighborGraph | None = None) -> Response:
    """Magnitude of the high-pass response of the configured signal.

    Args:
        params: the field, all finite, N primitives.
        config: options of graph and signal.
        graph: graph of the field; built if not given.

    Raises:
        DataError: only one primitive, or positions that are not finite.
    """
    device = params["means"].device
    params = for_graph(params, config)
    graph = field_graph(params, config) if graph is None else graph
    signal = SIGNALS[config.signal](params)
    magnitude = response_magnitude(high_pass(graph, signal)).to(device)
    return Response(magnitude, graph.tau, graph.sigma, int(graph.isolated.sum()))


@torch.no_grad()
def score(
    params: Mapping[str, Tensor],
    config: PruningConfig,
    found: Response | None,
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
        config: names the score.
        found: result of :func:`response` on the same field; needed by scores with a response.
        contribution: returns the blending weights; needed by scores with a contribution, otherwise not called.

    Raises:
        ConfigError: the score needs a response or a contribution that is not given.
        DataError: the contribution does not have one value per primitive.
    """
    n = num_primitives(params)
    if config.score == "opacity":
        return torch.sigmoid(params["opacities"].detach().double()).reshape(n)
    if config.score == "random":
        return torch.ones(n, dtype=torch.float64, device=params["means"].device)
    if config.score in ("contribution", "detail-contribution"):
        return _weights(contribution, n, config)
    if config.score == "response":
        return _norm(found)
    return _weights(contribution, n, config) * _filled_with_median(_norm(found))


def _norm(found: Response | None) -> Tensor:
    if found is None:
        raise ConfigError("this score needs a graph response: pass the result of response(params, config)")
    return found.magnitude.double().sqrt()


def _filled_with_median(norm: Tensor) -> Tensor:
    known = norm[~norm.isnan()]
    # On a graph without edges no response is known: one value for all leaves the choice to the contribution.
    filling = known.median() if known.numel() else norm.new_tensor(1.0)
    return torch.where(norm.isnan(), filling, norm)


def _weights(contribution: Contribution | None, n: int, config: PruningConfig) -> Tensor:
    if contribution is None:
        raise ConfigError(
            f"score {config.score!r} needs a pass over the training views and there are none: "
            "use response, opacity or random"
        )
    weight = contribution().detach().double()
    if weight.shape != (n,):
        raise DataError(f"contribution has shape {list(weight.shape)} for {n} primitives: return [{n}]")
    return torch.nan_to_num(weight, nan=0.0)
