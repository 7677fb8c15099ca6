"""Refit of a pruned field: a few steps towards the full field's own images, without photographs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from sundae_ns.gaussians.field import Field
from sundae_ns.rendering import LocalField, View
from sundae_ns.rendering.render import RenderSettings, splat

if TYPE_CHECKING:
    from rich.console import Console

STEPS, VIEWS = 64, 4
"""Steps, and the views of each."""
MOST_PIXELS = 256 * 256
"""Most pixels of a view; larger ones are rendered smaller."""
JUDGES = 8
"""Views that no step uses, if there are twice as many. The refit stays only if their error shrinks."""
_RATES = {"means": 0.014, "scales": 0.007, "quats": 0.007, "opacities": 0.035, "features_dc": 0.014}
"""Size of the first steps; centres move in sizes of their primitive. The rates fall to zero."""
FULL_RATES = 0.15
"""Largest share of the primitives at which the rates are those above; with more of them less is left to fit."""


@torch.no_grad()
def refit(
    small: Field,
    full: Field,
    views: Sequence[View],
    settings: RenderSettings,
    *,
    seed: int = 0,
    console: Console | None = None,
) -> Field:
    """Fit centres, shapes, opacities and base colours of a field to the images of a fuller one.

    A merge keeps moments, not images: groups overlap, and hide what was behind them. Adam's steps (Kingma and Ba, 2015)
    lower the squared error of the blended colours and of the accumulation, over a few views each, as in training.

    Args:
        small: the field to fit, finite; it does not change.
        full: the field whose images are to be matched, on the same device.
        views: cameras, on the device of the fields; of many, :data:`STEPS` times :data:`VIEWS` take part.
        settings: how images are made.
        seed: of the order of the views.
        console: shows a progress bar; None for none.

    Returns:
        A field of as many primitives. It is ``small`` if the refit matches no better.
    """
    views = [view.zoomed(min(1.0, math.sqrt(MOST_PIXELS / (view.width * view.height)))) for view in views]
    order = torch.randperm(len(views), generator=torch.Generator().manual_seed(seed)).tolist()
    images: dict[int, Tensor] = {}
    judges = order[:JUDGES] if len(order) >= 2 * JUDGES else order
    shown = order[JUDGES:] if len(order) >= 2 * JUDGES else order
    size = small["scales"].exp().sort(dim=1).values[:, 1:].mean(dim=1, keepdim=True)
    moved = {name: torch.zeros_like(small[name], requires_grad=True) for name in _RATES}
    gentle = min(1.0, FULL_RATES * full.num_primitives / small.num_primitives)
    groups = [{"params": [moved[n]], "lr": gentle * rate, "first": gentle * rate} for n, rate in _RATES.items()]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15)

    def fitted() -> Field:
        return small.replaced({n: small[n] + (size * step if n == "means" else step) for n, step in moved.items()})

    def error(field: Field, i: int) -> Tensor:
        if i not in images:
            with torch.no_grad():
                images[i] = _images(full, views[i], settings)
        return (_images(field, views[i], settings) - images[i]).square().mean()

    steps = range(STEPS)
    if console is not None:
        from rich.progress import track

        steps = track(steps, "Refit of primitives", transient=True, console=console)  # type: ignore[assignment]
    for step in steps:
        for i in range(step * VIEWS, (step + 1) * VIEWS):
            with torch.enable_grad():
                error(fitted(), shown[i % len(shown)]).backward()
        for group in optimizer.param_groups:
            group["lr"] = group["first"] * (1 - step / STEPS)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
    found = fitted()
    before, after = (torch.stack([error(field, i) for i in judges]).sum() for field in (small, found))
    return found if bool(after < before) else small  # so is a field that is not finite


def _images(field: Field, view: View, settings: RenderSettings) -> Tensor:
    """Blended colours and accumulation, without background ``[H, W, 4]``."""
    primitives = LocalField(field).primitives(view, settings, features=False)
    splatted = splat(primitives, view, primitives["colors"], settings)
    return torch.cat([splatted.colors, splatted.alpha], dim=2)
