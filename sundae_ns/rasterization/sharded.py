"""Primitives sharded over ranks, a camera on each: which primitives a camera may see, and how they get there and back.

Rank r holds N_r primitives and draws one picture. Rows of primitives travel to the ranks whose cameras may see them, before
projection, so that every backend draws them as it draws any others. Collectives are those of ``torch.distributed``, on the
default process group; each function that says "collective" is to be called by all ranks, in the same order.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
import torch.distributed as dist
from torch import Tensor

from sundae_ns.rasterization.projection import BLUR, FOV_MARGIN, camera_center


class Cameras(NamedTuple):
    """What ranks know of each other's cameras: where they stand, and what they cannot see."""

    centers: Tensor
    """Where they stand ``[R, 3]``."""
    bounds: Tensor
    """From :func:`frustum_bounds` ``[R, 5, 5]``."""


@torch.no_grad()
def frustum_bounds(viewmat: Tensor, K: Tensor, width: int, height: int, near_plane: float) -> Tensor:
    """Five linear forms of ``(x, y, z, 1, s)``, s the largest scale; no primitive with one above 0 is drawn ``[5, 5]``.

    A backend draws nothing whose distance from the picture is more than its radius, at most three standard deviations of
    the footprint, whose variance is at most its trace. A row of the perspective map's Jacobian has length
    ``f / z * sqrt(1 + k^2)`` for a slope k, which is held to what the picture shows and a margin beside it, so the trace is at
    most ``(s / z)^2 C^2`` with one C for a camera, plus the blur. Multiplied by z, this is linear. The fifth is the near plane.

    Args:
        viewmat: world-to-camera transform ``[4, 4]``.
        K: intrinsics in pixels ``[3, 3]``.
        width, height: size of the picture in pixels.
        near_plane: as the rasteriser gets it.
    """
    size = K.new_tensor([width, height])
    off_axis = K[:2, 2] - size / 2
    held = off_axis.abs() + (0.5 + 0.5 * FOV_MARGIN) * size
    reach = 3.003 * (K[:2, :2].square().sum() + held.square().sum()).sqrt()  # a bit more, for rounding
    # From the middle of the picture: half of its size, the blur, the rounding up of the radius, and a pixel for rounding.
    rows = torch.cat([K[:2], -K[:2]])
    rows[:, 2] = torch.cat([off_axis, -off_axis]) - (size / 2 + 3 * (2 * BLUR) ** 0.5 + 2).repeat(2)
    sides = torch.cat([rows @ viewmat[:3], -reach.expand(4, 1)], dim=1)
    near = torch.cat([-viewmat[2], viewmat.new_zeros(1)])
    near[3] += max(near_plane, torch.finfo(near.dtype).tiny)
    return torch.cat([sides, near[None]])


@torch.no_grad()
def gather_cameras(viewmat: Tensor, K: Tensor, width: int, height: int, near_plane: float) -> Cameras:
    """The cameras of all ranks by rank, detached. Collective. Arguments are this rank's; see :func:`frustum_bounds`."""
    own = torch.cat([camera_center(viewmat), frustum_bounds(viewmat, K, width, height, near_plane).flatten()])
    every = own.new_empty(dist.get_world_size() * len(own))
    dist.all_gather_into_tensor(every, own)
    every = every.view(-1, len(own))
    return Cameras(every[:, :3], every[:, 3:].view(-1, 5, 5))


@torch.no_grad()
def may_be_seen(means: Tensor, scales: Tensor, bounds: Tensor) -> Tensor:
    """True for every primitive that a backend gives a radius above 0, and for some others; bool ``[R, N]``.

    Args:
        means: centres ``[N, 3]``.
        scales: standard deviations, after activation ``[N, 3]``.
        bounds: of R cameras, from :func:`frustum_bounds` ``[R, 5, 5]``.
    """
    largest = scales.amax(dim=1, keepdim=True)
    rows = torch.cat([means, torch.ones_like(largest), largest], dim=1)
    above = (bounds.flatten(0, 1) @ rows.T).view(len(bounds), 5, -1)
    # Asked so that what is not a number may be seen, where backends disagree, but not in depth, where none draws it.
    return ~(above[:, :4] > 0).any(dim=1) & (above[:, 4] <= 0)


@dataclass
class Route:
    """Who sent what where in one exchange."""

    ids: Tensor
    """Rows of this rank's shard in the order in which they were sent: camera by camera ``[S]``."""
    sent: list[int]
    """How many went to each rank; the sum is S."""
    received: list[int]
    """How many came from each rank; the sum is M."""
    ask: Callable[[], Tensor] | None = None
    """Called in the backward pass: what was found about the rows that came ``[M, E]``, to travel with their gradients."""
    told: Tensor | None = None
    """What the others' ``ask`` said about the rows that went, not divided by anything ``[S, E]``."""


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
        gradient = gradient / len(route.sent)
        if route.ask is None:
            return swap(gradient, route.received, route.sent), None
        found, route.ask = route.ask(), None  # it may hold on to this very graph, which no one would ever free
        both = swap(torch.cat([gradient, found], dim=1), route.received, route.sent)
        gradient, route.told = both.split([gradient.shape[1], found.shape[1]], dim=1)
        return gradient, None


def exchange(rows: Tensor, route: Route) -> Tensor:
    """Send rows to the ranks of their cameras. Collective, and so is the backward pass.

    Gradients come back divided by the number of ranks: what all ranks' losses together do to a row is what their mean
    does to it on one process. They bring along what ``route.ask`` says, which is set on all ranks or on none.

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
