"""The next step's exchange of primitives, planned during this one, so that no step begins with a wait for the GPU.

Which picture each rank draws at a step is a function of the step, and Adam moves a parameter by no more than its rate
allows. So during a step all ranks know where the cameras of the next one stand, and which primitives these may see, whatever
the backward pass will say.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import torch
import torch.distributed as dist
from torch import Tensor
from torch.optim import Adam, Optimizer

from sundae_ns.compensation import training_window
from sundae_ns.rasterization.sharded import Cameras, Plan, Route, Slack, camera_row, cameras_of
from sundae_ns.rendering.views import View, view_of

if TYPE_CHECKING:
    from nerfstudio.cameras.cameras import Cameras as Capture

ROUNDING = 1.02
"""Factor of what Adam may do: for rounding, and for moments that another number of ranks has gathered with other betas."""


class Look(NamedTuple):
    """How the ranks look at the scene at one step: a function of the step and the options, so the same on all ranks."""

    step: int
    """Of this run: batches of a picture for each rank."""
    downscale: int
    """What the sides of pictures are divided by."""
    window_pixels: int
    """Most pixels of a picture, of which larger ones show a window; 0 for no limit."""


class Timetable:
    """Which view each rank draws at each step of training, and what the others need to know about it.

    Args:
        cameras: of the training views.
        order: index of the view of the k-th picture; the same on all ranks.
        device: of the field.
        near_plane: as the rasteriser gets it.
    """

    def __init__(
        self, cameras: Capture, order: Callable[[int], int], device: torch.device | str, near_plane: float
    ) -> None:
        self.rank, self.ranks = dist.get_rank(), dist.get_world_size()
        self._cameras, self._order, self._device, self._near_plane = cameras, order, device, near_plane
        self._table: _Table | None = None

    def pictures(self, step: int) -> list[int]:
        """Indices of the views of a step, by rank."""
        return [self._order(step * self.ranks + rank) for rank in range(self.ranks)]

    def view(self, look: Look, camera: Capture) -> View:
        """What this rank draws, the whole picture, from a table of all: to make it anew would wait for the GPU.

        Args:
            look: at this step.
            camera: what the datamanager serves at this step.
        """
        picture = self.pictures(look.step)[self.rank]
        assert (camera.metadata or {}).get("cam_idx") == picture, "ranks train on the views of the timetable alone"
        return self._at(look.downscale).views[picture]

    def cameras(self, look: Look) -> Cameras:
        """The cameras of all ranks, by rank; one launch, and no collective."""
        table = self._at(look.downscale)
        return cameras_of(torch.stack([self._row(table, picture, look) for picture in self.pictures(look.step)]))

    def _row(self, table: _Table, picture: int, look: Look) -> Tensor:
        view = table.on_host[picture]
        window = training_window(view.width, view.height, look.window_pixels, seed=look.step)
        if window is None:
            return table.rows[picture]
        return self._row_of(view.cut(window)).to(self._device, non_blocking=True)

    def _row_of(self, view: View) -> Tensor:
        return camera_row(view.viewmat, view.K, view.width, view.height, self._near_plane)

    def _at(self, downscale: int) -> _Table:
        # Not before the first look: the datamanager corrects cameras in place where it straightens pictures.
        if self._table is None or self._table.downscale != downscale:
            cameras = (self._cameras[i : i + 1] for i in range(len(self._cameras)))
            views = [view_of(camera, "cpu", downscale=downscale) for camera in cameras]
            # On the host: on a GPU each of these small sums would cost a launch.
            rows = torch.stack([self._row_of(view) for view in views])
            self._table = _Table(downscale, views, rows.to(self._device))
        return self._table


@dataclass(frozen=True)
class _Table:
    """All training views at one size."""

    downscale: int
    on_host: list[View]
    rows: Tensor
    """From ``camera_row``, on the device ``[V, 33]``."""

    @cached_property
    def views(self) -> list[View]:
        """The views on the device."""
        poses = torch.stack([view.viewmat for view in self.on_host]).to(self.rows.device)
        Ks = torch.stack([view.K for view in self.on_host]).to(self.rows.device)
        return [view._replace(viewmat=pose, K=K) for view, pose, K in zip(self.on_host, poses, Ks)]


@dataclass(frozen=True)
class Ahead:
    """An exchange that has been planned for a step to come, and the field that it was planned for. It holds no graph."""

    look: Look
    cameras: Cameras
    plan: Plan
    field: tuple[tuple[Tensor, int, int], ...]
    """What the plan goes by, each with the place of its data and its version."""

    def route(self, params: Mapping[str, Tensor]) -> Route:
        """The route of the planned exchange; see :meth:`Plan.route`.

        A field that has changed by anything but one step of its optimizers is an error of ours, not a reason to plan again:
        one rank alone may see it, and the others would not plan again with it. Who changes a field says so on all ranks
        (:meth:`sundae_ns.distributed.Shards.forget_plan`).
        """
        for (held, place, version), now in zip(self.field, _plans_by(params)):
            # A step of Adam changes a version by one, or, fused, not at all.
            same = held is now and place == now.data_ptr() and now._version - version <= 1
            assert same, "the field has changed since the exchange was planned"
        return self.plan.route()


def _plans_by(params: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
    return params["means"], params["scales"]


def stamped(params: Mapping[str, Tensor]) -> tuple[tuple[Tensor, int, int], ...]:
    """What a plan goes by, in the form of :attr:`Ahead.field`."""
    return tuple((value, value.data_ptr(), value._version) for value in _plans_by(params))


def slack_of_step(optimizers: Mapping[str, Optimizer]) -> Slack | None:
    """How far the next step of the optimizers moves primitives at most; None where that is not known.

    Args:
        optimizers: by name of the parameter, at the rates of that step.
    """
    means, scales = (longest_step(optimizers[name]) for name in ("means", "scales"))
    return Slack(means, scales) if math.isfinite(means + scales) else None


def longest_step(optimizer: Optimizer) -> float:
    """Most that one step may change any number of the parameter; infinite where that is not known.

    Adam divides ``m = sum w_i g_i`` by the root of ``v = sum u_i g_i^2``. The weights go with ``b1^(t-i)`` and with
    ``b2^(t-i)``, and add up to 1 each. By Cauchy and Schwarz the quotient is at most the root of ``sum w_i^2 / u_i``, which
    with ``q = b1^2 / b2`` is that of ``(1-b1)^2 / ((1-b2) (1-q))`` times ``(1-b2^t) (1-q^t) / (1-b1^t)^2``; the latter is at
    most 1, since ``b2^t + q^t >= 2 b1^t``. Gradients that grow by ``b2 / b1`` with each step come arbitrarily near: for the
    usual betas 7.3 times the rate. The bounds in section 2.1 of Kingma & Ba (2015), lower ones, are of sparse gradients and
    of steady ones.
    """
    (group,) = optimizer.param_groups
    if type(optimizer) is not Adam or group.get("decoupled_weight_decay"):
        return math.inf
    beta1, beta2 = group["betas"]
    if beta1**2 >= beta2 or beta2 >= 1:
        return math.inf
    return ROUNDING * float(group["lr"]) * (1 - beta1) / math.sqrt((1 - beta2) * (1 - beta1**2 / beta2))
