"""Estimate of a primitive's contribution without cameras."""

from __future__ import annotations

import math
from collections.abc import Mapping

from torch import Tensor

from sundae_ns.gaussians.covariance import mean_projected_area


def footprint(params: Mapping[str, Tensor]) -> Tensor:
    """Opacity times the area of the one-sigma ellipsoid's shadow, averaged over all viewing directions.

    It ignores distance and occlusion: with cameras, summed blending weights are the better estimate.

    Returns:
        Footprints, float64 ``[N]``, squared scene units, on the field's device.
    """
    scales = params["scales"].detach().double()
    # Relative to the largest axis, so that no power overflows.
    largest = scales.amax(dim=1, keepdim=True)
    shadow = math.pi * mean_projected_area((scales - largest).exp())
    opacity = params["opacities"].detach().double().sigmoid().squeeze(-1)
    # Clamped, so that no size overflows float64.
    return opacity * shadow * (2 * largest.squeeze(-1)).clamp(-600, 600).exp()
