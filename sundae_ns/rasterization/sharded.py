"""Primitives sharded over ranks, a camera on each: which primitives a camera may see, and how they get there and back.

Rank r holds N_r primitives and draws one picture. Rows of primitives travel to the ranks whose cameras may see them, before
projection, so that every backend draws them as it draws any others. Collectives are those of ``torch.distributed``, on the
default process group; each function that says "collective" is to be called by all ranks, in the same order.
"""

from __future__ import annotations

import math
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
    """From :func:`frustum_bounds` ``[R, 5, 6]``."""


class Slack(NamedTuple):
    """How far primitives may move before they are drawn."""

    means: float
    """Most that a coordinate of a centre changes by."""
    scales: float
    """Most that the logarithm of a standard deviation changes by."""


UNMOVED = Slack(0.0, 0.0)


@torch.no_grad()
def frustum_bounds(viewmat: Tensor, K: Tensor, width: int, height: int, near_plane: float) -> Tensor:
    """Five linear forms of ``(x, y, z, 1, s)``, s the largest scale; no primitive with one above 0 is drawn ``[5, 6]``.

    A backend draws nothing whose distance from the picture is more than its radius, at most three standard deviations of
    the footprint, whose variance is at most its trace. A row of the perspective map's Jacobian has length
    ``f / z * sqrt(1 + k^2)`` for a slope k, which is held to what the picture shows and a margin beside it, so the trace is at
    most ``(s / z)^2 C^2`` with one C for a camera, plus the blur. Multiplied by z, this is linear. The fifth is the near plane.
    The sixth column is what a form changes by at most where each of x, y, z changes by up to 1.

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
    forms = torch.cat([sides, near[None]])
    return torch.cat([forms, forms[:, :3].abs().sum(dim=1, keepdim=True)], dim=1)


@torch.no_grad()
def camera_row(viewmat: Tensor, K: Tensor, width: int, height: int, near_plane: float) -> Tensor:
    """One camera of :class:`Cameras` as numbers that can be sent and kept ``[33]``; see :func:`frustum_bounds`."""
    return torch.cat([camera_center(viewmat), frustum_bounds(viewmat, K, width, height, near_plane).flatten()])


def cameras_of(rows: Tensor) -> Cameras:
    """Cameras from rows of :func:`camera_row` ``[R, 33]``."""
    return Cameras(rows[:, :3], rows[:, 3:].view(-1, 5, 6))


@torch.no_grad()
def gather_cameras(viewmat: Tensor, K: Tensor, width: int, height: int, near_plane: float) -> Cameras:
    """The cameras of all ranks by rank, detached. Collective. Arguments are this rank's; see :func:`frustum_bounds`."""
    own = camera_row(viewmat, K, width, height, near_plane)
    every = own.new_empty(dist.get_world_size() * len(own))
    dist.all_gather_into_tensor(every, own)
    return cameras_of(every.view(-1, len(own)))


@torch.no_grad()
def may_be_seen(means: Tensor, scales: Tensor, bounds: Tensor, slack: Slack = UNMOVED) -> Tensor:
    """True for every primitive that a backend gives a radius above 0, and for some others; bool ``[R, N]``.

    Args:
        means: centres ``[N, 3]``.
        scales: logarithms of the standard deviations ``[N, 3]``.
        bounds: of R cameras, from :func:`frustum_bounds` ``[R, 5, 6]``.
        slack: how far both may still move; whatever they do within it, what is then drawn has been found.
    """
    forms = bounds.flatten(0, 1)
    # Lowered by what the slack can lower them by: x, y, z take part with their sizes, s with a weight that is never above 0.
    offsets = torch.sub(forms[:, 3:4], forms[:, 5:6], alpha=slack.means)
    largest = scales.amax(dim=1).exp_()
    above = torch.addmm(offsets, forms[:, :3], means.T).addr_(forms[:, 4], largest, alpha=math.exp(slack.scales))
    above = above.view(len(bounds), 5, len(means))
    # Asked so that what is not a number may be seen, where backends disagree, but not in depth, where none draws it.
    return (above[:, 4] <= 0) > (above[:, :4] > 0).any(dim=1)


@dataclass
class Route:
    """Who sent what where in one exchange."""

    ids: Tensor
    """Rows of this rank's shard in the order in which they were sent: camera by camera ``[S]``."""
    cameras: Tensor
    """Which camera each of them went to ``[S]``."""
    sent: list[int]
    """How many went to each rank; the sum is S."""
    received: list[int]
    """How many came from each rank; the sum is M."""
    ask: Callable[[], Tensor] | None = None
    """Called in the backward pass: what was found about the rows that came ``[M, E]``, to travel with their gradients."""
    told: Tensor | None = None
    """What the others' ``ask`` said about the rows that went, not divided by anything ``[S, E]``."""


@dataclass
class Plan:
    """An exchange whose sizes are on their way to the host, which goes on in the meantime."""

    seen: Tensor
    """Whether a row of this shard goes to a rank, bool ``[R, N]``."""
    counts: Tensor
    """Rows that go to each rank and that come from each, in host memory once they are ``ready`` ``[2, R]``."""
    ready: torch.cuda.Event | None
    """None where there is nothing to wait for."""

    def route(self) -> Route:
        """The route; this waits for the counts, and for nothing that the GPU was given after them."""
        if self.ready is not None:
            self.ready.synchronize()
        sent, received = self.counts.tolist()
        # Their number is known, so that looking for them does not wait for the GPU.
        found = torch.nonzero_static(self.seen, size=sum(sent))
        return Route(found[:, 1], found[:, 0], sent, received)


@torch.no_grad()
def plan_exchange(seen: Tensor) -> Plan:
    """Count the rows that go to each rank, and hear how many come, without waiting for either. Collective.

    Args:
        seen: whether a row of this shard goes to a rank, bool ``[R, N]``.
    """
    both = torch.empty(2, len(seen), dtype=torch.long, device=seen.device)
    torch.sum(seen, dim=1, out=both[0])
    dist.all_to_all_single(both[1], both[0])
    if not seen.is_cuda:
        return Plan(seen, both, None)
    counts = both.to("cpu", non_blocking=True)  # into pinned memory, which torch takes for such copies
    ready = torch.cuda.Event()
    ready.record()
    return Plan(seen, counts, ready)


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
        route: of a :class:`Plan`.

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
