"""Pruning of a scene by what cameras see of it, without photographs; cuts by a box, and of floaters."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from rich.console import Console
from rich.progress import Progress
from torch import Tensor

from sundae_ns.core.camera import Camera
from sundae_ns.core.errors import ConfigError, DataError
from sundae_ns.core.gaussians import Gaussians, sanitise
from sundae_ns.core.values import AnyArray, numbers, whole
from sundae_ns.cuda.adam import Update, adam_step
from sundae_ns.graph.graph import NeighborGraph
from sundae_ns.pruning.decision import prune_gaussians
from sundae_ns.pruning.floaters import STRENGTH, floater_odds
from sundae_ns.pruning.rule import PruneRule, kept_count
from sundae_ns.rasterize.interface import rasterize_cameras
from sundae_ns.scene.render import GaussianSource, RenderSettings, TrainingCamera, contribution, pass_inputs
from sundae_ns.scene.scene import Scene, measure, usable_cameras
from sundae_ns.scene.virtual_cameras import by_device, of_unit_size, resized, size_of, split, virtual_cameras

REFIT = {"cpu": (192, 1, 0.7), "cuda": (128, 4, 1.0)}  # steps of a refit, images of each, and factor of its rates
REFIT_PIXELS, MOST_PIXELS = 1 << 18, 1 << 22  # most pixels of an image of a refit, and of one that tells what is seen


class PrunedScene(NamedTuple):
    """A pruned scene, and what it keeps."""

    scene: Scene
    mask: Tensor  # True for kept Gaussians of the scene before the prune, bool [N]
    seen: float | None = None  # share of the finite Gaussians that the cameras see; None if none was asked
    moved: bool = False  # whether kept Gaussians have other values than before


def prune(
    scene: Scene,
    *,
    keep: float | None = None,
    count: int | None = None,
    cameras: Camera | Iterable[Camera] | None = None,
    rule: PruneRule | None = None,
    progress: bool = False,
) -> Scene:
    """Keep the Gaussians that matter most to the cameras, and merge the others into them.

    Gaussians with NaN or meaningless infinite values are dropped first (:func:`.sanitise`). After a merge by pairs, a
    few steps fit the kept ones to the scene's own images. The new scene keeps the head, trained for all Gaussians.

    Args:
        scene: to prune; it does not change.
        keep: share of the finite Gaussians to keep, in (0, 1]: ``round(keep * N)``.
        count: number of Gaussians to keep, in place of a share; at least 1.
        cameras: cameras whose images the prune preserves; by default those stored with the scene, else
            :func:`sundae_ns.virtual_cameras`.
        rule: score, selection and merge; by default ``PruneRule()``.
        progress: show a progress bar on stderr.

    Raises:
        ConfigError: neither or both of ``keep`` and ``count`` are given, or they or an option are out of range.
        DataError: no Gaussian is finite, or the cameras see none.

    >>> import torch, sundae_ns as sn
    >>> scene = sn.Scene.from_points(torch.rand(200, 3), torch.rand(200, 3))
    >>> sn.prune(scene, keep=0.1, cameras=sn.virtual_cameras(scene, 4, size=32)).num_gaussians
    20
    """
    if not isinstance(rule, PruneRule | None):
        raise ConfigError(f"the rule is {rule!r}; give a PruneRule, such as PruneRule(selection='pairs')")
    cameras = None if cameras is None else usable_cameras(cameras)
    return prune_with_mask(scene, keep, count, cameras, rule, progress=progress).scene


@torch.no_grad()
def prune_with_mask(
    scene: Scene,
    keep: float | None = None,
    count: int | None = None,
    cameras: Sequence[Camera] | None = None,
    rule: PruneRule | None = None,
    *,
    progress: bool = False,
    fit: bool = True,
    weights: Tensor | None = None,
    graph: NeighborGraph | None = None,
) -> PrunedScene:
    """As :func:`prune`, with the mask of the kept Gaussians; without ``fit``, a training that follows fits them.

    ``weights`` ``[M]`` of the finite Gaussians, by :func:`weights_in`, and their ``graph`` are not computed again.
    """
    if (keep is None) == (count is None):
        raise ConfigError("prune needs either keep (a share) or count (a number of Gaussians); give one of them")
    if keep is not None and not 0 < float(numbers(keep, "keep", ())) <= 1:
        raise ConfigError(f"keep is {keep}; give a share in (0, 1], 0.1 to keep a tenth")
    if count is not None:
        whole(count, "count")
    rule, sanitised = rule or PruneRule(), sanitise(scene.gaussians)
    n = sanitised.gaussians.num_gaussians
    if keep is not None:
        count = kept_count(keep, n)
    assert count is not None
    usable = dataclasses.replace(scene, gaussians=sanitised.gaussians)
    console, images = Console(stderr=True) if progress else None, list[Tensor]()
    if not rule.uses_contribution or count >= n:
        weights = None
    else:
        given = cameras if cameras is not None else scene.cameras or virtual_cameras(usable)
        if weights is None:
            weights = weights_in(usable, given, count if rule.uses_detail else None, console, images if fit else None)
    pruned = prune_gaussians(sanitised.gaussians, rule, count, weights, graph)
    small = dataclasses.replace(scene, gaussians=pruned.gaussians)
    if weights is not None and rule.refits and fit:
        size, (full, scaled) = size_of(usable), of_unit_size(usable, given)
        scaled = [camera.to(scene.device) for camera in scaled]
        gaussians = resized(small, 1 / size).gaussians
        settings = scene.settings(head=False)
        fitted = refit(gaussians, full.gaussians, scaled, settings, images=images, seed=rule.seed, console=console)
        fitted = resized(dataclasses.replace(scene, gaussians=fitted), size).gaussians
        small = dataclasses.replace(scene, gaussians=fitted)
    mask = within(sanitised.mask, pruned.decision.mask)
    seen = None if weights is None else float((weights > 0).float().mean())
    return PrunedScene(small, mask, seen, rule.redistribution == "merge" and count < n)


def at_most(camera: Camera, pixels: int) -> Camera:
    """The camera, zoomed out if its image has more pixels."""
    return camera.zoomed(min(1.0, math.sqrt(pixels / (camera.width * camera.height))))


def weights_in(
    scene: Scene,
    cameras: Sequence[Camera],
    count: int | None = None,
    console: Console | None = None,
    images: list[Tensor] | None = None,
) -> Tensor:
    """Blending weight of each Gaussian of a finite scene ``[N]``, by :func:`.contribution`; ``DataError`` for none."""
    if any(camera.width * camera.height > REFIT_PIXELS for camera in cameras):
        images = None  # a refit reads smaller ones
    sized, scaled = of_unit_size(scene, [at_most(camera, MOST_PIXELS) for camera in cameras])
    views = [TrainingCamera(camera.to(scene.device), None) for camera in scaled]
    source, settings = GaussianSource(sized.gaussians), scene.settings(head=False)
    weights = contribution(source, views, scene.background, settings, count, images=images, console=console)
    if not bool((weights > 0).any()):
        none = f"{len(scaled)} views see none of {scene.num_gaussians:,} Gaussians"
        raise DataError(f"{none}; give cameras that look at the scene, or export it again")
    return weights


@torch.no_grad()
def refit(
    small: Gaussians,
    full: Gaussians,
    cameras: Sequence[Camera],
    settings: RenderSettings,
    *,
    images: Sequence[Tensor] = (),
    seed: int = 0,
    console: Console | None = None,
) -> Gaussians:
    """Fit centres, shapes, opacities and base colours of Gaussians to the images of more Gaussians, ``full``.

    A merge keeps moments, not images. Adam's steps (Kingma and Ba, 2015) lower the squared error of the blended colours
    and of the accumulation, over a few images each, in an order by ``seed``. Returns ``small`` if it matches no worse.
    ``images`` ``[H, W, 4]`` of ``full`` for all cameras are not rendered again.
    """
    steps, views, factor = by_device(REFIT, small["means"].device)
    cameras = [at_most(camera, REFIT_PIXELS) for camera in cameras]
    order = torch.randperm(len(cameras), generator=torch.Generator().manual_seed(seed)).tolist()
    # Eight cameras that no step uses judge, if there are twice as many.
    judges, trained = (order[:8], order[8:]) if len(order) >= 16 else (order, order)
    truths = dict(enumerate(images))
    size = small["scales"].exp().sort(dim=1).values[:, 1:].mean(dim=1, keepdim=True)
    # The rates are the size of the first steps, for a prune to 15% or fewer; with more Gaussians less is left to fit.
    rates = {"means": 0.014, "scales": 0.007, "quats": 0.007, "opacities": 0.035, "features_dc": 0.014}
    factor *= min(1.0, 0.15 * full.num_gaussians / small.num_gaussians)
    units: dict[str, Any] = {**rates, "means": size * rates["means"]}  # centres move in sizes of their Gaussian
    moved = {name: torch.zeros_like(small[name], requires_grad=True) for name in rates}
    running = [(torch.zeros_like(value), torch.zeros_like(value), size.new_zeros(())) for value in moved.values()]
    adam = {"betas": (0.9, 0.99), "eps": 1e-15, "weight_decay": 0.0}

    def fitted() -> Gaussians:
        return small.replaced({name: small[name] + units[name] * step for name, step in moved.items()})

    def error(gaussians: Gaussians, chosen: Sequence[int]) -> Tensor:
        """Sum of the mean squared errors of some cameras."""
        new = [i for i in dict.fromkeys(chosen) if i not in truths]
        with torch.no_grad():
            truths.update(zip(new, _blended(full, [cameras[i] for i in new], settings), strict=True))
        rendered = zip(_blended(gaussians, [cameras[i] for i in chosen], settings), chosen, strict=True)
        return torch.stack([(image - truths[i]).square().mean() for image, i in rendered]).sum()

    with Progress(transient=True, console=console, disable=console is None) as progress:
        for i in progress.track(range(steps), description="Refit of Gaussians"):
            with torch.enable_grad():
                loss = error(fitted(), [trained[k % len(trained)] for k in range(i * views, (i + 1) * views)])
            # Not by torch.optim, which imports a compiler for two seconds.
            gradients = torch.autograd.grad(loss, list(moved.values()))
            rows = zip(moved.values(), gradients, running, strict=True)
            updates = [Update(value, gradient.contiguous(), *state) for value, gradient, state in rows]
            adam_step([(adam, updates)], size.new_full((1,), factor * (1 - i / steps)), None)
    gaussians = fitted()
    before, after = (error(each, judges) for each in (small, gaussians))
    return gaussians if bool(after < before) else small  # small too if the fitted ones are not finite


def _blended(gaussians: Gaussians, cameras: Sequence[Camera], settings: RenderSettings) -> list[Tensor]:
    """Blended colours and accumulation for each camera, without background ``[H, W, 4]``."""
    if len({(camera.width, camera.height) for camera in cameras}) != 1:
        return [image for camera in cameras for image in _blended(gaussians, [camera], settings)]
    primitives = [GaussianSource(gaussians).primitives(camera, settings, features=False) for camera in cameras]
    colors = torch.stack([each["colors"] for each in primitives])
    # What blends to the accumulation is 1 everywhere.
    channels = torch.cat([colors, torch.ones_like(colors[..., :1])], dim=2)
    inputs = pass_inputs(primitives[0], cameras[0], settings, channels)
    viewmats, Ks = torch.stack([camera.viewmat for camera in cameras]), torch.stack([camera.K for camera in cameras])
    return list(rasterize_cameras(inputs, viewmats, Ks, backend=settings.backend))


def count_for_drop(
    scene: Scene, drop: float, cameras: Sequence[Camera], rule: PruneRule, *, progress: bool = False
) -> tuple[int, list[tuple[int, float]]]:
    """The fewest Gaussians whose images lose at most ``drop`` dB, with the PSNR (dB) by counts that it follows from.

    The scene is pruned to a half, a quarter and so on, until every eighth camera, held out, sees too much difference.
    The error adds to that of the full scene against photographs, which is taken to be that of 30 dB.
    """
    if len(cameras) < 2:
        raise ConfigError("a target needs two views or more, because one of them is held out; give more views")
    scene, cameras = of_unit_size(scene, cameras)
    trained, held_out = split(cameras)
    tolerated = 1e-3 * (10 ** (drop / 10) - 1)  # mean squared error
    n, before = sanitise(scene.gaussians).gaussians.num_gaussians, 0.0
    curve: list[tuple[int, float]] = []
    while n > 16:
        pruned = prune_with_mask(scene, None, n // 2, trained, rule, progress=progress).scene
        psnr = measure(pruned, scene, held_out, head=False).psnr
        curve.append((n // 2, psnr))
        error = 10 ** (-psnr / 10)
        if error > tolerated:
            # The error is about a power of the count, so a straight line in its logarithm; from no error it is not.
            scale = math.log if before else float
            low, aim, high = (scale(max(value, 1e-10 if before else 0.0)) for value in (before, tolerated, error))
            return math.ceil(n * (n // 2 / n) ** ((aim - low) / (high - low))), curve
        n, before = n // 2, error
    return n, curve


def crop(scene: Scene, low: AnyArray, high: AnyArray) -> Scene:
    """The Gaussians whose centres are in a box, its faces included; everything else of the scene stays.

    Args:
        scene: to cut; it does not change.
        low, high: lowest and highest x, y and z of the box, in the coordinates of the scene's file.

    Raises:
        ConfigError: the box is empty or not finite.
        DataError: no Gaussian is in the box.

    >>> import torch, sundae_ns as sn
    >>> scene = sn.Scene.from_points(torch.rand(200, 3), torch.rand(200, 3))
    >>> sn.crop(scene, (0, 0, 0), (1, 1, 2)).num_gaussians
    200
    """
    return scene[crop_mask(scene, low, high)]


def remove_floaters(
    scene: Scene, strength: float = STRENGTH, *, cameras: Camera | Iterable[Camera] | None = None
) -> Scene:
    """The scene without what floats or is not seen.

    Args:
        scene: to clean; it does not change.
        strength: from 0, only what is certain to float, to 1, all that may; see :func:`.floater_odds`.
        cameras: cameras of the photographs; by default those stored with the scene. Without any, neighbours decide.

    Raises:
        ConfigError: the strength is not from 0 to 1.
        DataError: no Gaussian is finite, or the cameras see none.

    >>> import torch, sundae_ns as sn
    >>> scene = sn.Scene.from_points(torch.rand(2000, 3), torch.full((2000, 3), 0.5))
    >>> sn.remove_floaters(scene).num_gaussians > 1900
    True
    """
    return scene[~floater_mask(scene, scene.cameras if cameras is None else usable_cameras(cameras), strength)]


def within(mask: Tensor | None, inner: Tensor) -> Tensor:
    """Apply a mask ``inner`` ``[M]`` to the M true entries of a mask ``[N]``; None stands for all true."""
    if mask is None:
        return inner
    narrowed = mask.clone()
    narrowed[mask] = inner
    return narrowed


def crop_mask(scene: Scene, low: AnyArray, high: AnyArray) -> Tensor:
    """True for the Gaussians in a box, bool ``[N]``; arguments and errors as for :func:`crop`."""
    # In float64, which is exact, and holds survey coordinates.
    means = scene.gaussians["means"].detach().double()
    means = means + means.new_tensor(scene.offset or (0.0, 0.0, 0.0))
    lowest, highest = (numbers(corner, "a corner of the box", (3,)).to(means.device) for corner in (low, high))
    if not bool((lowest < highest).all()):
        raise ConfigError("the box is empty; give its lowest x y z first, then its highest")
    inside = ((means >= lowest) & (means <= highest)).all(dim=1)
    if not bool(inside.any()):
        finite = means[means.isfinite().all(dim=1)].cpu().numpy()
        if not len(finite):
            raise DataError("no Gaussian is in the box, because none is finite; export the scene again")
        digits, ends = 3 if scene.offset is None else 10, np.quantile(finite, (0.05, 0.95), axis=0)
        corners = (" ".join(f"{value:.{digits}g}" for value in corner) for corner in ends)
        raise DataError(f"no Gaussian is in the box; most of them lie between {' and '.join(corners)}")
    return inside


def for_cleaning(cameras: Sequence[Camera]) -> list[Camera]:
    """The cameras with images of at most 512 pixels a side, which tell what is seen at all."""
    return [camera.zoomed(min(512 / max(camera.width, camera.height), 1.0)) for camera in cameras]


@torch.no_grad()
def floater_mask(
    scene: Scene, cameras: Sequence[Camera], strength: float = STRENGTH, console: Console | None = None
) -> Tensor:
    """True for floaters, bool ``[N]``; arguments and errors as for :func:`remove_floaters`."""
    if not 0 <= strength <= 1:
        raise ConfigError(f"the strength of remove-floaters is {strength}; give 0 (careful) to 1 (thorough)")
    sanitised = sanitise(scene.gaussians)
    if not sanitised.gaussians.num_gaussians:
        raise DataError("no Gaussian is finite; export the scene again")
    floats = floater_odds(sanitised.gaussians) > 6.5 - 5 * strength  # logarithms
    if cameras:
        usable = dataclasses.replace(scene, gaussians=sanitised.gaussians)
        floats |= weights_in(usable, for_cleaning(cameras), console=console) <= 0
    return ~within(sanitised.mask, ~floats)
