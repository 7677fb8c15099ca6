"""Primitives sharded over ranks, a camera on each: which primitives a camera may see, and how they get there and back.

Rank r holds N_r primitives and draws one picture. Rows of primitives travel to the ranks whose cameras may see them, before
projection, so that every backend draws them as it draws any others. Collectives are those of ``torch.distributed``, on the
default process group; each function that says "collective" is to be called by all ranks, in the same order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
import torch.distributed as dist
from torch import Tensor

from sundae_ns.rasterization.projection import BLUR, FOV_MARGIN


class Cameras(NamedTuple):
    """Pinhole cameras, one a rank; sizes are tensors, so that none has to be read from a GPU."""

    viewmats: Tensor
    """World-to-camera ``[R, 4, 4]``."""
    Ks: Tensor
    """Intrinsics in pixels ``[R, 3, 3]``."""
    sizes: Tensor
    """Width and height in pixels ``[R, 2]``."""

    @property
    def centers(self) -> Tensor:
        """Where they stand ``[R, 3]``."""
        return -(self.viewmats[:, :3, :3].mT @ self.viewmats[:, :3, 3:])[..., 0]


@torch.no_grad()
def gather_cameras(viewmat: Tensor, K: Tensor, width: int, height: int) -> Cameras:
    """The cameras of all ranks by rank, detached. Collective.

    Args:
        viewmat: this rank's world-to-camera transform ``[4, 4]``.
        K: its intrinsics in pixels ``[3, 3]``.
        width, height: size of its picture in pixels.
    """
    own = torch.cat([viewmat.reshape(16), K.reshape(9), viewmat.new_tensor([width, height])])
    every = own.new_empty(dist.get_world_size() * len(own))
    dist.all_gather_into_tensor(every, own)
    every = every.view(-1, len(own))
    return Cameras(every[:, :16].reshape(-1, 4, 4), every[:, 16:25].reshape(-1, 3, 3), every[:, 25:])


@torch.no_grad()
def may_be_seen(means: Tensor, scales: Tensor, cameras: Cameras, near_plane: float, far_plane: float) -> Tensor:
    """True for every primitive that a backend gives a radius above 0, and for some others; bool ``[R, N]``.

    The radius is at most three standard deviations of the footprint, whose variance is at most its trace. A row of the
    perspective map's Jacobian has length ``f / z * sqrt(1 + k^2)`` for a slope k, so the trace is at most
    ``(s / z)^2 (fx^2 (1 + kx^2) + fy^2 (1 + ky^2))`` for the largest scale s, plus the blur.

    Args:
        means: centres ``[N, 3]``.
        scales: standard deviations, after activation ``[N, 3]``.
        cameras: R of them.
        near_plane, far_plane: as the rasteriser gets them.
    """
    turned = means @ cameras.viewmats[:, :3, :3].mT + cameras.viewmats[:, None, :3, 3]
    z = turned[..., 2:]
    focals, centres = cameras.Ks[:, :2, :2].diagonal(dim1=-2, dim2=-1), cameras.Ks[:, :2, 2]
    # A row a camera, to be spread over primitives.
    sizes, focals, centres = (value[:, None] for value in (cameras.sizes, focals, centres))
    slopes = turned[..., :2] / z
    margins = 0.5 * FOV_MARGIN * sizes / focals
    held = slopes.maximum(-centres / focals - margins).minimum((sizes - centres) / focals + margins)
    spread = (focals * held).square().sum(-1) + focals.square().sum(-1)
    z = z[..., 0]
    variance = (scales.amax(dim=1) / z).square() * spread + 2 * BLUR
    reach = (3.003 * variance.sqrt() + 1)[..., None]  # three deviations, rounding up, and rounding
    # From the middle of the picture. Said the other way round, NaN would count as unseen here, and the backends would disagree.
    outside = (slopes * focals + centres - sizes / 2).abs() - reach >= sizes / 2
    return (z >= max(near_plane, torch.finfo(z.dtype).tiny)) & (z <= far_plane) & ~outside.any(dim=-1)


@dataclass(frozen=True)
class Route:
    """Who sent what where in one exchange."""

    ids: Tensor
    """Rows of this rank's shard in the order in which they were sent: camera by camera ``[S]``."""
    sent: list[int]
    """How many went to each rank; the sum is S."""
    received: list[int]
    """How many came from each rank; the sum is M."""


@torch.no_grad()
def plan_route(seen: Tensor) -> Route:
    """Say how many rows go to each rank, and hear how many come. Collective.

    Args:
        seen: whether a row of this shard goes to a rank, bool ``[R, N]``.
    """
    sent = seen.sum(dim=1)
    received = torch.empty_like(sent)
    dist.all_to_all_single(received, sent)
    counts = torch.stack([sent, received]).tolist()
    return Route(seen.nonzero()[:, 1], *counts)


def swap(rows: Tensor, sent: list[int], received: list[int]) -> Tensor:
    """Send blocks of rows to all ranks, and get one from each. Collective.

    Args:
        rows: the blocks in order of the ranks that they go to ``[sum(sent), ...]``.
        sent: rows for each rank.
        received: rows from each rank.

    Returns:
        ``[sum(received), ...]``, in order of the ranks that they come from.
    """
    incoming = rows.new_empty(sum(received), *rows.shape[1:])
    dist.all_to_all_single(incoming, rows.contiguous(), received, sent)
    return incoming


class _Exchange(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rows: Tensor, route: Route) -> Tensor:
        ctx.route = route
        return swap(rows, route.sent, route.received)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        route: Route = ctx.route
        return swap(gradient, route.received, route.sent) / len(route.sent), None


def exchange(rows: Tensor, route: Route) -> Tensor:
    """Send rows to the ranks of their cameras. Collective, and so is the backward pass.

    Gradients come back divided by the number of ranks: what all ranks' losses together do to a row is what their mean
    does to it on one process.

    Args:
        rows: in the order of ``route.ids`` ``[S, D]``.
        route: from :func:`plan_route`.

    Returns:
        ``[M, D]``, in order of the ranks that hold them, and within each in the order of its shard.
    """
    return _Exchange.apply(rows, route)  # type: ignore[no-untyped-call]


@torch.no_grad()
def give_back(values: Tensor, route: Route) -> Tensor:
    """Send what was found about received rows back to their holders. Collective.

    Args:
        values: in the order of what :func:`exchange` gave ``[M, D]``.
        route: the one of that exchange.

    Returns:
        ``[S, D]`` in the order of ``route.ids``, not divided by anything.
    """
    return swap(values, route.received, route.sent)
