"""Virtual cameras, for scenes that come without cameras: found from the Gaussians alone."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Literal, TypeVar

import torch
from torch import Tensor

from sundae_ns.core.camera import Camera, poses_looking_at, world_to_camera
from sundae_ns.core.covariance import chunks
from sundae_ns.core.gaussians import Gaussians
from sundae_ns.core.values import whole
from sundae_ns.rasterize.interface import rasterize_cameras
from sundae_ns.scene.render import pass_inputs
from sundae_ns.scene.scene import Scene, middle_and_reach, usable

FOV = 40.0
VIEWS = {"cpu": 128, "cuda": 256}  # largest default number of cameras, by the device
SIDE = 512  # default width and height of their images, pixels
T = TypeVar("T")

# The search of virtual_cameras; distances are multiples of the median distance of the Gaussians from their middle.
NEAREST, FARTHEST = 0.3, 2.0  # of the eyes from the middle
FIRST, ROUNDS, MOVED = 4, 4, 3  # cameras drawn for each one that is kept; then rounds, and the moved ones of a round
STEP = 0.3  # how far an eye moves in a round, as a share of its distance
RESAMPLED = 3  # rounds that begin by drawing the even half anew, in proportion to exp(-coarseness)
EVENNESS = 4.0  # weight of the deviation of the angles beside their mean, for the half that sees all parts alike
_PROBE_SIZE, _PROBES = 24, 64  # sides of the images that candidates are judged by, pixels, and images at once
_PROBE_GAUSSIANS = 20_000  # most Gaussians of these images
Rule = Literal["mean", "even", "cover"]  # of what a camera is judged by, see _coarseness
_CHANNELS = {"mean": 1, "even": 2, "cover": 3}  # that a rule blends: the logarithm, its square, and the coverage
# Of front views: azimuths and elevations, radians, and distances.
_AROUND = [math.tau * i / 24 for i in range(24)], [0.0, 0.2, 0.45], [0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0]


def by_device(values: Mapping[str, T], device: torch.device) -> T:
    """The value for a device, by its type; other devices than those named take that of a CPU."""
    return values.get(device.type, values["cpu"])


def virtual_cameras(scene: Scene, n: int | None = None, *, seed: int = 0, size: int | None = None) -> list[Camera]:
    """Cameras that see a scene as a visitor would, for scenes without cameras.

    Training splits Gaussians until each covers few pixels of the photographs, so they look small from where these were
    taken. Half of the cameras are drawn and moved until the mean logarithm of the Gaussians' angles, in small images,
    is low. For the others mean and deviation are low; in the end these look at random Gaussians.

    Args:
        scene: its finite Gaussians count.
        n: number of cameras; by default one for 32 Gaussians, at least 32, at most 128 on a CPU and 256 on a GPU.
        seed: of the random draws, which are the same on every device up to rounding.
        size: width and height of the images, pixels; by default 512, or ``16 sqrt(N)`` for fewer Gaussians.

    Raises:
        ConfigError, DataError: ``n`` (to 10,000) or ``size`` is no whole number; no Gaussian is finite.

    >>> import torch, sundae_ns as sn
    >>> scene = sn.Scene.from_points(torch.rand(100, 3), torch.rand(100, 3))
    >>> len(sn.virtual_cameras(scene, 8))
    8
    """
    usual = min(by_device(VIEWS, scene.device), max(scene.num_gaussians // 32, 32))
    n = whole(usual if n is None else n, "n", most=10_000)
    size = min(SIDE, max(64, 16 * math.isqrt(scene.num_gaussians))) if size is None else size
    gaussians = usable(scene)
    generator = torch.Generator().manual_seed(whole(seed, "seed", 0))
    probe, sizes, middle, reach = _probe(scene, gaussians, generator)
    normal = partial(torch.randn, generator=generator, dtype=torch.float64)

    def random_targets(count: int) -> Tensor:
        drawn = torch.randint(gaussians.num_gaussians, (count,), generator=generator)
        return (gaussians["means"][drawn.to(scene.device)].cpu().double() - middle) / reach

    def climb(n: int, rule: Rule) -> tuple[Tensor, Tensor]:  # eyes and targets of n cameras
        def best_of(eyes: Tensor, targets: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # those n apart, and coarseness
            coarseness = _coarseness(probe, sizes, eyes, targets, rule).view(-1, n)
            best = coarseness.argmin(dim=0) * n + torch.arange(n)
            return eyes[best], targets[best], coarseness.amin(dim=0)

        direction = torch.nn.functional.normalize(normal(FIRST * n, 3), dim=1)
        share = torch.rand(FIRST * n, 1, generator=generator, dtype=torch.float64)
        eyes = direction * NEAREST * (FARTHEST / NEAREST) ** share
        eyes, targets, coarseness = best_of(eyes, random_targets(FIRST * n))
        for done in range(ROUNDS):
            if rule == "even" and done < RESAMPLED:
                chances = (-coarseness.double()).softmax(dim=0)
                points = torch.arange(n, dtype=torch.float64) + torch.rand(1, generator=generator, dtype=torch.float64)
                drawn = torch.searchsorted(chances.cumsum(0), points / n).clamp_max(n - 1)
                eyes, targets, coarseness = eyes[drawn], targets[drawn], coarseness[drawn]
            near, ahead = eyes.repeat(MOVED, 1), targets.repeat(MOVED, 1)
            moved = near + STEP / 3**0.5 * near.norm(dim=1, keepdim=True) * normal(len(near), 3)
            turns = torch.rand(len(near), 1, generator=generator) < 0.5  # the others look at the same Gaussian
            moved, ahead, moved_coarseness = best_of(moved, torch.where(turns, random_targets(len(near)), ahead))
            better = moved_coarseness < coarseness
            eyes, targets = torch.where(better[:, None], moved, eyes), torch.where(better[:, None], ahead, targets)
            coarseness = torch.where(better, moved_coarseness, coarseness)
        return eyes, targets

    eyes, targets = climb(n - n // 2, "mean")
    if n > 1:
        even, _ = climb(n // 2, "even")
        # In turns, so that the first few are of both kinds.
        turns = torch.cat([torch.arange(len(eyes)) * 2, torch.arange(len(even)) * 2 + 1]).argsort()
        eyes = torch.cat([eyes, even])[turns]
        targets = torch.cat([targets, random_targets(len(even))])[turns]
    up = scene.up or (0.0, 0.0, 1.0)
    return [
        Camera.look_at(middle + reach * eye, middle + reach * target, up, fov=FOV, width=size, height=size)
        for eye, target in zip(eyes, targets, strict=True)
    ]


def front_views(scene: Scene, n: int = 7) -> list[Camera]:
    """Up to 7 cameras of 640 x 480 pixels that look at the middle of a scene, from one side and up to 45 degrees off.

    The first sees most of the scene, by the smallest and most equal Gaussians; a page opens with it.
    """
    probe, sizes, middle, reach = _probe(scene, usable(scene), torch.Generator().manual_seed(0))
    up = torch.tensor(scene.up or (0.0, 0.0, 1.0), dtype=torch.float64)
    turn, rise, away = torch.cartesian_prod(*(up.new_tensor(values) for values in _AROUND)).T
    around = torch.stack([turn.cos() * rise.cos(), turn.sin() * rise.cos(), rise.sin()]) * away
    eyes = (poses_looking_at(up, torch.zeros_like(up), up)[:, :3] @ around).T
    best = int(_coarseness(probe, sizes, eyes, torch.zeros_like(eyes), "cover").argmin())
    step = len(eyes) // len(_AROUND[0])  # from one azimuth to the next
    chosen = [middle + reach * eyes[(best + side * step) % len(eyes)] for side in (0, 1, -1, 2, -2, 3, -3)]
    return [Camera.look_at(eye, middle, up, fov=50, width=640, height=480) for eye in chosen[:n]]


def of_unit_size(scene: Scene, cameras: Sequence[Camera]) -> tuple[Scene, list[Camera], float]:
    """A scene and its cameras, on its device, at a size of 1, and its size: the near plane would hide millimetres.

    The size is the median distance of the Gaussians from their middle; 1 for nerfstudio's model, which stays as it is.
    """
    size = scene.extent
    divisors = torch.ones(4, 4)
    divisors[:3, 3] = size  # of translations
    scaled = [each._replace(viewmat=each.viewmat / divisors.to(each.viewmat)).to(scene.device) for each in cameras]
    if size != 1:
        scene = dataclasses.replace(scene, gaussians=resized(scene.gaussians, 1 / size), cameras=())
    return scene, scaled, size


def at_most(camera: Camera, pixels: int) -> Camera:
    """The camera, zoomed out if its image has more pixels."""
    return camera.zoomed(min(1.0, math.sqrt(pixels / (camera.width * camera.height))))


def split(cameras: Sequence[Camera]) -> tuple[list[Camera], list[Camera]]:
    """The cameras that decide, and those that are held out: every eighth, from the first on."""
    return [camera for i, camera in enumerate(cameras) if i % 8], list(cameras[::8])


def resized(gaussians: Gaussians, factor: float) -> Gaussians:
    """The Gaussians, ``factor`` times as large."""
    return gaussians.replaced({"means": gaussians["means"] * factor, "scales": gaussians["scales"] + math.log(factor)})


def _probe(scene: Scene, gaussians: Gaussians, generator: torch.Generator) -> tuple[Scene, Tensor, Tensor, float]:
    """Few of the finite ``gaussians`` at unit size, grown to cover all; logarithms of sizes ``[M]``; middle, reach."""
    middle, reach = middle_and_reach(gaussians)
    sizes = gaussians["scales"].double().sort(dim=1).values[:, 1:].mean(dim=1) - math.log(reach)
    kept = gaussians
    if gaussians.num_gaussians > _PROBE_GAUSSIANS:
        weight = sizes + torch.nn.functional.logsigmoid(gaussians["opacities"].double()[:, 0]) / 2
        size = (weight - weight.max()).exp()
        chance = (_factor(size, _PROBE_GAUSSIANS) * size).clamp(max=1).cpu()
        drawn = torch.rand(len(chance), generator=generator, dtype=torch.float64) < chance
        kept, sizes = gaussians.rows(drawn.to(gaussians["means"].device)), sizes[drawn.to(sizes.device)]
        kept = kept.replaced({"scales": kept["scales"] - chance[drawn].log().to(kept["scales"])[:, None] / 2})
    moved = (kept["means"].double() - middle.to(kept["means"].device)) / reach
    values = {"means": moved.float(), "scales": kept["scales"] - math.log(reach)}
    return dataclasses.replace(scene, gaussians=kept.replaced(values)), sizes.float(), middle, reach


def _factor(values: Tensor, count: int) -> Tensor:
    """The factor at which values ``[N]``, limited to 1 each, have the sum ``count < N``."""
    # With the largest k values at 1, the others share the rest. The sum is the least over k, so the factor is the most.
    left = count - torch.arange(count, dtype=values.dtype, device=values.device)
    return (left / values.sort().values.cumsum(0).flip(0)[:count].clamp_min(1e-290)).amax()


@torch.no_grad()
def _coarseness(scene: Scene, sizes: Tensor, eyes: Tensor, targets: Tensor, rule: Rule) -> Tensor:
    """Logarithm of the angle of the Gaussians in the pixels ``[V]``: its ``mean``; ``even`` adds its deviation.

    ``cover`` does too, of covered pixels; a view gains by their number, as by more Gaussians, and by centres in it.
    """
    means, settings = scene.gaussians["means"], scene.settings(head=False)
    coarseness: list[Tensor] = []
    poses = poses_looking_at(eyes, targets, eyes.new_tensor([0.0, 0.0, 1.0]))
    eyes, viewmats = eyes.to(means), world_to_camera(poses.float()).to(scene.device)
    camera = Camera.from_fov(torch.eye(4), FOV, _PROBE_SIZE, _PROBE_SIZE).to(scene.device)
    inputs = pass_inputs(scene.gaussians, camera, settings)
    for some in chunks(len(eyes), _PROBES):
        angles = (sizes - (means - eyes[some, None]).norm(dim=2).clamp_min(1e-9).log()).clamp_max(0)
        # Blending adds nothing where nothing is seen: the logarithm of one radian.
        powers = torch.stack([angles, angles.square(), torch.ones_like(angles)][: _CHANNELS[rule]], dim=-1)
        probes = dataclasses.replace(inputs, colors=powers)
        images = rasterize_cameras(probes, viewmats[some], camera.K.expand(len(powers), 3, 3), backend=settings.backend)
        mean, *others = images.mean(dim=(1, 2)).unbind(dim=1)
        if rule == "cover":
            covered = others.pop().clamp_min(1e-6)
            mean, others = mean / covered, [others[0] / covered]
        for square in others:
            mean = mean + EVENNESS * (square - mean.square()).clamp_min(0).sqrt()
        if rule == "cover":
            x, y, z = (viewmats[some, :3, :3] @ means.T + viewmats[some, :3, 3:]).unbind(dim=1)
            inside = torch.maximum(x.abs(), y.abs()) < z * math.tan(math.radians(FOV / 2))
            mean = mean - (covered.log() + inside.float().mean(dim=1)) / 2
        coarseness.append(mean)
    return torch.cat(coarseness).cpu()  # the one wait for a GPU
