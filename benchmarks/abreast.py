"""Fields of as many primitives, trained abreast: on the same views in the same order, by one step for all of them.

A step of one pruned field leaves most of a GPU idle, and several processes on one GPU take turns. Here the fields are the
cameras of one pass of gsplat: each is splatted, compared and stepped as it would be alone, up to the order in which kernels
add up. Other rasterisers take them one after the other. For ``rules.py``: no head, no densification, no masks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import Progress
from torch import Tensor

from sundae_ns.rasterization.gsplat_backend import project, square_lists
from sundae_ns.rasterization.gsplat_tiles import TILE
from sundae_ns.rendering.render import NEAR_PLANE, Style, colors_of, render
from sundae_ns.rendering.views import View
from sundae_ns.training.losses import picture_loss

Field = dict[str, Tensor]


@dataclass(frozen=True)
class Start:
    """A field, and what its optimizers know of it."""

    field: Field
    moments: dict[str, dict[str, Tensor]]


def start_of(trainer: Any) -> Start:
    """What a trainer would go on from. Its tensors are copied."""
    params = {name: value for name, value in trainer.pipeline.model.gauss_params.items() if value.numel()}
    states = {name: trainer.optimizers.optimizers[name].state[value] for name, value in params.items()}
    return Start(
        {name: value.detach().clone() for name, value in params.items()},
        {name: {key: kept.clone() for key, kept in state.items()} for name, state in states.items()},
    )


def _rate(group: dict[str, Any], scheduler: Any) -> Callable[[int], float]:
    """Learning rate as a function of the step."""
    now = float(group["lr"])
    if scheduler is None:
        return lambda _: now
    (first,), (decay,), begins = scheduler.base_lrs, scheduler.lr_lambdas, scheduler.last_epoch
    # A scheduler speaks after a step: the first one has the rate of before.
    return lambda step: now if step == begins else first * decay(step)


class Abreast:
    """Fields that are trained together.

    Args:
        trainer: right after the last of their prunes. It gives views, options, rates and the model; its own field is left
            alone until :meth:`show`.
        starts: of fields of equal size.

    Raises:
        SystemExit: what is trained is no bare field.
    """

    def __init__(self, trainer: Any, starts: Sequence[Start]) -> None:
        self.data, self.model = trainer.pipeline.datamanager, trainer.pipeline.model
        moved = self.model.config.camera_optimizer.mode != "off"
        if self.model.head is not None or self.model.densifying or moved:
            raise SystemExit("no head, growth or cameras can be trained abreast, only fields; leave --abreast out")
        self.fields = {
            name: torch.nn.Parameter(torch.stack([start.field[name] for start in starts])) for name in starts[0].field
        }
        self.optimizers: dict[str, torch.optim.Adam] = {}
        self.rates: dict[str, Callable[[int], float]] = {}
        for name, value in self.fields.items():
            like = trainer.optimizers.optimizers[name]
            self.rates[name] = _rate(like.param_groups[0], trainer.optimizers.schedulers.get(name))
            optimizer = torch.optim.Adam([value], **{key: like.defaults[key] for key in ("eps", "betas", "fused")})
            optimizer.state[value] = _stacked([start.moments[name] for start in starts])
            self.optimizers[name] = optimizer

    def train(self, steps: range, what: str) -> None:
        """Train all of them for some steps."""
        model = self.model
        model.train()
        with Progress(console=CONSOLE, transient=True) as progress:
            for step in progress.track(steps, description=what):
                camera, batch = self.data.next_train(step)
                if "mask" in batch:
                    raise SystemExit("captures with masks are trained one branch at a time; leave --abreast out")
                model.step = step
                background = model._get_background_color()
                target = model._target(batch, {"background": background})
                view = model.view_of(camera, model._get_downscale_factor())
                pictures = draw(self.fields, view, background, model._style)
                losses = [picture_loss(p, target, model.ssim, model.config.ssim_lambda) for p in pictures]
                torch.stack(losses).sum().backward()  # type: ignore[no-untyped-call]
                for name, optimizer in self.optimizers.items():
                    optimizer.param_groups[0]["lr"] = self.rates[name](step)
                    optimizer.step()
                    optimizer.zero_grad()

    @torch.no_grad()
    def show(self, number: int) -> None:
        """Give the model one of the fields."""
        for name, value in self.fields.items():
            self.model.gauss_params[name].copy_(value[number])


def _stacked(moments: Sequence[dict[str, Tensor]]) -> dict[str, Tensor]:
    stacked = {key: torch.stack([own[key] for own in moments]) for key in moments[0]}
    steps = stacked["step"]
    if not bool((steps == steps[0]).all()):
        raise SystemExit("fields whose optimizers have made different numbers of steps cannot be trained abreast")
    return {**stacked, "step": steps[0]}


def draw(fields: Field, view: View, background: Tensor, style: Style) -> Sequence[Tensor]:
    """Base colours ``[H, W, 3]`` of each field, from parameters with one more dimension in front ``[F, N, ...]``."""
    if style.backend.name == "gsplat":
        return _draw_at_once(fields, view, background, style)
    each = [dict(zip(fields, values)) for values in zip(*fields.values())]
    return [render(field, view, background, style, depth=False)[0]["base_rgb"] for field in each]


def _draw_at_once(fields: Field, view: View, background: Tensor, style: Style) -> Tensor:
    from gsplat import rasterize_to_pixels

    count, size = len(fields["means"]), (view.width, view.height)
    flat = {name: value.flatten(0, 1) for name, value in fields.items()}
    seen = project(
        flat["means"],
        flat["quats"],
        flat["scales"].exp(),
        flat["opacities"].sigmoid().squeeze(-1),
        view.viewmat,
        view.K,
        *size,
        near_plane=NEAR_PLANE,
        antialiased=style.antialiased,
    )
    # One camera saw all fields; from here on each field is what a camera of its own has seen.
    radii, means2d, depths, conics, opacities = (part[0].unflatten(0, (count, -1)) for part in seen)
    of_field = colors_of(flat, view.center, style).unflatten(0, (count, -1))
    lists = square_lists(means2d, radii, depths, *size)
    colors, alpha = rasterize_to_pixels(means2d, conics, of_field, opacities, *size, TILE, *lists)
    return (colors + (1 - alpha) * background).clamp(0.0, 1.0)
