"""How important a primitive is: one non-negative number each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from sundae_ns.errors import ConfigError, DataError
from sundae_ns.filters import high_pass, local_coherence, response_magnitude
from sundae_ns.gaussians.parameters import num_primitives, rgb_to_sh
from sundae_ns.graphs import NeighborGraph, laplacian
from sundae_ns.pruning.config import PruningConfig
from sundae_ns.pruning.edges import field_graph
from sundae_ns.pruning.signals import attribute_signal, color_signal, position_signal

SIGNALS = {"attributes": attribute_signal, "colors": color_signal, "positions": position_signal}

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


def for_graph(params: Mapping[str, Tensor], config: PruningConfig) -> Mapping[str, Tensor]:
    """What graphs and signals of a field are made from: colours as harmonics, on the device that the configuration names."""
    if config.logits:
        params = {**params, "features_dc": rgb_to_sh(params["features_dc"].detach().sigmoid())}
    if config.graph_device == "field":
        return params
    return {name: params[name].detach().cpu() for name in ("means", "features_dc", "opacities", "scales", "quats")}


@torch.no_grad()
def response(params: Mapping[str, Tensor], config: PruningConfig, graph: NeighborGraph | None = None) -> Response:
    """Magnitude of the high-pass response of the configured signal.

    Args:
        params: the field, all finite, N primitives.
        config: graph and signal are taken from it.
        graph: the field's graph, where it is at hand.

    Raises:
        DataError: there is only one primitive, or positions are not finite.
    """
    device = params["means"].device
    params = for_graph(params, config)
    graph = field_graph(params, config) if graph is None else graph
    signal = SIGNALS[config.signal](params)
    magnitude = response_magnitude(high_pass(graph, signal, isolated="nan")).to(device)
    return Response(magnitude, graph.tau, graph.sigma, int(graph.isolated.sum()))


@torch.no_grad()
def coherence(graph: NeighborGraph, count: int, config: PruningConfig, device: torch.device) -> Tensor:
    """Local coherence of a graph in the band of ``count`` frequencies, float64 ``[N]``, computed on the device.

    The Laplacian is the combinatorial one: where primitives crowd, edges are many and the frequencies high, and so a crowd
    gets no more samples than it has band. See :func:`sundae_ns.filters.local_coherence`.
    """
    return local_coherence(laplacian(graph), count, seed=config.seed, device=device)


@torch.no_grad()
def score(
    params: Mapping[str, Tensor],
    config: PruningConfig,
    found: Response | None,
    contribution: Contribution | None,
    coherent: Tensor | None = None,
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
        coherent: result of :func:`coherence`; needed by the scores with a coherence.

    Raises:
        ConfigError: the score needs a response or a contribution and there is none.
        DataError: the contribution has not one value per primitive.
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
    if config.uses_coherence:
        if coherent is None:
            raise ConfigError("this score needs a coherence: compute it first with coherence(graph, count, ...)")
        return coherent if config.score == "coherence" else _weights(contribution, n, config) * coherent
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
