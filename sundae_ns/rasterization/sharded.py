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


class Camera(NamedTuple):
    """A pinhole camera as every rank knows it; sizes are tensors, so that none has to be read from a GPU."""

    viewmat: Tensor
    """World-to-camera ``[4, 4]``."""
    K: Tensor
    """Intrinsics in pixels ``[3, 3]``."""
    size: Tensor
    """Width and height in pixels ``[2]``."""


@torch.no_grad()
def gather_cameras(viewmat: Tensor, K: Tensor, width: int, height: int) -> list[Camera]:
    """The cameras of all ranks by rank, detached. Collective.

    Args:
        viewmat: this rank's world-to-camera transform ``[4, 4]``.
        K: its intrinsics in pixels ``[3, 3]``.
        width, height: size of its picture in pixels.
    """
    own = torch.cat([viewmat.reshape(16), K.reshape(9), viewmat.new_tensor([width, height])])
    every = [torch.empty_like(own) for _ in range(dist.get_world_size())]
    dist.all_gather(every, own)
    return [Camera(row[:16].reshape(4, 4), row[16:25].reshape(3, 3), row[25:]) for row in every]


@torch.no_grad()
def may_be_seen(means: Tensor, scales: Tensor, camera: Camera, near_plane: float, far_plane: float) -> Tensor:
    """True for every primitive that a backend gives a radius above 0, and for some others; bool ``[N]``.

    The radius is at most three standard deviations of the footprint, whose variance is at most its trace. A row of the
    perspective map's Jacobian has length ``f / z * sqrt(1 + k^2)`` for a slope k, so the trace is at most
    ``(s / z)^2 (fx^2 (1 + kx^2) + fy^2 (1 + ky^2))`` for the largest scale s, plus the blur.

    Args:
        means: centres ``[N, 3]``.
        scales: standard deviations, after activation ``[N, 3]``.
        camera: the camera.
        near_plane, far_plane: as the rasteriser gets them.
    """
    in_camera = means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    z = in_camera[:, 2:]
    in_range = (z >= near_plane) & (z <= far_plane) & (z > 0)
    focal, centre = camera.K.diagonal()[:2], camera.K[:2, 2]
    slopes = in_camera[:, :2] / z
    margin = 0.5 * FOV_MARGIN * camera.size / focal
    held = slopes.maximum(-centre / focal - margin).minimum((camera.size - centre) / focal + margin)
    spread = focal.square() * (1 + held.square())
    variance = (scales.amax(dim=1, keepdim=True) / z).square() * spread.sum(dim=1, keepdim=True) + 2 * BLUR
    reach = 3 * variance.sqrt() * 1.001 + 1  # rounding up, and rounding
    pixels = slopes * focal + centre
    outside = (pixels + reach <= 0) | (pixels - reach >= camera.size)
    # Said the other way round, NaN would count as unseen here, and the backends would disagree.
    return in_range[:, 0] & ~outside.any(dim=1)


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
def plan_route(ids: list[Tensor]) -> Route:
    """Say how many rows go to each rank, and hear how many come. Collective.

    Args:
        ids: for each rank, the rows of this shard that go there, int64.
    """
    sent = [len(rows) for rows in ids]
    counts = torch.tensor(sent, device=ids[0].device)
    incoming = torch.empty_like(counts)
    dist.all_to_all_single(incoming, counts)
    return Route(torch.cat(ids), sent, incoming.tolist())


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
