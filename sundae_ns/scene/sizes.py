"""A scene in a file of a given size, by the number of Gaussians and by how exactly the file states them.

What a file holds is a trade: more Gaussians, or more bits for each. So a few :class:`Form` are tried, each with as many
Gaussians as fit by a sample, and the one whose images are nearest to those of the full scene is taken. Contributions
and the graph are computed once. What is taken is then fitted, and rounded or counted to the size.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import torch
from rich.console import Console

from sundae_ns.core.camera import Camera
from sundae_ns.core.errors import ConfigError
from sundae_ns.core.gaussians import Gaussians
from sundae_ns.core.tables import MEGABYTE
from sundae_ns.io.pack.config import COARSEST, FINEST, PackConfig, scaled
from sundae_ns.pruning.merge import gaussian_graph
from sundae_ns.pruning.rule import PruneRule
from sundae_ns.scene.prune_scene import PrunedScene, at_most, prune_with_mask, weights_in
from sundae_ns.scene.scene import Scene, measure, render
from sundae_ns.scene.virtual_cameras import split

SAMPLED = 64, 8192  # random Gaussians of two files, which tell the bytes of each more one
LEAST, AIM = 0.97, 0.985  # shares of the size: what is near enough, and what each file aims at
POWER_PER_HALVING = 2.2  # of the steps of a pack; the first guess of a search
JUDGES, PIXELS = 8, 1 << 16  # cameras that compare candidates, and most pixels of their images
MOST_FILES = 8  # of the last search


class Form(NamedTuple):
    """How a file states Gaussians."""

    degree: int  # Most SH degree
    power: float = 0.0  # Steps of a pack: powers of two of the usual ones

    @property
    def precision(self) -> PackConfig:
        """That of a pack."""
        return scaled(PackConfig(), self.power)


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
    cameras: Sequence[Camera],
    rule: PruneRule,
    *,
    progress: bool = False,
) -> tuple[PrunedScene, Form]:
    """The scene and the form of a file of 97 to 100% of ``most`` bytes; of fewer if that is all.

    The scene is finite. Every eighth of the ``cameras`` compares the forms. ``progress`` shows bars and remarks on
    stderr. ``ConfigError`` if hardly a Gaussian fits.
    """
    n, packs = scene.num_gaussians, len({form.power for form in forms}) > 1
    order = torch.randperm(n, generator=torch.Generator().manual_seed(0)).to(scene.device)
    with TemporaryDirectory() as folder:

        def bytes_of(pruned: PrunedScene, form: Form) -> int:
            return write(pruned, form, Path(folder))

        def rows(count: int) -> PrunedScene:
            mask = torch.zeros(n, dtype=torch.bool, device=scene.device).index_fill_(0, order[:count], True)
            return PrunedScene(scene[mask], mask)

        def sampled(form: Form) -> tuple[float, float]:
            """Bytes of no Gaussian, and of each."""
            few, many = (min(n, count) for count in SAMPLED)
            first, second = bytes_of(rows(few), form), bytes_of(rows(many), form)
            each = (second - first) / (many - few) if many > few else first / n
            return first - few * each, each

        lines = [sampled(form) for form in forms]
        # Sparser Gaussians take more bytes each, so the whole scene takes at most about this.
        if lines[0][0] + n * lines[0][1] <= most and (size := bytes_of(whole := rows(n), forms[0])) <= most:
            form, size = _rounded(whole, forms[0], size, most, bytes_of) if packs else (forms[0], size)
            if size < LEAST * most and progress:
                print(f"the whole scene takes {size / MEGABYTE:.2f} MB, less than was asked for", file=sys.stderr)
            return whole, form
        counts = [min(n, int((AIM * most - fixed) / each)) for fixed, each in lines]
        possible = [i for i, count in enumerate(counts) if count > 0]
        if not possible:
            raise ConfigError(f"a file without Gaussians has {lines[-1][0]:,.0f} bytes; give more than {most:,}")
        weights, graph = None, gaussian_graph(scene.gaussians, rule) if rule.uses_graph and n > 1 else None
        if rule.uses_contribution:
            console = Console(stderr=True) if progress else None
            middle = max(sorted(counts)[len(counts) // 2], 1)
            weights = weights_in(scene, cameras, middle if rule.uses_detail else None, console)

        @cache
        def cut(count: int, fit: bool = False) -> PrunedScene:
            options = {"progress": progress, "fit": fit, "weights": weights, "graph": graph}
            return prune_with_mask(scene, None, count, cameras, rule, **options)  # type: ignore[arg-type]

        best = possible[0]
        if len(possible) > 1:
            judges = [at_most(camera, PIXELS) for camera in (split(cameras)[1] or list(cameras))[:JUDGES]]
            images, as_read = [render(scene, camera).rgb for camera in judges], _as_packed if packs else stated
            best = max(possible, key=lambda i: measure(as_read(cut(counts[i]).scene, forms[i]), images, judges).psnr)
        fixed, form, count = lines[best][0], forms[best], counts[best]
        if packs:
            pruned = cut(count, fit=True)
            return pruned, _rounded(pruned, form, bytes_of(pruned, form), most, bytes_of)[0]
        for fit in (False, True):  # a fit hardly changes the bytes, so it begins with a count that fits without
            low, high, chosen = 0, n, None
            for _ in range(MOST_FILES):
                size = bytes_of(pruned := cut(count, fit), form)
                if size <= most:
                    low, chosen = count, pruned
                else:
                    high = count - 1
                if LEAST * most <= size <= most or low >= high:
                    break
                count = min(max(int(count * (AIM * most - fixed) / (size - fixed)), low + 1), high)
            if chosen is None:
                raise ConfigError(f"a file of {count:,} Gaussians has {size:,} bytes; give more than {most:,}")
            count = low
    assert chosen is not None
    return chosen, form


def _as_packed(scene: Scene, form: Form) -> Scene:
    """The scene as a reader of its pack sees it."""
    from sundae_ns.io.pack.packed_scene import fit_scene  # its encoder needs a compiler, which other files do not
    from sundae_ns.scene.packing import contents_of

    packed, codecs = fit_scene(contents_of(scene), form.precision)
    gaussians = Gaussians(codecs.rounded(packed.gaussians), scene.gaussians.encoding)
    return dataclasses.replace(scene, gaussians=gaussians).to(scene.device)


def _rounded(
    pruned: PrunedScene, form: Form, size: int, most: int, bytes_of: Callable[[PrunedScene, Form], int]
) -> tuple[Form, int]:
    """The form with the finest steps of a pack whose file has at most ``most`` bytes, and its bytes."""
    low, high, best, slope = FINEST, COARSEST, None, POWER_PER_HALVING
    for _ in range(MOST_FILES):
        if size <= most:
            high, best = form.power, (form, size)
        else:
            low = form.power
        if LEAST * most <= size <= most or high - low < 0.01:
            break
        guess = min(max(form.power + slope * math.log2(size / (AIM * most)), FINEST), COARSEST)
        power, before = guess if low <= guess <= high and guess != form.power else (low + high) / 2, size
        size = bytes_of(pruned, form._replace(power=power))
        slope = max((power - form.power) / (math.log2(before / size) or 1.0), 0.5)
        form = form._replace(power=power)
    if best is None:
        raise ConfigError(f"a file of {len(pruned.scene):,} Gaussians has {size:,} bytes; give more than {most:,}")
    return best
