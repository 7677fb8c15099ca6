"""Primitives sharded over ranks, one camera per rank: which primitives a camera may see, and their exchange.

Rank r holds N_r primitives and renders one image. Before projection, rows of primitives are sent to the ranks whose
cameras may see them, so any backend can render them. Collectives use the default process group of
``torch.distributed``; all ranks must call each function marked "Collective", in the same order.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
import torch.distributed as dist
from torch import Tensor

from sundae_ns.rasterization.reference import BLUR, FOV_MARGIN, camera_center


class Cameras(NamedTuple):
    """The cameras of all ranks, as far as other ranks need them."""

    centers: Tensor
    """Positions ``[R, 3]``."""
    bounds: Tensor
    """Bounds from :func:`frustum_bounds` ``[R, 5, 6]``."""


class Slack(NamedTuple):
    """Bounds on how far primitives move before they are rendered."""

    means: float
    """Largest change of a coordinate of a centre."""
    scales: float
    """Largest change of the logarithm of a standard deviation."""


UNMOVED = Slack(0.0, 0.0)


@torch.no_grad()
def frustum_bounds(viewmat: Tensor, K: Tensor, width: int, height: int, near_plane: float) -> Tensor:
    """Five linear forms of ``(x, y, z, 1, s)``, s the largest scale; a primitive with one above 0 is culled ``[5, 6]``.

    A backend culls a primitive whose distance from the image exceeds its radius. The radius is at most three standard
    deviations of the footprint, whose variance is at most its trace. A row of the perspective map's Jacobian has the
    length ``f / z * sqrt(1 + k^2)`` for a slope k, which is clamped to the image and a margin. So the trace is at most
    ``(s / z)^2 C^2`` with one C per camera, plus the blur. Multiplied by z, this is linear. The fifth form is the near
    plane. The sixth column is the largest change of a form if x, y and z each change by up to 1.

    Args:
        viewmat: world-to-camera transform ``[4, 4]``.
        K: intrinsics in pixels ``[3, 3]``.
        width, height: size of the image in pixels.
        near_plane: near plane of the rasteriser, world units.
    """
    size = K.new_tensor([width, height])
    off_axis = K[:2, 2] - size / 2
    limit = off_axis.abs() + (0.5 + 0.5 * FOV_MARGIN) * size
    reach = 3.003 * (K[:2, :2].square().sum() + limit.square().sum()).sqrt()  # slightly more than 3, for rounding
    # From the image centre: half the size, the blur, the rounding up of the radius, and a pixel for rounding errors.
    rows = torch.cat([K[:2], -K[:2]])
    rows[:, 2] = torch.cat([off_axis, -off_axis]) - (size / 2 + 3 * (2 * BLUR) ** 0.5 + 2).repeat(2)
    sides = torch.cat([rows @ viewmat[:3], -reach.expand(4, 1)], dim=1)
    near = torch.cat([-viewmat[2], viewmat.new_zeros(1)])
    near[3] += max(near_plane, torch.finfo(near.dtype).tiny)
    forms = torch.cat([sides, near[None]])
    return torch.cat([forms, forms[:, :3].abs().sum(dim=1, keepdim=True)], dim=1)


@torch.no_grad()
def camera_row(viewmat: Tensor, K: Tensor, width: int, height: int, near_plane: float) -> Tensor:
    """One camera of :class:`Cameras` as a row of numbers ``[33]``; see :func:`frustum_bounds`."""
    return torch.cat([camera_center(viewmat), frustum_bounds(viewmat, K, width, height, near_plane).flatten()])


def cameras_of_rows(rows: Tensor) -> Cameras:
    """Cameras from rows of :func:`camera_row` ``[R, 33]``."""
    return Cameras(rows[:, :3], rows[:, 3:].view(-1, 5, 6))


@torch.no_grad()
def gather_cameras(viewmat: Tensor, K: Tensor, width: int, height: int, near_plane: float) -> Cameras:
    """The cameras of all ranks in rank order, detached. Collective. Arguments are those of :func:`frustum_bounds`."""
    own = camera_row(viewmat, K, width, height, near_plane)
    rows = own.new_empty(dist.get_world_size() * len(own))
    dist.all_gather_into_tensor(rows, own)
    return cameras_of_rows(rows.view(-1, len(own)))


@torch.no_grad()
def may_be_seen(means: Tensor, scales: Tensor, bounds: Tensor, slack: Slack = UNMOVED) -> Tensor:
    """Conservative visibility: True for all primitives that a backend renders, and some others; bool ``[R, N]``.

    Args:
        means: centres ``[N, 3]``.
        scales: logarithms of the standard deviations ``[N, 3]``.
        bounds: bounds of R cameras, from :func:`frustum_bounds` ``[R, 5, 6]``.
        slack: how far centres and scales may still move; the result holds for any move within it.
    """
    forms = bounds.flatten(0, 1)
    # Lower the forms by what the slack allows: x, y, z by their sizes, s by a weight that is never above 0.
    offsets = torch.sub(forms[:, 3:4], forms[:, 5:6], alpha=slack.means)
    largest = scales.amax(dim=1).exp_()
    above = torch.addmm(offsets, forms[:, :3], means.T).addr_(forms[:, 4], largest, alpha=math.exp(slack.scales))
    above = above.view(len(bounds), 5, len(means))
    # NaN compares as visible in the side planes, where backends disagree, but not in depth, where none renders it.
    return (above[:, 4] <= 0) > (above[:, :4] > 0).any(dim=1)


@dataclass
class Route:
    """Destinations and sizes of one exchange."""

    ids: Tensor
    """Rows of this rank's shard in the order in which they were sent, camera by camera ``[S]``."""
    cameras: Tensor
    """Destination camera of each row ``[S]``."""
    sent: list[int]
    """Number of rows sent to each rank; the sum is S."""
    received: list[int]
    """Number of rows received from each rank; the sum is M."""
    ask: Callable[[], Tensor] | None = None
    """Called in the backward pass: values of the received rows ``[M, E]``, to be sent back with their gradients."""
    told: Tensor | None = None
    """The values that other ranks returned from ``ask`` for the rows sent, undivided ``[S, E]``."""


