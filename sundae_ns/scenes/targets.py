"""Packs of a given size or quality: one factor makes all steps coarser or finer, and a bisection finds it.

The ratios between the steps come from renderings: at the defaults, one bit less of any attribute costs about the same.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import torch

from sundae_ns.errors import DataError, PackError
from sundae_ns.evaluation import psnr
from sundae_ns.scenes.opening import open_pipeline, views_to_test
from sundae_ns.scenes.packed import place
from sundae_ns.storage.packing import Codecs, PackConfig, PackedScene, fit_scene, pack_bytes
from sundae_ns.storage.packing.config import STEPS
from sundae_ns.storage.runs.folder import config_of

FINEST, COARSEST = -3.0, 4.0
"""Ends of the search: powers of two of the factor."""
_TRIES = 7
_VIEWS = 4


class Try(NamedTuple):
    """One pack of the search."""

    scene: PackedScene
    codecs: Codecs
    bytes: int


def scaled(config: PackConfig, power: float) -> PackConfig:
    """Options with all steps larger by 2^power, and as many fewer bits of positions, but at least 10."""
    steps = {name: min(max(getattr(config, name) * 2**power, 1e-4), 1.0) for name in STEPS}
    position_bits = min(max(round(config.position_bits - power), 10), 16)
    return replace(config, **steps, position_bits=position_bits)  # type: ignore[arg-type]


class Search:
    """Packs of one scene at several factors."""

    def __init__(self, run: Path, scene: PackedScene, config: PackConfig, *, data: Path | None = None) -> None:
        self.run, self.scene, self.config, self.data = run, scene, config, data

    @cached_property
    def _drop(self) -> Callable[[PackedScene, Codecs], float]:
        return _drop_of(self.run, self.data)

    def drop(self, tried: Try) -> float:
        """PSNR of a pack below the unpacked run on some test views, dB.

        Raises:
            DataError: the capture is missing, or cannot be used.
        """
        return self._drop(tried.scene, tried.codecs)

    def smaller_than(self, limit: int) -> Try:
        """The finest pack of at most ``limit`` bytes.

        Raises:
            PackError: even the coarsest is larger.
        """
        found, fits = self._bisected(lambda tried: tried.bytes <= limit, first=COARSEST, last=FINEST)
        if fits:
            return found
        try:
            lost = f" and loses {self.drop(found):.2f} dB"
        except DataError:
            lost = ""
        raise PackError(
            f"the smallest pack has {found.bytes:,} bytes{lost}; give a larger --target-bytes, or prune the run"
        )

    def better_than(self, limit: float) -> Try:
        """The coarsest pack that loses at most ``limit`` dB on the test views.

        Raises:
            PackError: even the finest loses more.
            DataError: the capture is missing, or cannot be used.
        """
        found, fits = self._bisected(lambda tried: self.drop(tried) <= limit, first=FINEST, last=COARSEST)
        if fits:
            return found
        raise PackError(
            f"the finest pack loses {self.drop(found):.3f} dB at {found.bytes:,} bytes; give a larger --target-drop"
        )

    def _bisected(self, fits: Callable[[Try], bool], *, first: float, last: float) -> tuple[Try, bool]:
        """The fitting pack nearest to ``last``; that of ``first`` and False if even this one does not fit."""
        best = self._tried(first)
        if not fits(best):
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
        scene, codecs = fit_scene(self.scene, scaled(self.config, power))
        return Try(scene, codecs, len(pack_bytes(scene, codecs)[0]))


@torch.no_grad()
def _drop_of(run: Path, data: Path | None) -> Callable[[PackedScene, Codecs], float]:
    """A function that measures the PSNR of a pack below that of the run, on some test views, dB."""
    opened = open_pipeline(config_of(run), data=data, test_mode="test")
    opened.pipeline.eval()
    model = opened.model
    cameras, truths = views_to_test(model, opened.pipeline.datamanager)
    if not cameras:
        raise DataError(f"{run} has no test views; give --target-bytes, or train with an eval-interval")
    chosen = torch.linspace(0, len(cameras) - 1, min(_VIEWS, len(cameras))).round().long().unique().tolist()

    @torch.no_grad()
    def quality() -> float:
        images = [model.get_outputs_for_camera(cameras[i])["rgb"].clamp(0, 1) for i in chosen]
        return sum(float(psnr(image, truths[i])) for image, i in zip(images, chosen, strict=True)) / len(chosen)

    before = quality()

    def drop(scene: PackedScene, codecs: Codecs) -> float:
        place(model, codecs.rounded(scene.field))
        if model.head is not None and scene.head:
            model.head.load_state_dict(codecs.rounded_head(scene.head))
        after = quality()
        return before - after if math.isfinite(after) else math.inf

    return drop
