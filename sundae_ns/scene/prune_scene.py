"""Pruning of a scene by what cameras see of it, without photographs, also to a size.

A file of a given size holds more Gaussians, or more bits for each. :func:`prune_to_bytes` takes the :class:`Form` whose
images are nearest to the full scene's. It fits the Gaussians, then adjusts their rounding or their number to the size.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import cache, partial
from typing import Any, NamedTuple, TypeVar

import torch
from rich.console import Console
from rich.progress import Progress
from torch import Tensor

from sundae_ns.core.camera import Camera
from sundae_ns.core.errors import ConfigError, DataError
from sundae_ns.core.gaussians import MAX_SH_DEGREE, Gaussians, sanitise
from sundae_ns.core.tables import MEGABYTE
from sundae_ns.core.values import numbers, whole
from sundae_ns.cuda.adam import Update, adam_step
from sundae_ns.graph.graph import NeighborGraph
from sundae_ns.io.pack.config import COARSEST, FINEST, PackConfig, scaled
from sundae_ns.pruning.decision import prune_gaussians
from sundae_ns.pruning.merge import gaussian_graph
from sundae_ns.pruning.rule import PruneRule, kept_count
from sundae_ns.rasterize.interface import rasterize_cameras
from sundae_ns.scene.render import GaussianSource, RenderSettings, contribution, pass_inputs
from sundae_ns.scene.scene import Scene, measure, render, usable_cameras, within
from sundae_ns.scene.virtual_cameras import at_most, by_device, of_unit_size, resized, split, virtual_cameras

REFIT = {"cpu": (192, 1, 0.7), "cuda": (128, 4, 1.0)}  # steps of a refit, images of each, and factor of its rates
REFIT_PIXELS, MOST_PIXELS = 1 << 18, 1 << 22  # most pixels of an image of a refit, and of one that measures visibility
SAMPLED = 64, 8192  # random Gaussians of two files, whose difference gives the bytes of each
LEAST, AIM, FILES = 0.97, 0.985, 8  # least share of a size, the aim of each file, and most files of a search
JUDGES, PIXELS = 8, 1 << 16  # cameras that compare fits and forms, and most pixels of their images for forms
T = TypeVar("T")


class PrunedScene(NamedTuple):
    """A pruned scene, and what it keeps."""

    scene: Scene
    mask: Tensor  # True for kept Gaussians of the scene before the prune, bool [N]
    seen_share: float | None = None  # of the finite Gaussians, those that the cameras see; None if none was asked
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
    """As :func:`prune`, with the mask of the kept Gaussians; without ``fit``, what follows fits them.

    ``weights`` (:func:`weights_in`) and ``graph`` of the finite Gaussians, if given, are not made anew.
    """
    if (keep is None) == (count is None):
        raise ConfigError("prune needs either keep (a share) or count (a number of Gaussians); give one of them")
    if keep is not None and not 0 < (keep := float(numbers(keep, "keep", ()))) <= 1:
        raise ConfigError(f"keep is {keep}; give a share in (0, 1], 0.1 to keep a tenth")
    rule = rule or PruneRule()
    sanitised = sanitise(scene.gaussians)
    usable = dataclasses.replace(scene, gaussians=sanitised.gaussians)
    count = whole(count, "count") if keep is None else kept_count(keep, len(usable))
    console = Console(stderr=True) if progress and sys.stderr.isatty() else None
    images: list[Tensor] = []
    if not rule.uses_contribution or count >= len(usable):
        weights = None
    elif weights is None:
        cameras = cameras if cameras is not None else scene.cameras or virtual_cameras(usable)
        weights = weights_in(usable, cameras, count if rule.uses_detail else None, console, images if fit else None)
    cut = prune_gaussians(sanitised.gaussians, rule, count, weights, graph)
    small = dataclasses.replace(scene, gaussians=cut.gaussians)
    share = None if weights is None else float((weights > 0).float().mean())
    moved = rule.redistribution == "merge" and count < len(usable)
    pruned = PrunedScene(small, within(sanitised.mask, cut.decision.mask), share, moved)
    return fitted(pruned, usable, cameras or (), rule, images=images, console=console) if fit else pruned


def fitted(pruned: PrunedScene, full: Scene, cameras: Sequence[Camera], rule: PruneRule, **options: Any) -> PrunedScene:
    """A pruned scene, fitted to the images of the finite scene ``full`` by :func:`refit`, if the rule asks for it."""
    if pruned.seen_share is None or not rule.refits:
        return pruned
    unit, scaled, size = of_unit_size(full, cameras)
    small, settings = resized(pruned.scene.gaussians, 1 / size), unit.settings(head=False)
    small = refit(small, unit.gaussians, scaled, settings, seed=rule.seed, **options)
    return pruned._replace(scene=dataclasses.replace(pruned.scene, gaussians=resized(small, size)))


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
    sized, scaled, _ = of_unit_size(scene, [at_most(camera, MOST_PIXELS) for camera in cameras])
    views = [(camera, None) for camera in scaled]
    source, settings = GaussianSource(sized.gaussians), sized.settings(head=False)
    weights = contribution(source, views, scene.background, settings, count, images=images, console=console)
    if not bool((weights > 0).any()):
        raise DataError(f"{len(scaled)} views see none of {len(scene):,} Gaussians; give others, or export it again")
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

    A merge keeps moments, not images. Adam's steps (Kingma and Ba, 2015) lower the squared error of blended colours and
    accumulation, over a few images each, in an order by ``seed``; ``images`` ``[H, W, 4]`` are those of ``full``.
    Returns ``small`` if it matches no worse.
    """
    steps, views, factor = by_device(REFIT, small["means"].device)
    cameras = [at_most(camera, REFIT_PIXELS) for camera in cameras]
    order = torch.randperm(len(cameras), generator=torch.Generator().manual_seed(seed)).tolist()
    # Cameras that no step uses judge, if there are twice as many.
    judges, trained = (order[:JUDGES], order[JUDGES:]) if len(order) >= 2 * JUDGES else (order, order)
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
        return torch.stack([torch.nn.functional.mse_loss(image, truths[i].to(image)) for image, i in rendered]).sum()

    with Progress(transient=True, console=console, disable=console is None) as progress:
        for i in progress.track(range(steps), description="Refit of Gaussians"):
            with torch.enable_grad():
                loss = error(fitted(), [trained[k % len(trained)] for k in range(i * views, (i + 1) * views)])
            # Not by torch.optim, which imports a compiler for two seconds.
            rows = zip(moved.values(), torch.autograd.grad(loss, list(moved.values())), running, strict=True)
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
    channels = torch.cat([colors, torch.ones_like(colors[..., :1])], dim=2)  # ones blend to the accumulation
    inputs = pass_inputs(primitives[0], cameras[0], settings, channels)
    viewmats, Ks = torch.stack([camera.viewmat for camera in cameras]), torch.stack([camera.K for camera in cameras])
    return list(rasterize_cameras(inputs, viewmats, Ks, backend=settings.backend))