@dataclass
class Plan:
    """An exchange whose sizes are being copied to the host asynchronously."""

    seen: Tensor
    """Whether each row of this shard goes to each rank, bool ``[R, N]``."""
    counts: Tensor
    """Number of rows sent to and received from each rank, valid in host memory once ``ready`` has passed ``[2, R]``."""
    ready: torch.cuda.Event | None
    """None if the counts are already valid."""

    def route(self) -> Route:
        """The route; waits for the counts, but for no later work of the GPU."""
        if self.ready is not None:
            self.ready.synchronize()
        sent, received = self.counts.tolist()
        # The number of rows is known, so the search does not wait for the GPU.
        rows = torch.nonzero_static(self.seen, size=sum(sent))
        return Route(rows[:, 1], rows[:, 0], sent, received)


@torch.no_grad()
def plan_exchange(seen: Tensor) -> Plan:
    """Count the rows to send and receive, without waiting for the result. Collective.

    Args:
        seen: whether each row of this shard goes to each rank, bool ``[R, N]``.
    """
    both = torch.empty(2, len(seen), dtype=torch.long, device=seen.device)
    torch.sum(seen, dim=1, out=both[0])
    dist.all_to_all_single(both[1], both[0])
    if not seen.is_cuda:
        return Plan(seen, both, None)
    counts = both.to("cpu", non_blocking=True)  # torch copies to pinned memory
    ready = torch.cuda.Event()
    ready.record()
    return Plan(seen, counts, ready)


def swap(rows: Tensor, sent: list[int], received: list[int]) -> Tensor:
    """Send ``sent`` rows to each rank and receive ``received`` rows from each. Collective.

    ``rows`` ``[sum(sent), ...]`` are in order of the destination rank, the result ``[sum(received), ...]`` in order of
    the source rank.
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
        values, route.ask = route.ask(), None  # the callback may refer to this graph: break the cycle
        both = swap(torch.cat([gradient, values], dim=1), route.received, route.sent)
        gradient, route.told = both.split([gradient.shape[1], values.shape[1]], dim=1)
        return gradient, None


def exchange(rows: Tensor, route: Route) -> Tensor:
    """Send rows to the ranks of their cameras. Collective, and so is the backward pass.

    Gradients come back divided by the number of ranks, so that they are those of the mean of all ranks' losses. The
    values of ``route.ask`` come back with them; it must be set on all ranks or on none.

    ``rows`` ``[S, D]`` are in the order of ``route.ids``. The result ``[M, D]`` is in order of the source rank, and
    within each in the order of its shard.
    """
    return _Exchange.apply(rows, route)  # type: ignore[no-untyped-call]
