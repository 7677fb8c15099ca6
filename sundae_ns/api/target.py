"""How many primitives a prune may keep for a given loss of quality, without photos."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from sundae_ns.api.measuring import measure
from sundae_ns.api.pruning import prune_with_mask
from sundae_ns.api.scene import Scene
from sundae_ns.api.virtual import of_unit_size
from sundae_ns.errors import ConfigError
from sundae_ns.gaussians import mend
from sundae_ns.pruning import PruneRule
from sundae_ns.rendering import View

USUAL_PSNR = 30.0
"""PSNR of the images of a full field against photographs that a loss counts from, dB."""
HELD_OUT_EVERY = 8
"""One view of this many measures the curve; the others decide the prunes."""
_FEWEST = 16
"""Fewest primitives of the curve."""


@dataclass(frozen=True)
class Target:
    """A count for a tolerated loss, and the curve that it was read from."""

    kept: int
    curve: list[tuple[int, float]]
    """Numbers of primitives, and the PSNR of held-out views against the full field's, dB; from many to few."""


def count_for_drop(
    scene: Scene, drop: float, views: Sequence[View], rule: PruneRule, *, progress: bool = False
) -> Target:
    """The fewest primitives whose images lose at most ``drop`` dB.

    The field is pruned to a half, a quarter and so on, until held-out views are too different from the full field's.
    The error of a prune adds to that of the full field against photographs, which is taken to be that of 30 dB.

    Args:
        scene: to prune; it does not change.
        drop: tolerated loss of PSNR, dB; above 0 and below 100.
        views: cameras; every eighth is held out.
        rule: of the prunes.
        progress: show progress bars on stderr.

    Raises:
        ConfigError: ``drop`` is out of range, or there are fewer than two views.
        DataError: no primitive is finite.
    """
    if not 0 < drop < 100:
        raise ConfigError(f"target-drop is {drop}; give a positive number of dB, 0.5 for half a decibel")
    if len(views) < 2:
        raise ConfigError("a target needs two views or more, because one of them is held out; give more views")
    scene, seen = of_unit_size(scene, views)
    shown, held_out = split(seen)
    tolerated = tolerated_error(drop)
    count = mend(scene.field).field.num_primitives
    curve: list[tuple[int, float]] = []
    before = count, 0.0
    while count > _FEWEST:
        count //= 2
        pruned = prune_with_mask(scene, None, count, shown, rule, progress=progress).scene
        psnr = measure(pruned, scene, held_out, head=False).psnr
        curve.append((count, psnr))
        error = 10 ** (-psnr / 10)
        if error > tolerated:
            # The error is about a power of the count, so a straight line in its logarithm; from no error it is not.
            low, high = (math.log(max(value, 1e-10)) for value in (before[1], error)) if before[1] else (0.0, error)
            aim = math.log(tolerated) if before[1] else tolerated
            share = (aim - low) / (high - low)
            return Target(math.ceil(before[0] * (count / before[0]) ** share), curve)
        before = count, error
    return Target(count, curve)


def split(views: Sequence[View]) -> tuple[list[View], list[View]]:
    """The views that decide, and those that are held out: every eighth, from the first on."""
    return [view for i, view in enumerate(views) if i % HELD_OUT_EVERY], list(views[::HELD_OUT_EVERY])


def tolerated_error(drop: float) -> float:
    """Mean squared error of a prune that takes ``drop`` dB from an image of :data:`USUAL_PSNR`."""
    return float(10 ** (-USUAL_PSNR / 10) * (10 ** (drop / 10) - 1))
