"""Virtual cameras: views of a scene that comes without any, from the field alone."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from sundae_ns.api.scene import Scene
from sundae_ns.errors import ConfigError, DataError
from sundae_ns.gaussians import finite_mask
from sundae_ns.gaussians.field import Field
from sundae_ns.rasterization import rasterize
from sundae_ns.rendering import View
from sundae_ns.rendering.render import pass_options

NEAREST, FARTHEST = 0.3, 2.0
"""Distances of the eyes from the middle of the scene, as multiples of the median distance of its primitives."""
FOV = 60.0
VIRTUAL_SIZE = 128
"""Default width and height of the images, pixels."""
CANDIDATES = 3
"""Cameras that are drawn for each one that is kept."""
_PROBE_SIZE = 32
"""Sides of the images that candidates are judged by, pixels."""
_PROBE_PRIMITIVES = 20_000
"""Most primitives of these images."""
_OPAQUE, _SHOWN, _NEAR = 0.1, 0.3, 0.1
"""Accumulation from which a pixel shows something, least share of such pixels, and the share that may be near."""


def virtual_views(scene: Scene, n: int = 128, *, seed: int = 0, size: int = VIRTUAL_SIZE) -> list[View]:
    """Cameras that see a scene as a visitor would, for scenes without cameras.

    Eyes are drawn in all directions from the middle of the scene, at 0.3 to 2 times the median distance of its
    primitives, and look at random primitives. Of three eyes at one distance that one is kept with most room ahead,
    by the depth of a small image: inside of matter and among floaters something is always near.

    Args:
        scene: its finite primitives count.
        n: number of cameras.
        seed: of the random draws, which are the same on every device up to rounding.
        size: width and height of the images, pixels.

    Raises:
        ConfigError: ``n`` or ``size`` is less than 1.
        DataError: no primitive is finite.

    >>> import torch, sundae_ns as sn
    >>> scene = sn.Scene.from_points(torch.rand(100, 3), torch.rand(100, 3))
    >>> len(sn.virtual_views(scene, 8))
    8
    """
    if n < 1 or size < 1:
        raise ConfigError(f"{n} views of {size} x {size} pixels see nothing; give at least 1 of both")
    field = _usable(scene)
    means = field["means"].cpu().double()
    middle, reach = _middle_and_reach(field)
    generator = torch.Generator().manual_seed(seed)
    drawn = CANDIDATES * n
    direction = torch.nn.functional.normalize(torch.randn(drawn, 3, generator=generator, dtype=torch.float64), dim=1)
    # Of one distance, because farther eyes have more room, whatever they see.
    distance = NEAREST + (FARTHEST - NEAREST) * torch.rand(n, 1, generator=generator, dtype=torch.float64)
    eyes = direction * distance.repeat(CANDIDATES, 1)
    targets = (means[torch.randint(len(means), (drawn,), generator=generator)] - middle) / reach
    cameras = [
        View.look_at(eye, target, fov=FOV, width=_PROBE_SIZE, height=_PROBE_SIZE)
        for eye, target in zip(eyes, targets, strict=True)
    ]
    room = _room_ahead(dataclasses.replace(scene, field=_probe(field, middle, reach, generator)), cameras)
    best = room.view(CANDIDATES, n).argmax(dim=0) * n + torch.arange(n)
    return [
        View.look_at(middle + reach * eyes[i], middle + reach * targets[i], fov=FOV, width=size, height=size)
        for i in best.tolist()
    ]


def of_unit_size(scene: Scene, views: Sequence[View]) -> tuple[Scene, list[View]]:
    """A scene of another program scaled to a size of 1, and its views along with it; see :func:`size_of`.

    The near plane is at a fixed distance, and would hide a scene of millimetres.
    """
    views, size = list(views), size_of(scene)
    if size == 1:
        return scene, views
    scaled = []
    for view in views:
        viewmat = view.viewmat.clone()
        viewmat[:3, 3] /= size
        scaled.append(view._replace(viewmat=viewmat))
    return resized(scene, 1 / size), scaled


def size_of(scene: Scene) -> float:
    """The median distance of the primitives from their middle; 1 for nerfstudio's model, which keeps its size."""
    return 1.0 if scene.in_model_frame else _middle_and_reach(_usable(scene))[1]


