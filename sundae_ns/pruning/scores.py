"""How important a primitive is: one non-negative number each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from sundae_ns.errors import ConfigError, DataError
from sundae_ns.filters import high_pass, response_magnitude
from sundae_ns.gaussians.parameters import num_primitives
from sundae_ns.graphs import build_graph
from sundae_ns.pruning.config import PruningConfig
from sundae_ns.pruning.signals import attribute_signal, position_signal

Contribution = Callable[[], Tensor]
"""Gives the summed blending weight of each primitive over the training views ``[N]``; expensive, so called on need."""


@dataclass(frozen=True, eq=False)
class Response:
    """High-pass response of a field, and the graph it was taken on."""

    magnitude: Tensor
    """Squared norm of the response, pi of the paper, float64 ``[N]``; NaN for primitives without neighbours."""
    tau: float
    """Threshold of the graph on squared distances, squared scene units."""
    sigma: float
    """Width of the graph's weights, scene units."""
    isolated: int
    """How many primitives have no neighbour within the threshold."""


@torch.no_grad()
def response(params: Mapping[str, Tensor], config: PruningConfig) -> Response:
    """Magnitude of the high-pass response of the configured signal.

    Args:
        params: the field, all finite, N primitives.
        config: graph and signal are taken from it.

    Raises:
        DataError: there are not more primitives than neighbours, or positions are not finite.
    """
    device = params["means"].device
    if config.graph_device == "cpu":
        params = {name: params[name].cpu() for name in ("means", "features_dc", "opacities", "scales")}
    graph = build_graph(
        params["means"],
        num_neighbors=config.num_neighbors,
        rule=config.bandwidth,
        tau=config.tau,
        sigma=config.sigma,
    )
    signal = position_signal(params) if config.signal == "positions" else attribute_signal(params)
    magnitude = response_magnitude(high_pass(graph, signal, isolated="nan")).to(device)
    return Response(magnitude, graph.tau, graph.sigma, int(graph.isolated.sum()))


@torch.no_grad()
def score(
    params: Mapping[str, Tensor], config: PruningConfig, found: Response | None, contribution: Contribution | None
) -> Tensor:
    """Score of the configured name, float64 ``[N]``.

    The response enters as the norm ``|f_i| = sqrt(pi_i)``. Rankings are the same for both, and for sampling the norm is
    the right one: probabilities in proportion to it give the sampled field the least expected error (Chen et al., "Fast
    Resampling of Three-Dimensional Point Clouds via Graphs", 2018).

    A primitive without neighbours has no response. Under ``response`` its score is NaN, which every selection ranks
    last. Under ``response-contribution`` it gets the median response: it is judged by its contribution alone, so that a
    lone but large patch of sky survives and a faint floater does not.

    Args:
        params: the field, all finite, N primitives.
        config: names the score.
        found: result of :func:`response` on the same field; needed by the scores with a response.
        contribution: gives the blending weights; needed by the scores with a contribution, else not called.

    Raises:
        ConfigError: the score needs a response or a contribution and there is none.
        DataError: the contribution has not one value per primitive.
    """
    n = num_primitives(params)
    if config.score == "opacity":
        return torch.sigmoid(params["opacities"].detach().double()).reshape(n)
    if config.score == "random":
        return torch.ones(n, dtype=torch.float64, device=params["means"].device)
    if config.score == "contribution":
        return _weights(contribution, n, config)
    if config.score == "response":
        return _norm(found)
    return _weights(contribution, n, config) * _filled_with_median(_norm(found))


def _norm(found: Response | None) -> Tensor:
    if found is None:
        raise ConfigError("this score needs a graph response: compute it first with response(params, config)")
    return found.magnitude.double().sqrt()


def _filled_with_median(norm: Tensor) -> Tensor:
    known = norm[~norm.isnan()]
    # On a graph without any edge nothing is known of anyone, and the same value for all leaves the contribution.
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
