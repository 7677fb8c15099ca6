"""Virtual cameras: views of a scene that comes without any, from the field alone."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from sundae_ns.api.rendering import render
from sundae_ns.api.scene import Scene
from sundae_ns.data.camera_axes import world_to_camera
from sundae_ns.errors import ConfigError, DataError
from sundae_ns.gaussians import mend
from sundae_ns.gaussians.covariance import chunks
from sundae_ns.gaussians.field import Field
from sundae_ns.rasterization import rasterize_views
from sundae_ns.rendering import View
from sundae_ns.rendering.render import pass_options
from sundae_ns.rendering.views import poses_looking_at

NEAREST, FARTHEST = 0.3, 2.0
"""Distances of the eyes from the middle of the scene, as multiples of the median distance of its primitives."""
FOV = 40.0
T = TypeVar("T")
VIEWS = {"cpu": 128, "cuda": 256}
"""Default number of cameras by the device: a GPU has the time to look closer."""
SIDE = 512
"""Default width and height of their images, pixels."""
FIRST, ROUNDS, MOVED = 4, 4, 3
"""Cameras that are drawn for each one that is kept; then rounds, and the moved ones of a round."""
STEP = 0.3
"""How far an eye moves in a round, as a share of its distance from the middle."""
RESAMPLED = 3
"""Rounds before which the even half is drawn anew, in proportion to exp(-coarseness)."""
EVENNESS = 4.0
"""Weight of the deviation of the angles beside their mean, for the half of the eyes that see all parts alike."""
_LOOP_VIEWS, _LOOP_EYES = 48, 24
"""Virtual views that loops are tried for, and eyes of a loop."""
_SWAY = 30.0
"""How far the loop before a scene goes to each side, degrees."""
_BACK_SIDE = 1.0
"""A scene has a back side if the worst eye all around sees primitives larger by this logarithm than before it."""
_NEARNESS = 0.7
"""Part of the logarithm of a loop's radius that is added to the measure, which alone would go far away."""
_LEVEL = 0.75
"""Least sine of the angle between the axis of a loop and the view that gives it: none from high above."""
_PROBE_SIZE = 24
"""Sides of the images that candidates are judged by, pixels."""
_PROBE_PRIMITIVES = 20_000
"""Most primitives of these images."""
_PROBES = 64
"""Images that are rendered at once."""


def by_device(values: Mapping[str, T], device: torch.device) -> T:
    """The value for a device, by its type; other devices than those named take that of a CPU."""
    return values.get(device.type, values["cpu"])


