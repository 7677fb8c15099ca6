"""Packs of a given size or quality: one factor makes all steps coarser or finer, and a bisection finds it.

The ratios between the steps come from renderings: at the defaults, one bit less of any attribute costs about the same.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import torch

from sundae_ns.core.errors import PackError, SundaeError
from sundae_ns.core.metrics import Quality, evaluate
from sundae_ns.io.pack.codecs import Codecs
from sundae_ns.io.pack.config import STEPS, PackConfig
from sundae_ns.io.pack.packed_scene import PackedScene, fit_scene, pack_bytes
from sundae_ns.plugin.finished_runs import load_model, place
from sundae_ns.train.choice import GAIN_PER_DOUBLING

FINEST, COARSEST = -3.0, 4.0  # Ends of the search: powers of two of the factor


class Judge:
    """Measures a run, and packs of it, on up to eight of its test views; arguments and errors as :func:`load_model`."""

    def __init__(self, run: Path, data: Path | None) -> None:
        opened = load_model(run, data)
        self._model, self.all_cameras = opened.model, len(opened.cameras)
        chosen = torch.linspace(0, self.all_cameras - 1, min(8, self.all_cameras)).round().long().unique().tolist()
        self.cameras = len(chosen)  # Number of test views that are measured, of all_cameras
        self._cameras, self._truths = ([each[i] for i in chosen] for each in (opened.cameras, opened.truths))
        self.before = self._quality()  # Of the run itself

    def quality(self, scene: PackedScene, codecs: Codecs) -> Quality:
        """Quality of a pack."""
        place(self._model, codecs.rounded(scene.gaussians))
        if self._model.head is not None and scene.head:
            self._model.head.load_state_dict(codecs.rounded_head(scene.head))
        return self._quality()

    def _quality(self) -> Quality:
        model = self._model
        return evaluate(lambda camera: model.get_outputs_for_camera(camera)["rgb"], self._cameras, self._truths)


def is_worth(psnr: float, size: int, other_psnr: float, other_size: int) -> bool:
    """Whether a pack of ``size`` bytes is worth more than another, by the PSNR that trials ask for a doubling."""
    return psnr >= other_psnr + GAIN_PER_DOUBLING * math.log2(size / other_size)


def scaled(config: PackConfig, power: float, *, with_positions: bool = True) -> PackConfig:
    """Options with all steps larger by 2^power, and as many fewer bits of positions, but at least 10."""
    steps = {name: min(max(getattr(config, name) * 2**power, 1e-4), 1.0) for name in STEPS}
    if with_positions:
        steps["position_bits"] = min(max(round(config.position_bits - power), 10), 16)
    return replace(config, **steps)  # type: ignore[arg-type]


class Candidate(NamedTuple):
    """One pack of the search."""

    scene: PackedScene
    codecs: Codecs
    bytes: int


class Search:
    """Packs of one scene at several factors.

    Args:
        scene: exact, or fine-tuned with the rounding of codecs.
        fit: the options at the factor 1, or the codecs of the fine-tune, whose grids and bases no factor changes.
        judge: opens the run's test views when they are first needed.
    """

    def __init__(self, scene: PackedScene, fit: PackConfig | Codecs, judge: Callable[[], Judge]) -> None:
        self.scene, self._fit, self._judge = scene, fit, judge

    @cached_property
    def default(self) -> Candidate:
        """The pack at the factor 1; of a fine-tuned scene, the one that was trained."""
        return self.at(0.0)

    def at(self, power: float) -> Candidate:
        """The pack at a factor of 2^power."""
        if isinstance(self._fit, PackConfig):
            scene, codecs = fit_scene(self.scene, scaled(self._fit, power))
        else:
            scene, codecs = self.scene, self._fit
            if power:
                config = scaled(codecs.config, power, with_positions=False)
                codecs = codecs.with_steps(config, scene.gaussians, scene.head)
        return Candidate(scene, codecs, len(pack_bytes(scene, codecs)[0]))

    def drop(self, candidate: Candidate) -> float:
        """PSNR of a pack below the run's on some test views, dB; infinite for images that are not finite."""
        judge = self._judge()
        drop = judge.before.psnr - judge.quality(candidate.scene, candidate.codecs).psnr
        return drop if math.isfinite(drop) else math.inf

    def smaller_than(self, limit: int) -> Candidate:
        """The finest pack of at most ``limit`` bytes; that at the factor 1 if it fits too and, by chance, loses less.

        ``PackError`` if even the coarsest is larger.
        """
        coarsest = self.at(COARSEST)
        if coarsest.bytes > limit:
            drop = ""
            with suppress(SundaeError):  # sizes need no capture
                drop = f" and loses {self.drop(coarsest):.2f} dB"
            raise PackError(
                f"the smallest pack has {coarsest.bytes:,} bytes{drop}; give a larger --target-bytes, or prune the run"
            )
        finest = self._bisected(lambda candidate: candidate.bytes <= limit, coarsest, COARSEST, FINEST)
        with suppress(SundaeError):
            if self.default.bytes <= limit and self.drop(self.default) < self.drop(finest):
                return self.default
        return finest

    def better_than(self, limit: float) -> Candidate:
        """The coarsest pack that loses at most ``limit`` dB, no larger than that at the factor 1 if this one fits.

        ``PackError`` if even the finest loses more.
        """

        def fits(candidate: Candidate) -> bool:
            return self.drop(candidate) <= limit

        if fits(self.default):
            coarsest = self._bisected(fits, self.default, 0.0, COARSEST)
            return min(self.default, coarsest, key=lambda candidate: candidate.bytes)
        finest = self.at(FINEST)
        if (drop := self.drop(finest)) > limit:
            raise PackError(
                f"the finest pack loses {drop:.3f} dB at {finest.bytes:,} bytes; give a larger --target-drop"
            )
        return self._bisected(fits, finest, FINEST, 0.0)

    def _bisected(self, fits: Callable[[Candidate], bool], best: Candidate, first: float, last: float) -> Candidate:
        """The fitting pack nearest to ``last``, from a fitting one at ``first``."""
        for _ in range(7):
            middle = (first + last) / 2
            candidate = self.at(middle)
            if fits(candidate):
                first, best = middle, candidate
            else:
                last = middle
        return best


def best_pack(searches: Sequence[Search], *, most_bytes: int | None = None, most_drop: float = 0.0) -> Candidate:
    """The pack that loses least in at most ``most_bytes``, or else the smallest that loses at most ``most_drop`` dB.

    The searches are of one run, the preferred one last; ``PackError`` if none meets the limit.
    """
    packs, failure = list[tuple[Search, Candidate]](), PackError("there is no pack")
    for search in searches if most_bytes is not None else reversed(searches):
        try:
            pack = search.better_than(most_drop) if most_bytes is None else search.smaller_than(most_bytes)
            packs.append((search, pack))
        except PackError as error:
            failure = error
    if not packs:
        raise failure
    if most_bytes is None:
        return min((pack for _, pack in packs), key=lambda pack: pack.bytes)
    with suppress(SundaeError):  # sizes need no capture
        return min(packs, key=lambda pair: pair[0].drop(pair[1]))[1]
    return packs[-1][1]
