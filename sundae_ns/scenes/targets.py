"""Packs of a given size or quality: one factor makes all steps coarser or finer, and a bisection finds it.

The ratios between the steps come from renderings: at the defaults, one bit less of any attribute costs about the same.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import torch

from sundae_ns.errors import DataError, PackError, SundaeError
from sundae_ns.evaluation import psnr, ssim
from sundae_ns.scenes.opening import open_pipeline, views_to_test
from sundae_ns.scenes.packed import place
from sundae_ns.storage.pack import Codecs, PackConfig, PackedScene, fit_scene, pack_bytes
from sundae_ns.storage.pack.config import STEPS
from sundae_ns.storage.runs.folder import config_of
from sundae_ns.training.trials.head import GAIN_PER_DOUBLING

FINEST, COARSEST = -3.0, 4.0
"""Ends of the search: powers of two of the factor."""
_TRIES = 7
_VIEWS = 8


class Quality(NamedTuple):
    """Means over the same test views."""

    psnr: float
    """dB."""
    ssim: float
    """NaN for images smaller than its window."""


class Judge:
    """Measures a run, and packs of it, on some of its test views.

    Args:
        run: folder of a run of sundae or splatfacto, or its ``config.yml``.
        data: the capture, if it has moved.

    Raises:
        CheckpointError: the run cannot be opened.
        DataError: the capture is missing, cannot be used, or has no test views.
    """

    @torch.no_grad()
    def __init__(self, run: Path, data: Path | None) -> None:
        opened = open_pipeline(config_of(run), data=data, test_mode="test")
        opened.pipeline.eval()
        self._model = opened.model
        cameras, truths = views_to_test(self._model, opened.pipeline.datamanager)
        if not cameras:
            raise DataError(f"{run} has no test views; give --target-bytes, or train with an eval-interval")
        chosen = torch.linspace(0, len(cameras) - 1, min(_VIEWS, len(cameras))).round().long().unique().tolist()
        self._views = [(cameras[i], truths[i]) for i in chosen]
        self.all_views = len(cameras)
        """Number of test views of the capture."""
        self.before = self._shown()
        """Of the run itself."""

    @property
    def views(self) -> int:
        """Number of test views that are measured."""
        return len(self._views)

    def quality(self, scene: PackedScene, codecs: Codecs) -> Quality:
        """Of a pack."""
        model = self._model
        place(model, codecs.rounded(scene.field))
        if model.head is not None and scene.head:
            model.head.load_state_dict(codecs.rounded_head(scene.head))
        return self._shown()

    @torch.no_grad()
    def _shown(self) -> Quality:
        found = []
        for camera, truth in self._views:
            image = self._model.get_outputs_for_camera(camera)["rgb"].clamp(0, 1)
            found.append((float(psnr(image, truth)), float(ssim(image, truth))))
        return Quality(*(sum(values) / len(found) for values in zip(*found, strict=True)))


def is_worth(psnr: float, size: int, other_psnr: float, other_size: int) -> bool:
    """Whether a pack of ``size`` bytes is worth more than another, by the PSNR that trials ask for a doubling."""
    return psnr >= other_psnr + GAIN_PER_DOUBLING * math.log2(size / other_size)


class Try(NamedTuple):
    """One pack of the search."""

    scene: PackedScene
    codecs: Codecs
    bytes: int


def scaled(config: PackConfig, power: float, *, with_positions: bool = True) -> PackConfig:
    """Options with all steps larger by 2^power, and as many fewer bits of positions, but at least 10."""
    steps = {name: min(max(getattr(config, name) * 2**power, 1e-4), 1.0) for name in STEPS}
    if with_positions:
        steps["position_bits"] = min(max(round(config.position_bits - power), 10), 16)
    return replace(config, **steps)  # type: ignore[arg-type]


class Search:
    """Packs of one scene at several factors.

    Args:
        scene: exact, or fine-tuned with the rounding of codecs.
        fit: the options at the factor 1, or the codecs of the fine-tune. It trained with their grids and bases, which
            no factor changes: others would only add an error.
        judge: opens the run's test views when they are first needed.
    """

    def __init__(self, scene: PackedScene, fit: PackConfig | Codecs, judge: Callable[[], Judge]) -> None:
        self.scene, self._fit, self._open = scene, fit, judge

    @cached_property
    def _judge(self) -> Judge:
        return self._open()

    @cached_property
    def default(self) -> Try:
        """The pack at the factor 1; of a fine-tuned scene, the one that was trained."""
        return self._tried(0.0)

    def drop(self, tried: Try) -> float:
        """PSNR of a pack below the unpacked run on some test views, dB; infinite for images that are not finite.

        Raises:
            DataError: the capture is missing, or cannot be used.
        """
        lost = self._judge.before.psnr - self._judge.quality(tried.scene, tried.codecs).psnr
        return lost if math.isfinite(lost) else math.inf

    def smaller_than(self, limit: int) -> Try:
        """The finest pack of at most ``limit`` bytes; that at the factor 1 if it fits too and, by chance, loses less.

        Raises:
            PackError: even the coarsest is larger.
        """
        found, fits = self._bisected(lambda tried: tried.bytes <= limit, first=COARSEST, last=FINEST)
        default = self.default
        try:
            lost = f" and loses {self.drop(found):.2f} dB"
            if fits and default.bytes <= limit and self.drop(default) < self.drop(found):
                return default
        except SundaeError:  # sizes need no capture
            lost = ""
        if fits:
            return found
        raise PackError(
            f"the smallest pack has {found.bytes:,} bytes{lost}; give a larger --target-bytes, or prune the run"
        )

    def better_than(self, limit: float) -> Try:
        """The coarsest pack that loses at most ``limit`` dB on the test views.

        Where the pack at the factor 1 loses at most ``limit``, the result is no larger than that.

        Raises:
            PackError: even the finest loses more.
            DataError: the capture is missing, or cannot be used.
        """

        def fits(tried: Try) -> bool:
            return self.drop(tried) <= limit

        if fits(self.default):
            found, _ = self._bisected(fits, first=0.0, last=COARSEST, known=self.default)
            return min(self.default, found, key=lambda tried: tried.bytes)
        found, fitting = self._bisected(fits, first=FINEST, last=0.0)
        if fitting:
            return found
        raise PackError(
            f"the finest pack loses {self.drop(found):.3f} dB at {found.bytes:,} bytes; give a larger --target-drop"
        )

    def _bisected(
        self, fits: Callable[[Try], bool], *, first: float, last: float, known: Try | None = None
    ) -> tuple[Try, bool]:
        """The fitting pack nearest to ``last``; that of ``first``, unless ``known`` to fit, and False if none does."""
        best = known or self._tried(first)
        if known is None and not fits(best):
            return best, False
        for _ in range(_TRIES):
            middle = (first + last) / 2
            tried = self._tried(middle)
            if fits(tried):
                first, best = middle, tried
            else:
                last = middle
        return best, True

    def _tried(self, power: float) -> Try:
        if isinstance(self._fit, PackConfig):
            scene, codecs = fit_scene(self.scene, scaled(self._fit, power))
        else:
            scene, codecs = self.scene, self._fit
            if power:
                config = scaled(codecs.config, power, with_positions=False)
                codecs = codecs.with_steps(config, scene.field, scene.head)
        return Try(scene, codecs, len(pack_bytes(scene, codecs)[0]))


def least_drop(searches: Sequence[Search], limit: int) -> Try:
    """The pack of at most ``limit`` bytes that loses least, of searches of one run; without test views, the last's.

    Raises:
        PackError: none has one; that of the last.
    """
    found = _of_each(searches, lambda search: search.smaller_than(limit))
    try:
        return min(found, key=lambda pair: pair[0].drop(pair[1]))[1]
    except SundaeError:  # sizes need no capture
        return found[-1][1]


def fewest_bytes(searches: Sequence[Search], limit: float) -> Try:
    """The smallest pack that loses at most ``limit`` dB on the test views, of searches of one run.

    Raises:
        PackError: none has one; that of the last.
        DataError: the capture is missing, or cannot be used.
    """
    found = _of_each(searches, lambda search: search.better_than(limit))
    return min((tried for _, tried in found), key=lambda tried: tried.bytes)


def _of_each(searches: Sequence[Search], look: Callable[[Search], Try]) -> list[tuple[Search, Try]]:
    """What the searches find, without those that find nothing."""
    found, last = [], None
    for search in searches:
        try:
            found.append((search, look(search)))
        except PackError as error:
            last = error
    if last is not None and not found:
        raise last
    return found