def virtual_views(scene: Scene, n: int | None = None, *, seed: int = 0, size: int | None = None) -> list[View]:
    """Cameras that see a scene as a visitor would, for scenes without cameras.

    A field shows where its photographs were taken: training splits primitives until each covers few pixels of the
    images, so from there all of them look small, near and far ones alike. From elsewhere some are blobs, and so are
    matter and floaters that are too near. Eyes are drawn in all directions from the middle of the scene, at 0.3 to 2
    times the median distance of its primitives, and look at random primitives. Small images judge them by the logarithm
    of the angle of the primitives that they show; where nothing is seen, that of one radian.

    Of every two cameras, one seeks the finest primitives, by the mean: it is the best of four, and four times the best
    of three moved ones takes its place if it is better. The other seeks evenness too, by the mean and the deviation,
    and those that have found little start again where others have found more. It then looks at a random primitive, so
    that the cameras see what is around them.

    Args:
        scene: its finite primitives count.
        n: number of cameras; by default 128 for a scene on a CPU and 256 for one on a GPU.
        seed: of the random draws, which are the same on every device up to rounding.
        size: width and height of the images, pixels; by default 512.

    Raises:
        ConfigError: ``n`` or ``size`` is less than 1.
        DataError: no primitive is finite.

    >>> import torch, sundae_ns as sn
    >>> scene = sn.Scene.from_points(torch.rand(100, 3), torch.rand(100, 3))
    >>> len(sn.virtual_views(scene, 8))
    8
    """
    n = by_device(VIEWS, scene.device) if n is None else n
    size = SIDE if size is None else size
    if n < 1 or size < 1:
        raise ConfigError(f"{n} views of {size} x {size} pixels see nothing; give at least 1 of both")
    field = _usable(scene)
    means = field["means"]
    middle, reach = _middle_and_reach(field)
    generator = torch.Generator().manual_seed(seed)
    probe, sizes = _probe(field, middle, reach, generator)
    judge = dataclasses.replace(scene, field=probe)

    def random_targets(count: int) -> Tensor:
        drawn = torch.randint(len(means), (count,), generator=generator)
        return (means[drawn.to(means.device)].cpu().double() - middle) / reach

    def normal(count: int) -> Tensor:
        return torch.randn(count, 3, generator=generator, dtype=torch.float64)

    def climb(n: int, evenness: float) -> tuple[Tensor, Tensor]:
        """Eyes and targets of n cameras."""

        def best_of(eyes: Tensor, targets: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            """The best of the cameras n apart, and their coarseness."""
            coarseness = _coarseness(judge, sizes, eyes, targets, evenness).view(-1, n)
            best = coarseness.argmin(dim=0) * n + torch.arange(n)
            return eyes[best], targets[best], coarseness.amin(dim=0)

        direction = torch.nn.functional.normalize(normal(FIRST * n), dim=1)
        share = torch.rand(FIRST * n, 1, generator=generator, dtype=torch.float64)
        eyes = direction * NEAREST * (FARTHEST / NEAREST) ** share
        eyes, targets, coarseness = best_of(eyes, random_targets(FIRST * n))
        for done in range(ROUNDS):
            if evenness and done < RESAMPLED:
                drawn = _resampled((-coarseness.double()).softmax(dim=0), generator)
                eyes, targets, coarseness = eyes[drawn], targets[drawn], coarseness[drawn]
            near, ahead = eyes.repeat(MOVED, 1), targets.repeat(MOVED, 1)
            moved = near + STEP / 3**0.5 * near.norm(dim=1, keepdim=True) * normal(len(near))
            turns = torch.rand(len(near), 1, generator=generator) < 0.5  # the others look at the same primitive
            moved, ahead, found = best_of(moved, torch.where(turns, random_targets(len(near)), ahead))
            better = found < coarseness
            eyes, targets = torch.where(better[:, None], moved, eyes), torch.where(better[:, None], ahead, targets)
            coarseness = torch.where(better, found, coarseness)
        return eyes, targets

    eyes, targets = climb(n - n // 2, 0.0)
    if n > 1:
        even, _ = climb(n // 2, EVENNESS)
        # In turns, so that the first few are of both kinds.
        turns = torch.cat([torch.arange(len(eyes)) * 2, torch.arange(len(even)) * 2 + 1]).argsort()
        eyes = torch.cat([eyes, even])[turns]
        targets = torch.cat([targets, random_targets(len(even))])[turns]
    return [
        View.look_at(middle + reach * eye, middle + reach * target, fov=FOV, width=size, height=size)
        for eye, target in zip(eyes, targets, strict=True)
    ]


class Loop(NamedTuple):
    """A closed path of eyes that look at one point."""

    eyes: Tensor
    """Centres of the cameras in their order ``[V, 3]``, float64 on the CPU."""
    target: Tensor
    """The point that they look at ``[3]``."""


@torch.no_grad()
def loop_around(scene: Scene, up: Tensor) -> Loop:
    """The best loop of eyes for a scene without cameras: all around what a virtual view sees, or to and fro before it.

    Each of some virtual views gives both loops, about the point in the middle of its image and about the middle of the
    scene. A loop is as good as its worst eye, by the measure of :func:`virtual_views`, and better the nearer it is. The
    way all around is taken unless the scene has a back side.

    Args:
        scene: its finite primitives count.
        up: axis of the loop, of unit length ``[3]``, float64 on the CPU.

    Raises:
        DataError: no primitive is finite.
    """
    field = _usable(scene)
    middle, reach = _middle_and_reach(field)
    probe, sizes = _probe(field, middle, reach, torch.Generator().manual_seed(0))
    judge = dataclasses.replace(scene, field=probe)
    turns = torch.arange(_LOOP_EYES, dtype=torch.float64) * (2 * math.pi / _LOOP_EYES)
    sway = math.radians(_SWAY)
    angles = {"around": (turns, 0 * turns), "before": (sway * turns.sin(), sway / 4 * turns.cos())}
    best: dict[str, tuple[float, Loop]] = {}
    for view in virtual_views(scene, _LOOP_VIEWS)[::2]:  # those of the finest primitives
        eye, ahead = (view.center.double() - middle) / reach, -view.pose[:, 2].double()
        image = View.look_at(eye, eye + ahead, up, fov=FOV / 3, width=_PROBE_SIZE, height=_PROBE_SIZE)
        depth = render(judge, image, head=False).depth
        seen = [eye + float(depth[depth > 0].median()) * ahead] if bool((depth > 0).any()) else []
        for target in (*seen, torch.zeros_like(eye)):
            arm = eye - target
            side = torch.linalg.cross(up, arm)
            if not (NEAREST <= float(arm.norm()) <= 2 * FARTHEST and float(side.norm()) >= _LEVEL * float(arm.norm())):
                continue
            for name, (across, above) in angles.items():
                lifted = [_turned(arm, side / side.norm(), -float(angle)) for angle in above]
                turned = [_turned(arm, up, float(angle)) for arm, angle in zip(lifted, across, strict=True)]
                eyes = target + torch.stack(turned)
                worst = float(_coarseness(judge, sizes, eyes, target.expand_as(eyes), 0.0).max())
                worst += _NEARNESS * math.log(float(arm.norm()))
                if worst < best.get(name, (math.inf,))[0]:
                    best[name] = worst, Loop(middle + reach * eyes, middle + reach * target)
    if not best:  # all virtual views are above or below
        side = torch.linalg.cross(up.roll(1), up)
        eyes = torch.stack([_turned(side, up, float(angle)) for angle in turns])
        return Loop(middle + FARTHEST * reach * eyes, middle)
    better = best["around"][0] < best["before"][0] + _BACK_SIDE
    return best["around" if better else "before"][1]


def _turned(arm: Tensor, axis: Tensor, angle: float) -> Tensor:
    """A vector turned about an axis of unit length, radians."""
    along = (arm @ axis) * axis
    return along + math.cos(angle) * (arm - along) + math.sin(angle) * torch.linalg.cross(axis, arm)


def _resampled(chances: Tensor, generator: torch.Generator) -> Tensor:
    """Indices of as many systematic draws as there are chances, which have the sum 1 ``[N]``."""
    places = torch.arange(len(chances), dtype=chances.dtype) + torch.rand(1, generator=generator, dtype=chances.dtype)
    return torch.searchsorted(chances.cumsum(0), places / len(chances)).clamp_max(len(chances) - 1)


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
    field = mend(scene.field).field
    if not field.num_primitives:
        raise DataError(f"none of {scene.num_primitives:,} primitives is finite, so no camera sees the scene")
    return Field({name: value.detach() for name, value in field.items()}, field.encoding)


def _middle_and_reach(field: Field) -> tuple[Tensor, float]:
    """Median of the centres ``[3]``, float64 on the CPU, and the median distance from it; in one place, a size."""
    means = field["means"].detach().double()
    middle = means.median(dim=0).values
    reach = float((means - middle).norm(dim=1).median())
    if reach == 0:
        reach = 3 * float(field["scales"].detach().double().amax(dim=1).median().exp())
    return middle.cpu(), max(reach, 1e-30)


def _probe(field: Field, middle: Tensor, reach: float, generator: torch.Generator) -> tuple[Field, Tensor]:
    """A field of a few primitives that looks alike from afar, of unit size and around the origin.

    Primitives are drawn by their size and opacity, and those drawn grow by as much as covers the others' area.

    Returns:
        The field of M primitives, and the logarithms of their sizes before they grew ``[M]``.
    """
    sizes = field["scales"].double().sort(dim=1).values[:, 1:].mean(dim=1) - math.log(reach)
    kept = field
    if field.num_primitives > _PROBE_PRIMITIVES:
        weight = sizes + torch.nn.functional.logsigmoid(field["opacities"].double()[:, 0]) / 2
        size = (weight - weight.max()).exp()
        chance = (_factor(size, _PROBE_PRIMITIVES) * size).clamp(max=1).cpu()
        drawn = torch.rand(len(chance), generator=generator, dtype=torch.float64) < chance
        kept, sizes = field.rows(drawn.to(field["means"].device)), sizes[drawn.to(sizes.device)]
        grown = kept["scales"] - chance[drawn].log().to(kept["scales"])[:, None] / 2
        kept = kept.replaced({"scales": grown})
    moved = (kept["means"].double() - middle.to(kept["means"].device)) / reach
    values = {"means": moved.float(), "scales": kept["scales"] - math.log(reach)}
    return kept.replaced(values), sizes.float()


def _factor(values: Tensor, count: int) -> Tensor:
    """The factor at which values ``[N]``, limited to 1 each, have the sum ``count < N``."""
    # With the largest k values at 1, the others share what is left. The sum is the least of these sums over k, so the
    # factor is the largest of theirs.
    left = count - torch.arange(count, dtype=values.dtype, device=values.device)
    return (left / values.sort().values.cumsum(0).flip(0)[:count].clamp_min(1e-290)).amax()


@torch.no_grad()
def _coarseness(scene: Scene, sizes: Tensor, eyes: Tensor, targets: Tensor, evenness: float) -> Tensor:
    """Of the logarithm of the angle of what the pixels of each camera show, at most 0: the mean ``[V]``.

    Args:
        sizes: logarithms of the primitives' sizes ``[N]``.
        eyes: ``[V, 3]``.
        targets: ``[V, 3]``.
        evenness: factor of the standard deviation, which is added.
    """
    means, settings, found = scene.field["means"], scene.settings(head=False), []
    poses = poses_looking_at(eyes, targets, eyes.new_tensor([0.0, 0.0, 1.0]))
    eyes, viewmats = eyes.to(means), world_to_camera(poses.float()).to(scene.device)
    view = View.from_fov(torch.eye(4), FOV, _PROBE_SIZE, _PROBE_SIZE).to(scene.device)
    options = pass_options(scene.field, view, settings)
    K = options.pop("K")
    del options["viewmat"]
    for some in chunks(len(eyes), _PROBES):
        distances = (means - eyes[some, None]).norm(dim=2).clamp_min(1e-9)
        angles = (sizes - distances.log()).clamp_max(0)
        # Blending adds nothing where nothing is seen: the logarithm of one radian.
        options |= {"viewmats": viewmats[some], "Ks": K.expand(len(distances), 3, 3)}
        powers = torch.stack([angles, angles.square()][: 2 if evenness else 1], dim=-1)
        mean, *squares = rasterize_views(colors=powers, **options).mean(dim=(1, 2)).unbind(dim=1)
        for square in squares:
            mean = mean + evenness * (square - mean.square()).clamp_min(0).sqrt()
        found.append(mean)
    return torch.cat(found).cpu()  # the one wait for a GPU