def count_for_drop(
    scene: Scene, drop: float, cameras: Sequence[Camera], rule: PruneRule
) -> tuple[int, list[tuple[int, float]]]:
    """The fewest Gaussians whose images lose at most ``drop`` dB, with the PSNR (dB) by counts that it follows from.

    The scene is pruned to a half, a quarter and so on, until every eighth camera, held out, sees too much difference.
    The error adds to that of the full scene against photographs, which is taken to be that of 30 dB.
    """
    if len(cameras) < 2:
        raise ConfigError("a target needs two views or more, because one of them is held out; give more views")
    trained, held_out = split(cameras)
    tolerated = 1e-3 * (10 ** (drop / 10) - 1)  # mean squared error
    n, before = sanitise(scene.gaussians).gaussians.num_gaussians, 0.0
    curve: list[tuple[int, float]] = []
    while n > 16:
        pruned = prune_with_mask(scene, None, n // 2, trained, rule, progress=True).scene
        psnr = measure(pruned, scene, held_out, head=False).psnr
        curve.append((n // 2, psnr))
        if (error := 10 ** (-psnr / 10)) > tolerated:
            # The error is about a power of the count, so a straight line in its logarithm; from no error it is not.
            scale = math.log if before else float
            low, aim, high = (scale(max(value, 1e-10 if before else 0.0)) for value in (before, tolerated, error))
            return math.ceil(n * (n // 2 / n) ** ((aim - low) / (high - low))), curve
        n, before = n // 2, error
    return n, curve


class Form(NamedTuple):
    """The form in which a file states Gaussians."""

    degree: int = MAX_SH_DEGREE  # Most SH degree
    power: float = 0.0  # Steps of a pack: powers of two of the usual ones

    @classmethod
    def choices(cls, scene: Scene, suffix: str) -> list[Form]:
        """Forms to choose from, the most exact first: packs have steps, other files a degree of harmonics."""
        degree = scene.gaussians.sh_degree
        if suffix in (".sundae", ".html", ""):  # a page may be a folder
            return [cls(degree, power) for power in (0.0, 0.75, 1.5)]
        return [cls(each) for each in sorted({degree, min(degree, 1), 0}, reverse=True)]

    @property
    def precision(self) -> PackConfig:
        """Options of a pack with these steps."""
        return scaled(PackConfig(), self.power)

    def of(self, scene: Scene) -> Scene:
        """The scene without the harmonics above the degree."""
        rest = scene.gaussians["features_rest"][:, : (self.degree + 1) ** 2 - 1]
        return dataclasses.replace(scene, gaussians=scene.gaussians.replaced({"features_rest": rest}))


def prune_to_bytes(
    scene: Scene,
    most: int,
    write: Callable[[PrunedScene, Form], bytes],
    forms: Sequence[Form],
    cameras: Sequence[Camera],
    rule: PruneRule,
) -> tuple[PrunedScene, Form, bytes]:
    """The scene, the form and the content of a file of 97 to 100% of ``most`` bytes; of fewer if that is all.

    The scene is finite; ``write`` makes the content. Every eighth of the ``cameras`` compares the forms. Bars and
    remarks go to stderr. ``ConfigError`` if hardly a Gaussian fits.
    """
    n = scene.num_gaussians
    file_of = cache(write)
    packs = len({form.power for form in forms}) > 1

    def bytes_of(pruned: PrunedScene, form: Form) -> int:
        return len(file_of(pruned, form))

    def rounded(pruned: PrunedScene, form: Form) -> tuple[PrunedScene, Form, bytes]:
        if packs:
            form = largest(lambda power: form._replace(power=power), partial(bytes_of, pruned), most, form.power)
        return pruned, form, file_of(pruned, form)

    unpruned = PrunedScene(scene, torch.ones(n, dtype=torch.bool, device=scene.device))
    lines = [_bytes_by_count(scene, partial(bytes_of, form=form)) for form in forms]
    # Sparser Gaussians take more bytes each, so the whole scene takes at most about this.
    if lines[0][0] + n * lines[0][1] <= most and bytes_of(unpruned, forms[0]) <= most:
        left = rounded(unpruned, forms[0])
        if len(left[2]) < LEAST * most:
            print(f"the whole scene takes {len(left[2]) / MEGABYTE:.2f} MB, less than was asked for", file=sys.stderr)
        return left
    bare = lines[-1]
    if scene.head is not None:
        bare = _bytes_by_count(dataclasses.replace(scene, head=None), partial(bytes_of, form=forms[-1]))
    *counts, more = (min(n, int((AIM * most - fixed) / each)) for fixed, each in (*lines, bare))
    if 4 * (head := lines[-1][0] - bare[0]) > most - bare[0] and more > max(counts[-1], 0):
        said = f"the head takes {head:,.0f} of {most:,} bytes; with --no-head about {more:,} Gaussians fit in place of"
        if counts[-1] < 1:
            raise ConfigError(f"{said} none")
        print(f"{said} {counts[-1]:,}", file=sys.stderr)
    if counts[-1] < 1:
        raise ConfigError(f"a file without Gaussians has {lines[-1][0]:,.0f} bytes; ask for more than {most:,}")
    console = Console(stderr=True) if sys.stderr.isatty() else None
    images: list[Tensor] = []
    graph = gaussian_graph(scene.gaussians, rule) if rule.uses_graph and n > 1 else None
    middle = max(sorted(counts)[len(counts) // 2], 1) if rule.uses_detail else None
    weights = weights_in(scene, cameras, middle, console, images) if rule.uses_contribution else None

    @cache
    def cut(count: int) -> PrunedScene:
        return prune_with_mask(scene, None, count, cameras, rule, fit=False, weights=weights, graph=graph)

    if packs and counts[0] > 0:  # more fit where they are much denser than those that were counted
        size = bytes_of(cut(counts[0]), forms[0])
        counts = [min(n, int(count * AIM * most / size)) for count in counts]
        if 2 * counts[0] > n and bytes_of(unpruned, forms[0]) <= most:
            return rounded(unpruned, forms[0])
    candidates = ((form, cut(count)) for form, count in zip(forms, counts, strict=True) if count > 0)
    form, pruned = next(candidates) if len(forms) == 1 else _nearest_form(scene, candidates, cameras, packs)

    @cache
    def fit(pruned: PrunedScene) -> PrunedScene:  # colours make up for the harmonics that go
        stated = pruned._replace(scene=form.of(pruned.scene), moved=pruned.moved or form != forms[0])
        return fitted(stated, scene, cameras, rule, images=images, console=console)

    def sized(change: Callable[[PrunedScene], PrunedScene], near: PrunedScene) -> PrunedScene:
        """The scene with as many Gaussians as fit after a ``change``; the search begins ``near`` it."""
        halvings, size = math.log2(n / len(near.scene)), partial(bytes_of, form=form)
        powers = (0.0, math.log2(n))
        return largest(lambda power: change(cut(max(round(n / 2**power), 1))), size, most, halvings, powers, 1.0)

    # A fit hardly changes the bytes, so its search begins with a count that fits without.
    return rounded(fit(pruned) if packs else sized(fit, sized(lambda pruned: pruned, pruned)), form)


def _bytes_by_count(scene: Scene, bytes_of: Callable[[PrunedScene], int]) -> tuple[float, float]:
    """Bytes of a file of no Gaussian, and of each one, by two files of random ones."""
    ranks = torch.randperm(scene.num_gaussians, generator=torch.Generator().manual_seed(0)).argsort().to(scene.device)
    few, many = (ranks < count for count in SAMPLED)
    first, second = (bytes_of(PrunedScene(scene[mask], mask)) for mask in (few, many))
    each = (second - first) / max(int(many.sum() - few.sum()), 1) or first / len(scene)
    return first - int(few.sum()) * each, each


def _nearest_form(
    scene: Scene, candidates: Iterable[tuple[Form, PrunedScene]], cameras: Sequence[Camera], packs: bool
) -> tuple[Form, PrunedScene]:
    """Of less and less exact forms with more and more Gaussians, that whose images are nearest to the scene's."""
    judges = [at_most(camera, PIXELS) for camera in (split(cameras)[1] or list(cameras))[:JUDGES]]
    truths = [render(scene, camera).rgb for camera in judges]
    as_read = _as_packed if packs else Form.of
    psnr = -math.inf
    for form, pruned in candidates:
        if (new := measure(as_read(form, pruned.scene), truths, judges).psnr) <= psnr:
            break  # more Gaussians no longer make up for it
        best, psnr = (form, pruned), new
    return best


def _as_packed(form: Form, scene: Scene) -> Scene:
    """The scene as a reader of its pack sees it."""
    from sundae_ns.io.pack.packed_scene import fit_scene  # its encoder needs a compiler, which other files do not
    from sundae_ns.scene.packing import contents_of

    packed, codecs = fit_scene(contents_of(scene), form.precision)
    gaussians = Gaussians(codecs.rounded(packed.gaussians), scene.gaussians.encoding)
    return dataclasses.replace(scene, gaussians=gaussians).to(scene.device)


def largest(
    at: Callable[[float], T],
    bytes_of: Callable[[T], int],
    most: int,
    power: float = 0.0,
    powers: tuple[float, float] = (FINEST, COARSEST),
    per_halving: float = 2.2,
) -> T:
    """The largest of some files that has at most ``most`` bytes; one of 97% is near enough.

    ``at`` makes a file, the smaller, the higher a power within ``powers``; by default of the steps of a pack. The
    search begins at ``power``; about ``per_halving`` more take half of the bytes. ``ConfigError`` if none is found.
    """
    low, high = powers
    best, before = None, None
    for _ in range(FILES):
        made = at(power)
        if (size := bytes_of(made)) <= most:
            high, best = power, made
        else:
            low = power
        if LEAST * most <= size <= most or high - low < 0.01:
            break
        if before is not None and before[1] != size:
            per_halving = max((power - before[0]) / math.log2(before[1] / size), 0.5)
        guess = min(max(power + per_halving * math.log2(size / (AIM * most)), powers[0]), powers[1])
        before, power = (power, size), guess if low <= guess <= high and guess != power else (low + high) / 2
    if best is None:
        raise ConfigError(f"the smallest file has {size:,} bytes; ask for more than {most:,}")
    return best
