"""Graph signals of a Gaussian field, the input of the filters."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from sundae_ns.gaussians.parameters import sh_to_rgb


def position_signal(params: Mapping[str, Tensor]) -> Tensor:
    """The paper's signal: centres in scene units ``[N, 3]``."""
    return params["means"].detach()


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
