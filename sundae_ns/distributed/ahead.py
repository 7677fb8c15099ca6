"""The exchange of the next step, planned during this step, so that no step begins with a wait for the GPU.

The view of each rank is a function of the step, and Adam moves a parameter by a bounded multiple of its rate. So all
ranks know the next cameras, and which primitives these may see, before the backward pass has finished.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
import torch.distributed as dist
from torch import Tensor
from torch.optim import Adam, Optimizer

from sundae_ns.compensation import training_window
from sundae_ns.rasterization.sharded import Cameras, Plan, Route, Slack, camera_row, cameras_of_rows
from sundae_ns.rendering.source import NEAR_PLANE, StepResolution
from sundae_ns.rendering.views import View, view_of

if TYPE_CHECKING:
    from nerfstudio.cameras.cameras import Cameras as Capture

STEP_ROUNDING = 1.02
"""Factor on the bound of Adam's step: for rounding, and for moments from another number of ranks with other betas."""


class Timetable:
    """The views of all ranks at each training step.

    Args:
        cameras: the training cameras.
        order: index of the view of the k-th image; the same on all ranks.
        device: of the cameras in a step.
    """

    def __init__(self, cameras: Capture, order: Callable[[int], int], device: torch.device | str) -> None:
        self.ranks = dist.get_world_size()
        self._cameras, self._order, self._device = cameras, order, device
        self._downscale: int | None = None
        self._views: list[View] = []
        self._rows = torch.empty(0)

    def views(self, step: int) -> list[int]:
        """Indices of the views of a step, by rank."""
        return [self._order(step * self.ranks + rank) for rank in range(self.ranks)]

    def cameras(self, at: StepResolution) -> Cameras:
        """The cameras of all ranks at a step, by rank; one launch, no collective."""
        # Not before the first step: the datamanager corrects cameras in place when it undistorts images.
        if self._downscale != at.downscale:
            cameras = (self._cameras[i : i + 1] for i in range(len(self._cameras)))
            # On the host: on a GPU each of these small operations would cost a launch.
            self._views = [view_of(camera, "cpu", downscale=at.downscale) for camera in cameras]
            self._rows = torch.stack([_row_of(view) for view in self._views]).to(self._device)
            self._downscale = at.downscale
        return cameras_of_rows(torch.stack([self._row(index, at) for index in self.views(at.step)]))

    def _row(self, index: int, at: StepResolution) -> Tensor:
        view = self._views[index]
        window = training_window(view.width, view.height, at.window_pixels, seed=at.step, mirror=at.mirror)
        if window is None:
            return self._rows[index]
        return _row_of(view.cut(window)).to(self._device, non_blocking=True)


def _row_of(view: View) -> Tensor:
    return camera_row(view.viewmat, view.K, view.width, view.height, NEAR_PLANE)


@dataclass(frozen=True)
class Ahead:
    """An exchange planned for a later step, and the field that it was planned for. It holds no autograd graph."""

    at: StepResolution
    cameras: Cameras
    plan: Plan
    field: tuple[tuple[Tensor, int, int], ...]
    """Tensors that the plan depends on, each with the address of its data and its version."""

    def route(self, params: Mapping[str, Tensor]) -> Route:
        """The route of the planned exchange; see :meth:`Plan.route`.

        Asserts that the field changed by one step of its optimizers only. Planning again is no way out, because one
        rank alone may see the change. Code that changes a field calls :meth:`sundae_ns.distributed.Shards.changed` on
        all ranks.
        """
        for (held, place, version), (now, now_at, now_version) in zip(self.field, stamped(params), strict=True):
            # A step of Adam raises a version by one; fused Adam does not raise it.
            same = held is now and place == now_at and now_version - version <= 1
            assert same, "the field has changed since the exchange was planned"
        return self.plan.route()


def stamped(params: Mapping[str, Tensor]) -> tuple[tuple[Tensor, int, int], ...]:
    """The tensors that a plan depends on, in the form of :attr:`Ahead.field`."""
    return tuple((value, value.data_ptr(), value._version) for value in (params["means"], params["scales"]))


def slack_of_step(optimizers: Mapping[str, Optimizer]) -> Slack | None:
    """Bound on how far the next step of the optimizers moves primitives; None if there is no bound.

    Args:
        optimizers: by parameter name, at the rates of that step.
    """
    means, scales = (longest_step(optimizers[name]) for name in ("means", "scales"))
    return Slack(means, scales) if math.isfinite(means + scales) else None


def longest_step(optimizer: Optimizer) -> float:
    """Bound on the change of any number of the parameter in one step; infinite if there is none.

    Adam divides ``m = sum w_i g_i`` by the root of ``v = sum u_i g_i^2``. The weights are proportional to ``b1^(t-i)``
    and ``b2^(t-i)``, and sum to 1 each. By Cauchy and Schwarz the quotient is at most the root of ``sum w_i^2 / u_i``.
    With ``q = b1^2 / b2`` this is the root of ``(1-b1)^2 / ((1-b2) (1-q))`` times ``(1-b2^t) (1-q^t) / (1-b1^t)^2``,
    and the latter is at most 1, since ``b2^t + q^t >= 2 b1^t``. Gradients that grow by ``b2 / b1`` at each step come
    arbitrarily near: 7.3 times the rate for the usual betas. The lower bounds in section 2.1 of Kingma & Ba (2015) hold
    for sparse and for steady gradients.
    """
    (group,) = optimizer.param_groups
    if type(optimizer) is not Adam or group.get("decoupled_weight_decay"):
        return math.inf
    beta1, beta2 = group["betas"]
    if beta1**2 >= beta2 or beta2 >= 1:
        return math.inf
    return STEP_ROUNDING * float(group["lr"]) * (1 - beta1) / math.sqrt((1 - beta2) * (1 - beta1**2 / beta2))
