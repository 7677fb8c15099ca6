"""Scores: what a Gaussian contributes to the detail of images, or the response of a graph filter to its attributes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from sundae_ns.core.errors import ConfigError, DataError
from sundae_ns.core.gaussians import as_gaussians, sh_to_rgb
from sundae_ns.graph.filters import high_pass, response_magnitude
from sundae_ns.graph.graph import NeighborGraph
from sundae_ns.pruning.merge import gaussian_graph
from sundae_ns.pruning.rule import PruneRule


@torch.no_grad()
def score(
    params: Mapping[str, Tensor], rule: PruneRule, graph: NeighborGraph | None, contribution: Tensor | None
) -> Tensor:
    """Score of each Gaussian of a finite field by the rule, float64 ``[N]``; NaN for a response without neighbours.

    The response enters as the norm ``|f_i| = sqrt(pi_i)``. Its ranking is that of ``pi_i``, and sampling in proportion
    to the norm gives the least expected error (Chen et al., "Fast Resampling of Three-Dimensional Point Clouds via
    Graphs", 2018). ``contribution`` is ``[N]``; ``ConfigError`` if it is needed and missing, ``DataError`` if a
    function as score returns another shape.
    """
    if callable(rule.score):
        if (values := rule.score(params)).shape != (len(params["means"]),):
            raise DataError(f"a score has shape {list(values.shape)} for {len(params['means'])} Gaussians: return [N]")
        return values.double()
    if rule.score == "response":
        return response(params, rule, graph).sqrt()
    if contribution is None:
        raise ConfigError(f"score {rule.score!r} needs a pass over the training views: give views, or use response")
    return torch.nan_to_num(contribution.double(), nan=0.0)


@torch.no_grad()
def response(params: Mapping[str, Tensor], rule: PruneRule, graph: NeighborGraph | None = None) -> Tensor:
    """Squared norm of the high-pass response of the rule's signal, pi of the paper, float64 ``[N]``.

    NaN for Gaussians without neighbours. ``DataError`` for a single Gaussian, or positions that are not finite.
    """
    graph = gaussian_graph(params, rule) if graph is None else graph
    signal = attribute_signal(params) if rule.signal == "attributes" else params["means"].detach()
    return response_magnitude(high_pass(graph, signal))


def attribute_signal(params: Mapping[str, Tensor]) -> Tensor:
    """Position, colour, opacity and log size, each without a unit and of similar spread ``[N, 10]``.

    Each group is divided by its own spread, which its channels share: flat axes must not be scaled up to the others.
    """
    params = as_gaussians(params).as_harmonics()
    colors, opacities = sh_to_rgb(params["features_dc"]), params["opacities"].sigmoid().reshape(-1, 1)
    groups = (params["means"], colors, opacities, params["scales"])
    return torch.cat([_standardise(group.detach()) for group in groups], dim=1)


def _standardise(values: Tensor) -> Tensor:
    """Centre ``[N, C]`` on medians, which floaters do not move, and divide by the median norm, else the mean norm."""
    centred = values - values.median(dim=0).values
    norms = torch.linalg.vector_norm(centred, dim=1, dtype=torch.float64)
    spread = norms.median() or norms.mean()
    return centred / spread if spread > 0 else torch.zeros_like(centred)


@torch.no_grad()
def pixel_detail(image: Tensor, cells: float) -> Tensor:
    """Local deviation of an image ``[H, W, C]`` from its mean over a cell, as weights of mean 1 ``[H, W]``.

    A Gaussian covers a cell of about ``H W / cells`` pixels, and the deviation within a window of that size is the
    detail that it cannot show. The squared error of n cells is least if their density is proportional to the gradient
    (minimise ``int |grad f|^2 / density``), and in a smooth image the deviation is proportional to the gradient. Values
    are float32 or float64; those that are not finite count as 0 or as the largest number.
    """
    height, width = image.shape[:2]
    side = round((height * width / max(cells, 1.0)) ** 0.5)
    half = max(1, min(side, height, width) // 2)  # of an odd window of at least 3 pixels
    values = image.detach().nan_to_num().permute(2, 0, 1).contiguous()
    values = values - values[:, :1, :1]  # a flat image has sums of exactly 0
    if values.is_cpu:
        from cv2 import BORDER_CONSTANT, CV_64F, boxFilter, sqrBoxFilter  # takes 0.1 s, also where nothing is pruned

        # By running sums in float64, plane by plane; those of ones count the pixels of a window within the image.
        box: Any = {"ddepth": CV_64F, "ksize": (2 * half + 1,) * 2, "normalize": False, "borderType": BORDER_CONSTANT}
        share = 1 / boxFilter(torch.ones_like(values[0]).numpy(), **box)
        means = (boxFilter(plane, **box) * share for plane in values.numpy())
        squares = sum(sqrBoxFilter(plane, **box) for plane in values.numpy()) * share
        variance = torch.from_numpy(squares - sum(mean * mean for mean in means)).clamp_min_(0)
    else:
        values = torch.cat([values, values.double().square().sum(dim=0, keepdim=True)])
        for y, x in ((half, 0), (0, half)):  # columns, then rows
            values = avg_pool2d(values, (2 * y + 1, 2 * x + 1), 1, (y, x), count_include_pad=False)
        variance = (values[-1] - values[:-1].square().sum(dim=0)).clamp_min(0)
    if not (mean := variance.mean()) > 0:
        return torch.ones_like(variance).to(image.dtype)
    # A flat pixel has a weight too, a quarter of the root mean square: flat areas need some Gaussians.
    weights = (variance + 0.25**2 * mean).sqrt()
    return (weights / weights.mean()).to(image.dtype)