def resized(scene: Scene, factor: float) -> Scene:
    """The scene, without its stored views, ``factor`` times as large."""
    if factor == 1:
        return scene
    values = {"means": scene.field["means"] * factor, "scales": scene.field["scales"] + math.log(factor)}
    return dataclasses.replace(scene, field=scene.field.replaced(values), views=())


def _usable(scene: Scene) -> Field:
    """The finite primitives, detached."""
    finite = finite_mask(scene.field)
    if not bool(finite.any()):
        raise DataError(f"none of {scene.num_primitives:,} primitives is finite, so no camera sees the scene")
    values = {name: value.detach() for name, value in scene.field.items()}
    if not bool(finite.all()):  # else a large field would be copied for nothing
        values = {name: value[finite] for name, value in values.items()}
    return Field(values, scene.field.encoding)


def _middle_and_reach(field: Field) -> tuple[Tensor, float]:
    """Median of the centres ``[3]``, float64, and the median distance from it; in one place, a size."""
    means = field["means"].detach().cpu().double()
    middle = means.median(dim=0).values
    reach = float((means - middle).norm(dim=1).median())
    if reach == 0:
        reach = 3 * float(field["scales"].detach().double().amax(dim=1).median().exp())
    return middle, max(reach, 1e-30)


def _probe(field: Field, middle: Tensor, reach: float, generator: torch.Generator) -> Field:
    """A field of a few primitives that looks alike from afar, of unit size and around the origin.

    Primitives are drawn by their size and opacity, and those drawn grow by as much as covers the others' area.
    """
    kept = field
    if field.num_primitives > _PROBE_PRIMITIVES:
        axes = field["scales"].cpu().double().sort(dim=1).values[:, 1:]
        log_size = axes.sum(dim=1) / 2 + torch.nn.functional.logsigmoid(field["opacities"].cpu().double()[:, 0]) / 2
        size = (log_size - log_size.max()).exp()
        low, high = 0.0, float(field.num_primitives) / float(size.mean())
        for _ in range(60):  # the factor at which as many are drawn, by bisection
            factor = (low + high) / 2
            low, high = (low, factor) if (factor * size).clamp(max=1).sum() > _PROBE_PRIMITIVES else (factor, high)
        chance = (low * size).clamp(max=1)
        drawn = torch.rand(len(chance), generator=generator, dtype=torch.float64) < chance
        kept = field.rows(drawn.to(field["means"].device))
        grown = kept["scales"] - chance[drawn].log().to(kept["scales"])[:, None] / 2
        kept = kept.replaced({"scales": grown})
    moved = (kept["means"].double() - middle.to(kept["means"].device)) / reach
    return kept.replaced({"means": moved.float(), "scales": kept["scales"] - math.log(reach)})


@torch.no_grad()
def _room_ahead(scene: Scene, views: Sequence[View]) -> Tensor:
    """Depth beyond which nine in ten of the pixels of each view lie that show something; 0 if few pixels do ``[V]``."""
    means, settings, found = scene.field["means"], scene.settings(head=False), []
    for seen in views:
        view = seen.to(scene.device)
        z = means @ view.viewmat[2, :3] + view.viewmat[2, 3]
        channels = torch.stack([torch.ones_like(z), z], dim=1)
        opacity, depth = rasterize(colors=channels, **pass_options(scene.field, view, settings)).colors.unbind(2)
        shows = opacity > _OPAQUE
        # Pixels that show nothing sort last, and take no part.
        ordered = torch.where(shows, depth / opacity.clamp_min(_OPAQUE), torch.inf).flatten().sort().values
        count = shows.sum()
        found.append(torch.where(count > _SHOWN * shows.numel(), ordered[(count * _NEAR).long()], 0.0))
    return torch.stack(found).cpu()
