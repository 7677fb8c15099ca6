"""Refit of a pruned field: a few steps towards the full field's own images, without photographs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from sundae_ns.api.virtual import by_device
from sundae_ns.gaussians.field import Field
from sundae_ns.rasterization import rasterize_views
from sundae_ns.rendering import LocalField, View
from sundae_ns.rendering.render import RenderSettings, pass_options

if TYPE_CHECKING:
    from rich.console import Console

STEPS, VIEWS = {"cpu": 64, "cuda": 128}, 4
"""Steps by the device, and the views of each."""
MOST_PIXELS = 512 * 512
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
    device = small["means"].device
    count = by_device(STEPS, device)
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

    def error(field: Field, chosen: Sequence[int]) -> Tensor:
        """Sum of the mean squared errors of some views."""
        new = [i for i in dict.fromkeys(chosen) if i not in images]
        with torch.no_grad():
            images.update(zip(new, _images(full, [views[i] for i in new], settings), strict=True))
        shown = zip(_images(field, [views[i] for i in chosen], settings), chosen, strict=True)
        return torch.stack([(image - images[i]).square().mean() for image, i in shown]).sum()

    steps = range(count)
    if console is not None:
        from rich.progress import track

        steps = track(steps, "Refit of primitives", transient=True, console=console)  # type: ignore[assignment]
    for step in steps:
        chosen = [shown[i % len(shown)] for i in range(step * VIEWS, (step + 1) * VIEWS)]
        for some in [chosen] if device.type == "cuda" else [[i] for i in chosen]:  # a GPU takes small images together
            with torch.enable_grad():
                error(fitted(), some).backward()
        for group in optimizer.param_groups:
            group["lr"] = group["first"] * (1 - step / count)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
    found = fitted()
    before, after = (error(field, judges) for field in (small, found))
    return found if bool(after < before) else small  # so is a field that is not finite


def _images(field: Field, views: Sequence[View], settings: RenderSettings) -> list[Tensor]:
    """Blended colours and accumulation of each view, without background ``[H, W, 4]``."""
    if len({(view.width, view.height) for view in views}) > 1:
        return [image for view in views for image in _images(field, [view], settings)]
    if not views:
        return []
    primitives = [LocalField(field).primitives(view, settings, features=False) for view in views]
    colors = torch.stack([each["colors"] for each in primitives])
    options = pass_options(primitives[0], views[0], settings)
    options |= {
        "viewmats": torch.stack([view.viewmat for view in views]),
        "Ks": torch.stack([view.K for view in views]),
    }
    del options["viewmat"], options["K"]
    # What blends to the accumulation is 1 everywhere.
    return list(rasterize_views(colors=torch.cat([colors, torch.ones_like(colors[..., :1])], dim=2), **options))
