"""A field of 90 primitives and its views, shared by two ranks."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter

from sundae_ns.distributed import ShardedField, Shards
from sundae_ns.distributed.shards import bounds
from sundae_ns.distributed.source import send_statistics
from sundae_ns.gaussians.field import Field
from sundae_ns.rasterization import rasterize, select_backend
from sundae_ns.rasterization.sharded import Cameras, camera_row, cameras_of_rows
from sundae_ns.rendering import ColorSettings, Primitives, StepResolution, View
from sundae_ns.rendering.source import colors_from

RunRanks = Callable[[str, Path], None]
Passed = Callable[[Path, str], None]
"""Fixtures of conftest.py: run the checks of a file on two ranks, and fail with the error of one."""
RANKS = 2
REFERENCE = select_backend("reference", "cpu")
COLORS = ColorSettings(REFERENCE)
NAMES = ("means", "quats", "scales", "opacities", "features_dc", "features_rest", "features")


def a_field(n: int = 90) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(3)

    def normal(*shape: int) -> Tensor:
        return torch.randn(n, *shape, generator=generator, dtype=torch.float64)

    return {
        "means": normal(3) * 0.6,
        "quats": normal(4),
        "scales": normal(3) * 0.4 - 1.8,
        "opacities": normal(1),
        "features_dc": normal(3),
        "features_rest": normal(8, 3) * 0.3,
        "features": normal(5),
    }


def a_view(rank: int) -> View:
    """Cameras that differ in all: place, size and intrinsics."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([0.4 * rank, -0.1, 2.5])
    width, height, focal = (40, 32, 35.0) if rank == 0 else (24, 48, 28.0)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
    return View(pose, K, width, height, focal)


def draw(params: Any, view: View) -> Any:
    """Splat primitives: received ones by their colours, a whole field by those that it has from the view."""
    colors = params["colors"] if "colors" in params else colors_from(params, params, view.center, COLORS)
    return rasterize(
        params["means"],
        params["quats"],
        params["scales"].exp(),
        params["opacities"].sigmoid().squeeze(-1),
        torch.cat([colors, params["features"]], dim=1),
        view.viewmat,
        view.K,
        view.width,
        view.height,
        absgrad=True,
        render_depth=True,
        backend=REFERENCE,
    )


def loss_of(splat: Any, rank: int) -> Tensor:
    weights = torch.randn(splat.colors.shape, generator=torch.Generator().manual_seed(rank), dtype=torch.float64)
    return (splat.colors * weights).mean() + splat.depth.mean() + splat.alpha.square().mean()


def shard_of(params: dict[str, Tensor], start: int, end: int) -> Field:
    return Field({name: Parameter(value[start:end].clone()) for name, value in params.items()})


def own_half(shards: Shards) -> Field:
    """The block of 45 primitives that this rank holds of a field of 90."""
    return shard_of(a_field(), *bounds(90, RANKS)[shards.rank : shards.rank + 2])


class Views:
    """A timetable in float64: two views, which the ranks take in turns, at the resolution of the step."""

    def __init__(self, rank: int) -> None:
        self.rank = rank

    def of(self, at: StepResolution, rank: int) -> View:
        view = a_view((at.step + rank) % RANKS).zoomed(1 / at.downscale)
        aside = torch.zeros(4, 4, dtype=torch.float64)
        aside[0, 3] = 1.2 * ((at.step + rank) % RANKS)  # so that each sees primitives that the other does not
        return view._replace(viewmat=view.viewmat + aside)

    def view(self, at: StepResolution) -> View:
        return self.of(at, self.rank)

    def cameras(self, at: StepResolution) -> Cameras:
        views = [self.of(at, rank) for rank in range(RANKS)]
        return cameras_of_rows(torch.stack([camera_row(v.viewmat, v.K, v.width, v.height, 0.01) for v in views]))


def source_of(shards: Shards, field: Field) -> ShardedField:
    """A sharded field whose plans are dropped when it changes, as :meth:`sundae_ns.distributed.Team.share` makes it."""
    views: Any = Views(shards.rank)
    source = ShardedField(shards, field, views)
    shards.changed = source.forget_plan
    return source


def render(source: ShardedField, view: View, *, at: StepResolution | None = None) -> tuple[Primitives, Any]:
    """The primitives that a view receives, and their image, with densification's statistics after the backward pass."""
    received = source.primitives(view, COLORS, features=True, at=at)
    splat = draw(received, view)
    splat.info["means2d"].retain_grad()
    splat.info["route"] = received.route
    send_statistics(splat.info, absgrad=True)
    return received, splat


def still(params: Field) -> dict[str, torch.optim.Optimizer]:
    """Optimizers that move nothing."""
    return {name: torch.optim.Adam([value], lr=0.0) for name, value in params.items()}


def adams(params: Field, start: int) -> dict[str, torch.optim.Optimizer]:
    """Optimizers whose moments say to which row they belong."""
    made: dict[str, torch.optim.Optimizer] = {}
    for name, value in params.items():
        optimizer = torch.optim.Adam([value], lr=0.1)
        rows = torch.arange(start, start + len(value), dtype=value.dtype).reshape(-1, *[1] * (value.ndim - 1))
        moments = {"exp_avg": rows.expand_as(value).clone(), "exp_avg_sq": (rows + 0.5).expand_as(value).clone()}
        optimizer.state[value] = {"step": torch.tensor(7.0), **moments}
        made[name] = optimizer
    return made
