"""What a primitive may contribute to pictures, as far as it can be told without a camera."""

from __future__ import annotations

import math
from collections.abc import Mapping

from torch import Tensor

_P = 1.6075
"""Exponent of Thomsen's formula for the surface of an ellipsoid, which is off by at most 1.1 %."""


def footprint(params: Mapping[str, Tensor]) -> Tensor:
    """Opacity times the area of the one-sigma ellipsoid's shadow, averaged over all directions of view.

    The mean shadow of a convex body is a quarter of its surface (Cauchy, 1841). Neither distance nor what stands in front is
    in it: where there are cameras, blending weights over their pictures say more.

    Args:
        params: a field, all finite.

    Returns:
        ``[N]`` float64, scene units squared, on the field's device.
    """
    scales = params["scales"].detach().double()
    # Relative to the largest axis, so that no power leaves the range of numbers.
    largest = scales.amax(dim=1, keepdim=True)
    a, b, c = (scales - largest).exp().unbind(dim=1)
    mean = (((a * b) ** _P + (b * c) ** _P + (c * a) ** _P) / 3) ** (1 / _P)
    opacity = params["opacities"].detach().double().sigmoid().squeeze(-1)
    # Sizes beyond float64 are those of the largest and smallest numbers there are.
    return opacity * math.pi * mean * (2 * largest.squeeze(-1)).clamp(-600, 600).exp()
