"""Floaters: Gaussians right in front of a camera where the scene has nothing, and those unlike what is around them.

A Gaussian near one camera can explain what differs between its photo and the others (Philip and Deschaintre, "Floaters
No More", 2023). The sparse points of structure from motion say how near the scene comes to the cameras, and where.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sundae_ns.core.covariance import rotation_matrices
from sundae_ns.core.gaussians import Gaussians, sh_to_rgb
from sundae_ns.graph.neighbors import knn

NEAREST = 0.01  # Share of the sparse points that may be nearer to a camera than the scene: some of them are wrong
FREE = 2 / 3  # share of that distance which is taken to be empty
SUPPORT, REACH = 3, 0.5  # Something near has as many sparse points within this share of the empty distance
STRENGTH = 0.25  # Default strength of a cleaning, from 0 to 1
MOST_FLOATERS = 0.05  # Largest share that can be floaters; with more of them the points do not say where the scene is


def _distances(points: Tensor, others: Tensor, nth: int = 1) -> Tensor:
    """Distance of each point ``[N, 3]`` to the nth nearest of some others ``[M, 3]``, infinite without: ``[N]``."""
    if len(others) < nth or not len(points):
        return points.new_full((len(points),), torch.inf)
    # From one of them, because cdist squares coordinates, whose digits a scene far from the origin would take.
    points, others = (each - others[0].nan_to_num() for each in (points, others))
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
    near[near.clone()] = _distances(means[near], finite[distances < (1 + REACH) * free], SUPPORT) > REACH * free
    return near


@torch.no_grad()
def floater_odds(gaussians: Gaussians) -> Tensor:
    """Logarithm of the odds that a Gaussian of a finite field floats, by its 16 nearest, float64 ``[N]``.

    Balls in the air or of other colours, and long needles, may float: the density and the colour of the others at their
    centres decide. Weights by logistic regression on floaters planted in seven fields (``benchmarks/cleaning.py``).
    """
    n, means = gaussians.num_gaussians, gaussians["means"].detach().double()
    if n < 2:
        return means.new_full((n,), -torch.inf)
    near = knn(means, min(16, n - 1))
    away = (means - means.median(dim=0).values).norm(dim=1)
    reach = away.median() or away.mean()
    away = (away / reach).clamp_min(0.05).log()
    opacities, widths = gaussians["opacities"].detach()[:, 0].sigmoid(), gaussians["scales"].detach().double()
    short, middle, long = (widths - reach.log()).sort(dim=1).values.unbind(dim=1)
    gaps = (near.distances[:, [min(3, n - 2), -1]] / reach).clamp_min(1e-9).log() - long[:, None]
    gap, wide_gap = gaps[:, 0].clamp(-2, 4), gaps[:, 1].clamp(-1, 4)
    larger = (long[:, None] - long[near.indices]).median(dim=1).values
    colors = sh_to_rgb(gaussians.as_harmonics()["features_dc"].detach()).clamp(0, 1)
    around = colors[near.indices]
    usual = around.median(dim=1).values
    unlike = (colors - usual).abs().amax(dim=1).clamp_max(0.4)  # in the channel that differs most
    mixed = (around - usual[:, None]).abs().amax(dim=2).median(dim=1).values.clamp_max(0.4)
    ball = 11.5 * unlike + 5 * mixed + 0.9 * larger + 1.3 * long + 2 * (short - long).clamp_min(-4) + 0.4
    ball += 1.2 * gap + wide_gap - 1.9 * away.clamp_min(0) + 3 * (1 - 5 * opacities).clamp_min(0)  # haze
    first = torch.where(long - middle > math.log(10), 14 * unlike + 2 * larger - 7.5, ball)
    first -= 5 * (long + math.log(2)).clamp_min(0)  # Gaussians larger than half the scene are its background
    first -= 1.5 * first.kthvalue(math.ceil((1 - MOST_FLOATERS) * n)).values.clamp_min(0)  # sparse points are all alone
    odds = 1.3 * first + 1.9 * long - 2.2 * away + 1.7 * wide_gap + 0.33 * (long - middle) + 0.4
    for rows in (first > 0).nonzero()[:, 0].split(1 << 16):
        others = near.indices[rows]
        turns = rotation_matrices(gaussians["quats"].detach().double()[others].flatten(0, 1)).view(*others.shape, 3, 3)
        steps = ((means[rows, None] - means[others])[..., None, :] @ turns)[..., 0, :] / widths[others].exp()
        weights = (opacities[others] * (-steps.square().sum(dim=2) / 2).exp())[..., None]
        density, color = weights.sum(dim=1), (weights * colors[others]).sum(dim=1)
        odds[rows] += 5.8 * (color / density.clamp_min(1e-9) - colors[rows]).abs().amax(dim=1)
        odds[rows] += 0.37 * (density[:, 0] + 1e-3).log()
    return torch.where(first > 0, odds, -torch.inf)
