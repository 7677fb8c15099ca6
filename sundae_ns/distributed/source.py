"""A field sharded over ranks, as a source of primitives: each view gets the primitives of all ranks that it may see."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer

from sundae_ns.distributed.ahead import Ahead, Timetable, slack_of_step, stamped
from sundae_ns.distributed.shards import Shards
from sundae_ns.gaussians import FEATURES
from sundae_ns.gaussians.field import Field
from sundae_ns.rasterization.sharded import (
    Cameras,
    Route,
    exchange,
    gather_cameras,
    may_be_seen,
    plan_exchange,
    swap,
)
from sundae_ns.rasterization.types import largest_axis
from sundae_ns.rendering.source import (
    NEAR_PLANE,
    ColorSettings,
    Primitives,
    StepResolution,
    TrainingView,
    ViewBatch,
    colors_from,
)
from sundae_ns.rendering.views import View
from sundae_ns.training.densification import Statistics

_GEOMETRY = ("means", "quats", "scales", "opacities")
_COLORS = ("features_dc", "features_rest")


class ShardedField:
    """A :class:`sundae_ns.rendering.FieldSource` on several ranks. Every render is collective."""

    collective = True
    replayable = False

    def __init__(self, shards: Shards, field: Field, timetable: Timetable) -> None:
        self.shards, self.field, self.timetable = shards, field, timetable
        self._planned: Ahead | None = None

    @property
    def total(self) -> int:
        """Number of primitives of all ranks."""
        return self.shards.total

    def forget_plan(self) -> None:
        """Let the next step plan its own exchange, because the field has changed."""
        self._planned = None

    # ----------------------------------------------------------------------------------------------------- primitives

    def primitives(
        self,
        view: View,
        settings: ColorSettings,
        *,
        features: bool,
        colors: bool = True,
        at: StepResolution | None = None,
    ) -> Primitives:
        """The primitives of all ranks that the view may see; differentiable. Collective.

        Args:
            at: the training step, whose exchange was planned; None lets the ranks gather their cameras.
        """
        cameras, route = self._exchange(view, at)
        params = self.field
        names = [*_GEOMETRY, FEATURES] if features else list(_GEOMETRY)
        # For all cameras at once: the backward pass then fills one gradient for each parameter, not for each camera.
        going = {name: params[name].index_select(0, route.ids) for name in [*names, *_COLORS]}
        centers = cameras.centers.index_select(0, route.cameras)
        rows = torch.cat([*(going[name] for name in names), colors_from(going, params, centers, settings)], dim=1)
        columns = [params[name].shape[1] for name in names]
        pieces = exchange(rows, route).split([*columns, 3], dim=1)
        received = Primitives(zip([*names, "colors"], pieces))
        received.route = route
        return received

    @torch.no_grad()
    def _exchange(self, view: View, at: StepResolution | None) -> tuple[Cameras, Route]:
        """The cameras of all ranks and the route. All ranks do the same: plans are made and dropped in collectives."""
        if at is None:
            cameras = gather_cameras(view.viewmat, view.K, view.width, view.height, NEAR_PLANE)
        else:
            planned, self._planned = self._planned, None
            if planned is not None and planned.at == at:
                return planned.cameras, planned.route(self.field)
            cameras = self.timetable.cameras(at)
        seen = may_be_seen(self.field["means"], self.field["scales"], cameras.bounds)
        return cameras, plan_exchange(seen).route()

    @torch.no_grad()
    def plan_next(self, at: StepResolution, optimizers: Mapping[str, Optimizer]) -> None:
        """Plan the exchange of a later step, wherever the optimizers may move the field; wait for nothing. Collective.

        Without a bound on the optimizers' step, the same on all ranks, nothing is planned.
        """
        slack = slack_of_step(optimizers)
        if slack is None:
            return
        cameras = self.timetable.cameras(at)
        plan = plan_exchange(may_be_seen(self.field["means"], self.field["scales"], cameras.bounds, slack))
        self._planned = Ahead(at, cameras, plan, stamped(self.field))

    # --------------------------------------------------------------------------------------------------- contribution

    def batches(self, views: Sequence[TrainingView]) -> list[ViewBatch]:
        """One view for each rank at a time. The last view is repeated if views run out, and not counted."""
        rank, ranks, count = self.shards.rank, self.shards.ranks, len(views)
        firsts = range(0, count, ranks)
        return [ViewBatch(views[min(first + rank, count - 1)], min(ranks, count - first)) for first in firsts]

    @torch.no_grad()
    def accumulate(self, total: Tensor, values: Tensor, primitives: Primitives, batch: ViewBatch) -> None:
        """Return the values to the ranks that hold the primitives, and add them view by view. Collective."""
        route = primitives.route
        assert route is not None
        returned = swap(values[:, None], route.received, route.sent)[:, 0]
        by_view = zip(route.ids.split(route.sent), returned.split(route.sent))
        for ids, added in list(by_view)[: batch.num_views]:
            total[ids] += added


def send_statistics(info: Mapping[str, Any], *, absgrad: bool) -> None:
    """Let the statistics for densification travel back with the gradients of a training image.

    Args:
        info: of :func:`sundae_ns.rendering.render_view`.
        absgrad: whether gradients of the projected centres are summed absolutely.
    """

    def statistics() -> Tensor:
        centres, width, height = info["means2d"], info["width"], info["height"]
        gradients = (centres.absgrad if absgrad else centres.grad)[0]
        # With plain numbers: a tensor of them would be copied to the GPU, and waited for.
        norms = torch.hypot(gradients[:, 0] * (width / 2), gradients[:, 1] * (height / 2))
        return torch.stack([norms, (largest_axis(info["radii"][0]) / max(width, height)).to(norms)], dim=1)

    info["route"].ask = statistics


def statistics_of(info: Mapping[str, Any]) -> Statistics:
    """Statistics of this rank's primitives in the views of all ranks, sent by :func:`send_statistics`."""
    route: Route = info["route"]
    assert route.told is not None
    return Statistics(route.ids, *route.told.unbind(dim=1))
