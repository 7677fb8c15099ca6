"""Pruning of a scene by what views see of it, without photographs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from rich.console import Console
from rich.progress import Progress
from torch import Tensor

from sundae_ns.core.camera import Camera
from sundae_ns.core.errors import ConfigError, DataError
from sundae_ns.core.gaussians import Gaussians, sanitise
from sundae_ns.pruning.decision import prune_gaussians
from sundae_ns.pruning.rule import PruneRule, kept_count
from sundae_ns.rasterize.interface import rasterize_cameras
from sundae_ns.scene.optimise import optimise
from sundae_ns.scene.render import GaussianSource, RenderSettings, TrainingCamera, contribution, pass_inputs
from sundae_ns.scene.scene import Scene, measure
from sundae_ns.scene.virtual_cameras import by_device, of_unit_size, resized, size_of, split, virtual_cameras

REFIT_STEPS, REFIT_VIEWS = {"cpu": 64, "cuda": 128}, 4
"""Steps of a refit by the device, and the views of each."""
REFIT_PIXELS = 512 * 512
"""Most pixels of a view of a refit; larger ones are rendered smaller."""
DEFAULT_RULE = PruneRule(selection="pairs")
"""Merges the pairs whose images differ least. Without training it loses less than the draws of ``ns-train sundae``."""


class PrunedScene(NamedTuple):
    """A pruned scene, and what it keeps."""

    scene: Scene
    mask: Tensor
    """True for kept Gaussians of the scene before the prune, bool ``[N]``."""
    seen: float | None = None
    """Share of the finite Gaussians that the views see; None if no view was asked."""


def prune(
    scene: Scene,
    *,
    keep: float | None = None,
    count: int | None = None,
    cameras: Sequence[Camera] | None = None,
    rule: PruneRule | None = None,
    progress: bool = False,
) -> Scene:
    """Keep the Gaussians that matter most to the views, and merge the others into them.

    Gaussians with NaN, or infinite values without a meaning, are dropped first. An opacity of 1, a width of 0 and the
    like become finite. After a merge by pairs, a few steps fit the kept ones to the scene's own images of the views.

    Args:
        scene: to prune; it does not change.
        keep: share of the finite Gaussians to keep, in (0, 1].
        count: number of Gaussians to keep, in place of a share; at least 1.
        cameras: cameras whose images the prune preserves; by default those stored with the scene, else
            :func:`sundae_ns.virtual_cameras`.
        rule: score, selection and merge; by default :data:`DEFAULT_RULE`.
        progress: show a progress bar on stderr.

    Returns:
        A scene of ``round(keep * N)`` or ``count`` Gaussians, on the same device. It keeps the head, which was
        trained for the fuller field.

    Raises:
        ConfigError: neither or both of ``keep`` and ``count`` are given, or they or an option are out of range.
        DataError: no Gaussian is finite, or the views see none.

    >>> import torch, sundae_ns as sn
    >>> scene = sn.Scene.from_points(torch.rand(200, 3), torch.rand(200, 3))
    >>> sn.prune(scene, keep=0.1, cameras=sn.virtual_cameras(scene, 4, size=32)).num_gaussians
    20
    """
    return prune_with_mask(scene, keep, count, cameras, rule, progress=progress).scene


def check_amount(keep: float | None, count: int | None) -> None:
    """Raise ``ConfigError`` unless one of the two is given, and is in its range."""
    if (keep is None) == (count is None):
        raise ConfigError("prune needs either keep (a share) or count (a number of Gaussians); give one of them")
    if keep is not None and not 0 < keep <= 1:
        raise ConfigError(f"keep is {keep}; give a share in (0, 1], 0.1 to keep a tenth")
    if count is not None and count < 1:
        raise ConfigError(f"count is {count}; give 1 or more Gaussians")


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
) -> PrunedScene:
    """As :func:`prune`, with the mask of the kept Gaussians.

    Args:
        fit: whether to fit merged Gaussians; a training that follows learns more from those that are not.
    """
    check_amount(keep, count)
    rule, sanitised = rule or DEFAULT_RULE, sanitise(scene.gaussians)
    n = sanitised.gaussians.num_gaussians
    if keep is not None:
        count = kept_count(keep, n)
    assert count is not None
    usable = dataclasses.replace(scene, gaussians=sanitised.gaussians)
    console = Console(stderr=True) if progress else None
    weights = None
    if rule.uses_contribution and count < n:
        given = cameras if cameras is not None else scene.cameras or virtual_cameras(usable)
        weights = weights_in(usable, given, count if rule.uses_detail else None, console)
    pruned = prune_gaussians(sanitised.gaussians, rule, count, weights)
    small = dataclasses.replace(scene, gaussians=pruned.gaussians)
    if weights is not None and rule.refits and fit:
        size, (full, scaled) = size_of(usable), of_unit_size(usable, given)
        scaled = [camera.to(scene.device) for camera in scaled]
        gaussians = resized(small, 1 / size).gaussians
        fitted = refit(gaussians, full.gaussians, scaled, scene.settings(head=False), seed=rule.seed, console=console)
        small = dataclasses.replace(
            scene, gaussians=resized(dataclasses.replace(scene, gaussians=fitted), size).gaussians
        )
    mask = sanitised.mask.clone()
    mask[sanitised.mask] = pruned.decision.mask
    return PrunedScene(small, mask, None if weights is None else float((weights > 0).float().mean()))


def weights_in(
    scene: Scene, cameras: Sequence[Camera], count: int | None = None, console: Console | None = None
) -> Tensor:
    """Blending weight of each Gaussian of a finite scene, summed over the pixels of views ``[N]``.

    Args:
        count: weight pixels by the detail that so many Gaussians cannot show; None for no weights of pixels.
        console: shows a progress bar; None for none.

    Raises:
        DataError: the views see none.
    """
    sized, scaled = of_unit_size(scene, cameras)
    weights = contribution(
        GaussianSource(sized.gaussians),
        [TrainingCamera(camera.to(scene.device), None) for camera in scaled],
        scene.background,
        scene.settings(head=False),
        count=count,
        console=console,
    )
    if not bool((weights > 0).any()):
        raise DataError(
            f"{len(scaled)} views see none of {scene.num_gaussians:,} Gaussians; "
            "give cameras that look at the scene, or export it again"
        )
    return weights


@torch.no_grad()
def refit(
    small: Gaussians,
    full: Gaussians,
    cameras: Sequence[Camera],
    settings: RenderSettings,
    *,
    seed: int = 0,
    console: Console | None = None,
) -> Gaussians:
    """Fit centres, shapes, opacities and base colours of a field to the images of a fuller one.

    A merge keeps moments, not images: groups overlap, and hide what was behind them. Adam's steps (Kingma and Ba, 2015)
    lower the squared error of the blended colours and of the accumulation, over a few views each, as in training.

    Args:
        small: the field to fit, finite; it does not change.
        full: the field whose images are to be matched, on the same device.
        cameras: cameras, on the device of the fields; of many, :data:`REFIT_STEPS` times :data:`REFIT_VIEWS` take part.
        settings: how images are made.
        seed: of the order of the views.
        console: shows a progress bar; None for none.

    Returns:
        A field of as many Gaussians. It is ``small`` if the refit matches no better.
    """
    device = small["means"].device
    cameras = [camera.zoomed(min(1.0, math.sqrt(REFIT_PIXELS / (camera.width * camera.height)))) for camera in cameras]
    order = torch.randperm(len(cameras), generator=torch.Generator().manual_seed(seed)).tolist()
    # Eight views that no step uses judge, if there are twice as many.
    judges, trained = (order[:8], order[8:]) if len(order) >= 16 else (order, order)
    images: dict[int, Tensor] = {}
    size = small["scales"].exp().sort(dim=1).values[:, 1:].mean(dim=1, keepdim=True)
    # The rates are the size of the first steps, for a prune to 15% or fewer; with more Gaussians less is left to fit.
    rates = {"means": 0.014, "scales": 0.007, "quats": 0.007, "opacities": 0.035, "features_dc": 0.014}
    gentle = min(1.0, 0.15 * full.num_gaussians / small.num_gaussians)
    moved = {name: torch.zeros_like(small[name], requires_grad=True) for name in rates}
    groups = [{"params": [moved[name]], "lr": gentle * rate} for name, rate in rates.items()]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15)

    def fitted() -> Gaussians:
        """The field with its changes; centres move in sizes of their Gaussian."""
        return small.replaced({n: small[n] + (size * step if n == "means" else step) for n, step in moved.items()})

    def error(gaussians: Gaussians, chosen: Sequence[int]) -> Tensor:
        """Sum of the mean squared errors of some views."""
        new = [i for i in dict.fromkeys(chosen) if i not in images]
        with torch.no_grad():
            images.update(zip(new, _blended(full, [cameras[i] for i in new], settings), strict=True))
        rendered = zip(_blended(gaussians, [cameras[i] for i in chosen], settings), chosen, strict=True)
        return torch.stack([(image - images[i]).square().mean() for image, i in rendered]).sum()

    def step(i: int) -> None:
        chosen = [trained[k % len(trained)] for k in range(i * REFIT_VIEWS, (i + 1) * REFIT_VIEWS)]
        for some in [chosen] if device.type == "cuda" else [[k] for k in chosen]:  # a GPU takes small images together
            with torch.enable_grad():
                error(fitted(), some).backward()
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)

    steps = by_device(REFIT_STEPS, device)
    with Progress(transient=True, console=console, disable=console is None) as progress:
        task = progress.add_task("Refit of Gaussians", total=steps)
        optimise(
            step,
            {"field": optimizer},
            steps,
            lambda _, i: 1 - i / steps,
            on_step=lambda done: progress.update(task, completed=done),
        )
    gaussians = fitted()
    before, after = (error(each, judges) for each in (small, gaussians))
    return gaussians if bool(after < before) else small  # also if the fitted field is not finite


def _blended(gaussians: Gaussians, cameras: Sequence[Camera], settings: RenderSettings) -> list[Tensor]:
    """Blended colours and accumulation of each view, without background ``[H, W, 4]``."""
    if len({(camera.width, camera.height) for camera in cameras}) > 1:
        return [image for camera in cameras for image in _blended(gaussians, [camera], settings)]
    if not cameras:
        return []
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

    The field is pruned to a half, a quarter and so on, until every eighth view, held out, is too different from the
    full field's. The error adds to that of the full field against photographs, which is taken to be that of 30 dB.

    Raises:
        ConfigError: ``drop`` is out of range, or there are fewer than two views.
        DataError: no Gaussian is finite.
    """
    if not 0 < drop < 100:
        raise ConfigError(f"target-drop is {drop}; give a positive number of dB, 0.5 for half a decibel")
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
