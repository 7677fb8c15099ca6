"""A scene in a file of a given size, by the number of Gaussians and by how exactly the file states them.

What a file holds is a trade: more Gaussians, or more bits for each. So a few :class:`Form` are tried, each with as many
Gaussians as fit, and the one whose images are nearest to those of the full scene is taken. Contributions and the graph
are computed once. What is taken is then fitted, and counted or rounded to the size.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import torch
from rich.console import Console

from sundae_ns.core.camera import Camera
from sundae_ns.core.errors import ConfigError
from sundae_ns.core.gaussians import Gaussians, sanitise
from sundae_ns.io.pack.config import COARSEST, FINEST, PackConfig, scaled
from sundae_ns.pruning.merge import gaussian_graph
from sundae_ns.pruning.rule import PruneRule
from sundae_ns.scene.prune_scene import PrunedScene, at_most, prune_with_mask, weights_in, within
from sundae_ns.scene.scene import Scene, measure, render
from sundae_ns.scene.virtual_cameras import split, virtual_cameras

SAMPLED = 64, 8192  # random Gaussians of two files, which tell the bytes of each more one
LEAST, AIM = 0.97, 0.99  # shares of the size: what is near enough, and what each file aims at
DB_PER_DOUBLING = 1.5  # by which candidates of slightly different sizes are compared
JUDGES, PIXELS = 8, 1 << 16  # cameras that compare candidates, and most pixels of their images
MOST_FILES = 8  # of the last search


class Form(NamedTuple):
    """How a file states Gaussians."""

    degree: int  # Most SH degree
    power: float = 0.0  # Steps of a pack: powers of two of the default ones


Written = Callable[[PrunedScene, Form, Path], int]  # writes a scene in a form into a folder, and returns the bytes


def forms_of(scene: Scene, suffix: str) -> list[Form]:
    """Forms to choose from, the most exact first: packs have steps, other files a degree of harmonics."""
    degree = scene.gaussians.sh_degree
    if suffix in (".sundae", ".html"):
        return [Form(degree, power) for power in (0.0, 0.75, 1.5)]
    return [Form(each) for each in sorted({degree, min(degree, 1), 0}, reverse=True)]


def stated(scene: Scene, form: Form) -> Scene:
    """The scene without the harmonics above the degree of a form."""
    rest = scene.gaussians["features_rest"][:, : (form.degree + 1) ** 2 - 1]
    return dataclasses.replace(scene, gaussians=scene.gaussians.replaced({"features_rest": rest}))


def prune_to_bytes(
    scene: Scene,
    most: int,
    write: Written,
    forms: Sequence[Form],
    cameras: Sequence[Camera] | None,
    rule: PruneRule,
    *,
    progress: bool = False,
) -> tuple[PrunedScene, Form]:
    """The scene and the form of a file of 97 to 100% of ``most`` bytes, less only where the whole scene is smaller.

    ``cameras`` as for :func:`sundae_ns.prune`; every eighth compares the forms. ``ConfigError`` if hardly a Gaussian
    fits.
    """
    sanitised = sanitise(scene.gaussians)
    usable, n = dataclasses.replace(scene, gaussians=sanitised.gaussians), sanitised.gaussians.num_gaussians
    order = torch.randperm(n, generator=torch.Generator().manual_seed(0)).to(scene.device)
    packs = len({form.power for form in forms}) > 1

    with TemporaryDirectory() as folder:

        def bytes_of(pruned: PrunedScene, form: Form) -> int:
            return write(pruned, form, Path(folder))

        def rows(count: int) -> PrunedScene:
            mask = torch.zeros(n, dtype=torch.bool, device=scene.device).index_fill_(0, order[:count], True)
            return PrunedScene(usable[mask], within(sanitised.mask, mask))

        def sampled(form: Form) -> tuple[float, float]:
            """Bytes of no Gaussian, and of each."""
            few, many = (min(n, count) for count in SAMPLED)
            first, second = bytes_of(rows(few), form), bytes_of(rows(many), form)
            each = (second - first) / (many - few) if many > few else first / n
            return first - few * each, each

        lines = [sampled(form) for form in forms]
        # Sparser Gaussians take more bytes each, so the whole scene takes at most about this.
        if lines[0][0] + n * lines[0][1] <= most and (size := bytes_of(whole := rows(n), forms[0])) <= most:
            return whole, _rounded(whole, forms[0], size, most, bytes_of) if packs else forms[0]
        counts = [min(n, int((AIM * most - fixed) / each)) for fixed, each in lines]
        if max(counts) < 1:
            raise ConfigError(f"a file without Gaussians has {lines[-1][0]:,.0f} bytes; give more than {most:,}")
        given = cameras if cameras is not None else scene.cameras or virtual_cameras(usable)
        weights, graph = None, gaussian_graph(usable.gaussians, rule) if rule.uses_graph and n > 1 else None
        if rule.uses_contribution:
            console = Console(stderr=True) if progress else None
            middle = max(sorted(counts)[len(counts) // 2], 1)
            weights = weights_in(usable, given, middle if rule.uses_detail else None, console)

        def cut(count: int, fit: bool) -> PrunedScene:
            options = {"weights": weights, "graph": graph, "progress": progress, "fit": fit}
            pruned = prune_with_mask(usable, None, count, given, rule, **options)  # type: ignore[arg-type]
            return pruned._replace(mask=within(sanitised.mask, pruned.mask))

        judges = [at_most(camera, PIXELS) for camera in (split(given)[1] or list(given))[:JUDGES]]
        images = [render(usable, camera).rgb for camera in judges]
        tried: list[tuple[float, int, int]] = []  # worth, number of the form, bytes of each Gaussian
        for i, form in enumerate(forms):
            if counts[i] < 1:
                continue
            pruned = cut(counts[i], fit=False)
            size = bytes_of(pruned, form)
            shown = _as_packed(pruned.scene, form) if packs else stated(pruned.scene, form)
            worth = measure(shown, images, judges).psnr + DB_PER_DOUBLING * min(math.log2(most / size), 1.0)
            tried.append((worth, i, size))
        _, best, size = max(tried)
        (fixed, _), form, count = lines[best], forms[best], counts[best]
        low, high, chosen = 0, n, None
        for _ in range(MOST_FILES):
            if not LEAST * most <= size <= most:
                each = (size - fixed) / count
                count = min(max(int((AIM * most - fixed) / each), low + 1, 1), high)
            pruned = cut(count, fit=True)
            size = bytes_of(pruned, form)
            if packs:
                return pruned, _rounded(pruned, form, size, most, bytes_of)
            if size <= most:
                chosen, low = pruned, count
                if size >= LEAST * most or count == n:
                    break
            else:
                high = count - 1
            if low >= high:
                break
    if chosen is None:
        raise ConfigError(f"a file of {count:,} Gaussians has {size:,} bytes; give more than {most:,}")
    return chosen, form


def _as_packed(scene: Scene, form: Form) -> Scene:
    """The scene as a reader of its pack sees it."""
    from sundae_ns.io.pack.packed_scene import fit_scene  # its encoder needs a compiler, which other files do not
    from sundae_ns.scene.packing import contents_of

    packed, codecs = fit_scene(contents_of(scene), scaled(PackConfig(), form.power))
    gaussians = Gaussians(codecs.rounded(packed.gaussians), scene.gaussians.encoding)
    return dataclasses.replace(scene, gaussians=gaussians).to(scene.device)


def _rounded(
    pruned: PrunedScene, form: Form, size: int, most: int, bytes_of: Callable[[PrunedScene, Form], int]
) -> Form:
    """The form with the finest steps of a pack whose file has at most ``most`` bytes."""
    low, high, best = (form.power, COARSEST, None) if size > most else (FINEST, form.power, form)
    if size > most and bytes_of(pruned, form._replace(power=COARSEST)) > most:
        raise ConfigError(
            f"a file of {pruned.scene.num_gaussians:,} Gaussians is larger; give more than {most:,} bytes"
        )
    power = form.power
    for _ in range(MOST_FILES):
        if LEAST * most <= size <= most:
            break
        # A bit less of each value, of about three.
        guess = power + 3 * math.log2(size / (AIM * most))
        power = guess if low < guess < high else (low + high) / 2
        size = bytes_of(pruned, form._replace(power=power))
        if size <= most:
            high, best = power, form._replace(power=power)
        else:
            low = power
        if high - low < 0.01:
            break
    return best or form._replace(power=COARSEST)
