"""Who holds which primitives of a field, and how the ranks draw and densify as one.

Collectives are those of ``torch.distributed`` on the default process group. Functions that say "collective" are to be
called by all ranks, in the same order.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, MutableMapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
import torch.distributed as dist
from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import track
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

from sundae_ns.distributed.ahead import Ahead, Look, Timetable, stamped
from sundae_ns.gaussians import FEATURES
from sundae_ns.gaussians.parameters import num_primitives
from sundae_ns.gaussians.surgery import check_wiring, per_primitive, replace_parameter
from sundae_ns.rasterization.reference import largest_axis
from sundae_ns.rasterization.sharded import (
    Cameras,
    Route,
    Slack,
    exchange,
    gather_cameras,
    give_back,
    may_be_seen,
    plan_exchange,
    swap,
)
from sundae_ns.training.densification import Statistics

if TYPE_CHECKING:
    from sundae_ns.model import SundaeModel
    from sundae_ns.rendering.views import View

DRIFT = 1.1
"""Rows move when the largest shard has more than this times the mean."""
_GEOMETRY = ("means", "quats", "scales", "opacities")
_COLORS = ("features_dc", "features_rest")


def bounds(total: int, ranks: int) -> list[int]:
    """Where the blocks of ``total`` rows begin, and where the last one ends: ``ranks + 1`` numbers.

    Blocks differ by at most one row.
    """
    return [total * rank // ranks for rank in range(ranks + 1)]


def moves(counts: Sequence[int], rank: int) -> tuple[list[int], list[int]]:
    """How many rows a rank sends to and gets from each, so that all have as many, and the order stays.

    Args:
        counts: rows of each rank now.
        rank: which rank asks.
    """
    ranks, new = len(counts), bounds(sum(counts), len(counts))
    old = [sum(counts[:r]) for r in range(ranks + 1)]

    def shared(holder: int, taker: int) -> int:
        return max(0, min(old[holder + 1], new[taker + 1]) - max(old[holder], new[taker]))

    return [shared(rank, other) for other in range(ranks)], [shared(other, rank) for other in range(ranks)]


class Arrived(dict[str, Tensor]):
    """Primitives that have come to this rank for one view, by the names of the parameters, and ``colors`` ``[M, 3]``."""

    route: Route


class Course(NamedTuple):
    """One exchange: who looks, and what goes where."""

    cameras: Cameras
    route: Route


def _course_now(params: Mapping[str, Tensor], cameras: Cameras) -> Course:
    with torch.no_grad():
        seen = may_be_seen(params["means"], params["scales"], cameras.bounds)
    return Course(cameras, plan_exchange(seen).route())


class Shards:
    """This rank's place among the ranks, and how many primitives each holds.

    Args:
        device: of the field; tensors of collectives are on it.
    """

    def __init__(self, device: torch.device | str) -> None:
        self.rank, self.ranks = dist.get_rank(), dist.get_world_size()
        self.device = torch.device(device)
        self.counts = [0] * self.ranks
        """Primitives of each rank."""
        self.ahead: Ahead | None = None
        """The exchange of the next step, once this one has planned it."""
        self.timetable: Timetable
        """Which views the ranks draw in training; whoever has the views sets it before the first step."""

    @property
    def total(self) -> int:
        """Primitives of all ranks."""
        return sum(self.counts)

    def numbers(self, *own: int) -> list[list[int]]:
        """Some whole numbers of each rank, by rank. Collective."""
        mine = torch.tensor(own, device=self.device)
        every = [torch.empty_like(mine) for _ in range(self.ranks)]
        dist.all_gather(every, mine)
        return [row.tolist() for row in every]

    def recount(self, params: Mapping[str, Tensor]) -> None:
        """Let every rank know what each holds. Collective."""
        self.forget_plan()
        self.counts = [count for (count,) in self.numbers(num_primitives(params))]

    def announce(self, thing: Any) -> Any:
        """What rank 0 says, a plain value, on every rank. Collective."""
        box = [thing]
        dist.broadcast_object_list(box, src=0, device=self.device)
        return box[0]

    def gather(self, rows: Tensor, *, host: bool = False) -> Tensor | None:
        """Rows of all ranks, in order, on rank 0; None on the others. Collective.

        Args:
            rows: per-primitive values of this rank ``[N_r, ...]``.
            host: gather in host memory, so that the GPU has to hold no more than one other rank's rows.
        """
        rows = rows.detach().contiguous()
        if self.rank != 0:
            if len(rows):
                dist.send(rows, 0)
            return None
        parts = [rows.cpu() if host else rows]
        for other, count in enumerate(self.counts[1:], start=1):
            part = rows.new_empty(count, *rows.shape[1:])
            if count:
                dist.recv(part, other)
            parts.append(part.cpu() if host else part)
        return torch.cat(parts)

    @torch.no_grad()
    def level(
        self,
        params: MutableMapping[str, Parameter],
        optimizers: Mapping[str, Optimizer],
        states: Iterable[MutableMapping[str, Any]],
        mask: Tensor | None = None,
    ) -> None:
        """Move rows until all ranks hold as many, in the same order; with a mask, of those alone that stay. Collective.

        Parameters are replaced as :func:`sundae_ns.gaussians.surgery.keep` replaces them: gradients are not carried over,
        moments are, and other holders of the old ones are to be refreshed.

        Args:
            params: this rank's primitives ``[N_r, ...]``.
            optimizers: of one parameter each, by name; others are left alone.
            states: running states; their tensors of N_r rows move too.
            mask: True for primitives that stay, bool ``[N_r]``; None for all.
        """
        self.forget_plan()
        check_wiring(params, optimizers)
        n = num_primitives(params)
        kept = [count for (count,) in self.numbers(n if mask is None else int(mask.sum()))]
        sent, received = moves(kept, self.rank)

        def moved(value: Tensor) -> Tensor:
            return swap(value if mask is None else value[mask], sent, received)

        for name, old in list(params.items()):
            new = Parameter(moved(old.detach()), requires_grad=old.requires_grad)
            held = optimizers[name].state.get(old, {}) if name in optimizers else {}
            moments = {
                key: moved(value) if key != "step" and isinstance(value, Tensor) else value
                for key, value in held.items()
            }
            replace_parameter(params, optimizers, name, new, moments)
        for state in states:
            state.update({key: moved(value) for key, value in state.items() if per_primitive(value, n)})
        self.counts = [end - start for start, end in pairwise(bounds(sum(kept), self.ranks))]

    # ---------------------------------------------------------------------------------------------------- rendering

    def forget_plan(self) -> None:
        """Let the next step plan its own exchange: whoever changes the field calls this, on all ranks alike."""
        self.ahead = None

    @torch.no_grad()
    def plan_ahead(self, params: Mapping[str, Tensor], look: Look, slack: Slack | None) -> None:
        """Plan the exchange of a step to come, for whatever the field becomes within the slack; wait for nothing. Collective.

        Args:
            params: this rank's primitives as they are.
            look: at the step to come.
            slack: from :func:`sundae_ns.distributed.ahead.slack_of_step`; None, the same on all ranks, for no plan.
        """
        if slack is None:
            return
        cameras = self.timetable.cameras(look)
        plan = plan_exchange(may_be_seen(params["means"], params["scales"], cameras.bounds, slack))
        self.ahead = Ahead(look, cameras, plan, stamped(params))

    @torch.no_grad()
    def course(self, params: Mapping[str, Tensor], look: Look) -> Course:
        """The exchange of this step: the one that was planned for it, or a new one. Collective.

        All ranks do the same: plans are made and forgotten in collectives, and a look is a function of the step.
        """
        planned, self.ahead = self.ahead, None
        if planned is not None and planned.look == look:
            return Course(planned.cameras, planned.route(params))
        return _course_now(params, self.timetable.cameras(look))

    def arrivals(
        self,
        params: Mapping[str, Tensor],
        view: View,
        colors_of: Callable[[Mapping[str, Tensor], Tensor], Tensor],
        *,
        near_plane: float,
        features: bool,
        course: Course | None = None,
    ) -> Arrived:
        """The primitives of all ranks that this rank's view may see; differentiable. Collective.

        Args:
            params: this rank's primitives.
            view: this rank's camera.
            colors_of: colours ``[S, 3]`` of primitives with centres and harmonics, as seen from places ``[S, 3]``.
            near_plane: as the rasteriser gets it.
            features: whether features come along.
            course: what is to be exchanged; None for the ranks to tell each other of their views.
        """
        names = [*_GEOMETRY, FEATURES] if features else list(_GEOMETRY)
        if course is None:
            course = _course_now(params, gather_cameras(view.viewmat, view.K, view.width, view.height, near_plane))
        cameras, route = course
        # Picked for all cameras at once: the way back then fills one gradient per parameter, not one per camera.
        going = {name: params[name].index_select(0, route.ids) for name in [*names, *_COLORS]}
        centers = cameras.centers.index_select(0, route.cameras)
        rows = torch.cat([*(going[name] for name in names), colors_of(going, centers)], dim=1)
        columns = [params[name].shape[1] for name in names]
        pieces = exchange(rows, route).split([*columns, 3], dim=1)
        arrived = Arrived(zip([*names, "colors"], pieces))
        arrived.route = route
        return arrived

    def follow(self, info: MutableMapping[str, Any], route: Route, *, absgrad: bool) -> None:
        """Have what densification wants to know about primitives brought back with their gradients.

        Args:
            info: of this rank's view, whose centres keep their gradient.
            route: of the view's primitives.
            absgrad: whether gradients are summed by their absolute values.
        """

        def found() -> Tensor:
            centres, width, height = info["means2d"], info["width"], info["height"]
            gradients = (centres.absgrad if absgrad else centres.grad)[0]
            # By numbers, not by a tensor of them, which would be copied to the GPU, and waited for.
            norms = torch.hypot(gradients[:, 0] * (width / 2), gradients[:, 1] * (height / 2))
            return torch.stack([norms, (largest_axis(info["radii"][0]) / max(width, height)).to(norms)], dim=1)

        route.ask = found
        info["route"] = route

    @staticmethod
    def statistics(info: Mapping[str, Any]) -> Statistics:
        """What densification reads after a backward pass, about this rank's primitives in all views.

        Args:
            info: of this rank's view, which :meth:`follow` has followed.
        """
        route: Route = info["route"]
        assert route.told is not None
        return Statistics(route.ids, *route.told.unbind(dim=1))

    def densify(self, model: SundaeModel) -> None:
        """Densify every shard by itself, and level the shards when they have drifted apart. Collective."""
        strategy, state = model.strategy, model.strategy_state
        peak, state["peak"] = state["peak"], 0
        params = model.gaussians
        strategy.step_post_backward(
            params=model.gauss_params,
            optimizers=model.optimizers,
            state=state,
            step=model.schedule_step,
            info={"statistics": self.statistics(model.info)},
        )
        if model.schedule_step % strategy.refine_every == 0:
            self.forget_plan()  # the only steps at which primitives come and go
            numbers = self.numbers(num_primitives(params), max(state["peak"], num_primitives(params)))
            self.counts = [count for count, _ in numbers]
            peak = max(peak, sum(most for _, most in numbers))
            if max(self.counts) > DRIFT * self.total / self.ranks:
                self.level(params, model.optimizers, [state])
        state["peak"] = peak

    @torch.no_grad()
    def contribution(self, model: SundaeModel, views: Sequence[Any], share: float | None) -> Tensor:
        """Blending weights of this rank's primitives, summed over all views in their order ``[N_r]``. Collective.

        Args:
            model: the model.
            views: every training view, camera and mask; each rank draws one of every R.
            share: see :meth:`sundae_ns.model.SundaeModel.weights_of`.
        """
        sums = torch.zeros(self.counts[self.rank], device=self.device)
        rounds = range(0, len(views), self.ranks)
        for first in track(rounds, description="Contribution of primitives", transient=True, console=CONSOLE):
            # Where views run out the last is drawn again, since all ranks have to take part, and not counted.
            camera, mask = views[min(first + self.rank, len(views) - 1)]
            view = model.view_of(camera)
            arrived = model.arrivals(model.gaussians, view)
            weights = give_back(model.weights_of(view, share, arrived, mask)[:, None], arrived.route)[:, 0]
            by_view = zip(arrived.route.ids.split(arrived.route.sent), weights.split(arrived.route.sent))
            for ids, added in list(by_view)[: len(views) - first]:
                sums[ids] += added
        return sums

    @torch.no_grad()
    def apart(self, copies: Iterable[Tensor]) -> float:
        """Most that any number differs by of which all ranks should have the same; 0 without any. Collective.

        Args:
            copies: tensors of this rank, of the same shapes on all.
        """
        numbers = [copy.detach().flatten() for copy in copies]
        if not numbers:
            return 0.0
        own = torch.cat(numbers)
        ends = torch.stack([own, -own])
        dist.all_reduce(ends, dist.ReduceOp.MAX)
        return float(ends.sum(dim=0).max())

    def agree_on_focal(self, model: SundaeModel) -> None:
        """Let all ranks know the focal lengths of the pictures that any has trained the head on. Collective."""
        low, high = model.trained_focal or (math.inf, -math.inf)
        ends = torch.tensor([low, -high], device=self.device, dtype=torch.float64)
        dist.all_reduce(ends, dist.ReduceOp.MIN)
        low, high = ends.tolist()
        model.trained_focal = None if math.isinf(low) else (low, -high)
