"""Primitives right in front of a camera, where the scene has nothing.

A primitive that is near enough to one camera can explain what differs between its photo and the others, and covers much
of the images of cameras beside it (such floaters are described by Philip and Deschaintre, "Floaters No More", 2023).
The sparse points of structure from motion say how near the scene comes to the cameras.
"""

from __future__ import annotations

import torch
from torch import Tensor

NEAREST = 0.01
"""Share of the sparse points that may be nearer to a camera than the scene is taken to be: some of them are wrong."""
FREE = 2 / 3
"""Share of that distance which is taken to be empty."""
MOST = 0.05
"""Largest share of the primitives that can be floaters; with more of them the points do not say where the scene is."""
_ROWS = 1 << 16


def _distances_to_nearest(points: Tensor, eyes: Tensor) -> Tensor:
    """Distance of each point ``[N, 3]`` to the nearest of some others ``[V, 3]``: ``[N]``, world units."""
    if not len(points):  # a rank without primitives
        return points.new_zeros(0)
    return torch.cat([torch.cdist(rows, eyes).amin(dim=1) for rows in points.split(_ROWS)])


@torch.no_grad()
def near_cameras(means: Tensor, eyes: Tensor, points: Tensor) -> Tensor:
    """True for primitives that float in front of a camera, bool ``[N]``.

    Args:
        means: centres ``[N, 3]``, world units.
        eyes: positions of the training cameras ``[V, 3]``.
        points: sparse points of the scene ``[P, 3]``.

    Returns:
        False everywhere without points or cameras.
    """
    finite = points[points.isfinite().all(dim=1)].to(means)
    if not len(finite) or not len(eyes):
        return torch.zeros(len(means), dtype=torch.bool, device=means.device)
    eyes = eyes.to(means)
    found = _distances_to_nearest(finite, eyes).sort().values
    free = FREE * found[int(NEAREST * (len(found) - 1))]
    return _distances_to_nearest(means, eyes) < free
