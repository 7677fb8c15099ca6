"""Gaussians right in front of a camera, where the scene has nothing.

A Gaussian that is near enough to one camera can explain what differs between its photo and the others, and covers much
of the images of cameras beside it (such floaters are described by Philip and Deschaintre, "Floaters No More", 2023).
The sparse points of structure from motion say how near the scene comes to the cameras, and where it comes nearer.
"""

from __future__ import annotations

import torch
from torch import Tensor

NEAREST = 0.01  # Share of the sparse points that may be nearer to a camera than the scene: some of them are wrong
FREE = 2 / 3  # share of that distance which is taken to be empty
SUPPORT, REACH = 3, 0.5
"""A Gaussian is no floater if this many sparse points are within this share of the empty distance from it: a few
photos may be of something near. Wrong points lie alone."""
MOST = 0.05  # Largest share that can be floaters; with more of them the points do not say where the scene is


def _distances(points: Tensor, others: Tensor, nth: int = 1) -> Tensor:
    """Distance of each point ``[N, 3]`` to the nth nearest of some others ``[M, 3]``, infinite without: ``[N]``."""
    if len(others) < nth or not len(points):
        return points.new_full((len(points),), torch.inf)
    nearest = (torch.cdist(rows, others).topk(nth, largest=False).values for rows in points.split(1 << 14))
    return torch.cat([distances[:, -1] for distances in nearest])


@torch.no_grad()
def near_cameras(means: Tensor, eyes: Tensor, points: Tensor) -> Tensor:
    """True for Gaussians ``[N, 3]`` that float in front of a camera, bool ``[N]``; never without points or cameras.

    ``eyes`` ``[V, 3]`` are of the training cameras, ``points`` ``[P, 3]`` the sparse ones of the scene; world units.
    """
    finite = points[points.isfinite().all(dim=1)].to(means)
    if not len(finite) or not len(eyes):
        return torch.zeros(len(means), dtype=torch.bool, device=means.device)
    eyes = eyes.to(means)
    distances = _distances(finite, eyes)
    free = FREE * distances.sort().values[int(NEAREST * (len(finite) - 1))]
    near = _distances(means, eyes) < free
    about = finite[distances < (1 + REACH) * free]
    near[near.clone()] = _distances(means[near], about, SUPPORT) > REACH * free
    return near
