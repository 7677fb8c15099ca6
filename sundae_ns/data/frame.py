"""Where the cameras of a capture stand: far from the origin, or one far from all others."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STRAY = 10.0
"""A camera is stray if it stands more than this many times as far from the middle as the others."""
MOST_STRAYS = 5
"""At most one camera in this many is a stray one; where there are more, they are part of the capture."""
LEAST_CAMERAS = 4
FINE_STEP, COARSE_STEP = 1e-5, 1e-3
"""Steps of float32 at the cameras, as shares of their distances: coordinates are shifted from the first one on, and
cannot be used from the second one on."""


def _distances(centres: Array) -> tuple[Array, Array]:
    """The middle ``[3]`` of camera centres ``[N, 3]`` and the distance ``[N]`` of each from it."""
    middle = np.median(centres, axis=0)
    return middle, np.linalg.norm(centres - middle, axis=1)


def stray_cameras(centres: Array, points: Callable[[], Array | None] = lambda: None) -> NDArray[np.bool_]:
    """Cameras so far from all others that they must not set the scene's centre and scale.

    Few cameras far away may also be all that moves, in a panorama from one place. There the points are as far as they.

    Args:
        centres: camera centres ``[N, 3]``.
        points: gives points of the scene ``[M, 3]``, in the same coordinates; called only if a camera is far away.

    Returns:
        Flags ``[N]``.
    """
    none = np.zeros(len(centres), dtype=bool)
    if len(centres) < LEAST_CAMERAS:
        return none
    middle, distances = _distances(centres)
    usual = float(np.sort(distances)[len(centres) - 1 - max(1, len(centres) // MOST_STRAYS)])
    far = distances > STRAY * usual
    if usual <= 0 or not far.any():
        return none
    cloud = points()
    if cloud is not None and len(cloud):
        reach = float(np.median(np.linalg.norm(cloud - middle, axis=1)))
        far &= distances > STRAY * reach
    return far


def float32_step(centres: Array) -> float:
    """Step between float32 numbers at the coordinates of camera centres ``[N, 3]``, as a share of their distances."""
    middle, distances = _distances(centres)
    usual = float(np.median(distances)) or float(distances.max())
    step = float(np.spacing(np.float32(np.abs(middle).max())))
    return step / usual if usual > 0 else 0.0


def far_offset(centres: Array) -> Array | None:
    """The middle ``[3]`` of camera centres ``[N, 3]``, if float32 is too coarse where they stand; None if it is not.

    Survey coordinates lie millions of metres from the origin, where float32 has steps of half a metre.
    """
    return _distances(centres)[0] if float32_step(centres) > FINE_STEP else None
