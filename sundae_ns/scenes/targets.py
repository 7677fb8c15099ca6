"""Packs of a given size or quality: one factor makes all steps coarser or finer, and a bisection finds it.

The ratios between the steps come from renderings: at the defaults, one bit less of any attribute costs about the same.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch

from sundae_ns.errors import DataError, PackError
from sundae_ns.evaluation import psnr
from sundae_ns.scenes.opening import open_pipeline, views_to_test
from sundae_ns.scenes.packed import place
from sundae_ns.storage.packing import Codecs, PackConfig, PackedScene, fit_scene, write_fitted
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
    drop: float | None
    """PSNR below the unpacked run, dB; None if it was not measured."""


def scaled(config: PackConfig, power: float) -> PackConfig:
    """Options with all steps larger by 2^power, and as many fewer bits of positions, but at least 10."""
    steps = {name: min(max(getattr(config, name) * 2**power, 1e-4), 1.0) for name in STEPS}
    position_bits = min(max(round(config.position_bits - power), 10), 16)
    return replace(config, **steps, position_bits=position_bits)  # type: ignore[arg-type]


class Search:
    """Packs of one scene at several factors."""

    def __init__(self, run: Path, scene: PackedScene, config: PackConfig, *, data: Path | None = None) -> None:
        self.run, self.scene, self.config, self.data = run, scene, config, data
        self._drop: Callable[[PackedScene, Codecs], float] | None = None

    def smaller_than(self, limit: int) -> Try:
        """The finest pack of at most ``limit`` bytes.

        Raises:
            PackError: even the coarsest is larger.
        """
        found = self._bisected(lambda tried: tried.bytes <= limit, coarse=True, measure=False)
        if found.bytes <= limit:
            return found
        try:
            lost = f" and loses {self._measured(found):.2f} dB"
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
        found = self._bisected(lambda tried: self._measured(tried) <= limit, coarse=False, measure=True)
        if found.drop is not None and found.drop <= limit:
            return found
        raise PackError(
            f"the finest pack loses {self._measured(found):.3f} dB at {found.bytes:,} bytes; give a larger --target-drop"
        )

    def _bisected(self, fits: Callable[[Try], bool], *, coarse: bool, measure: bool) -> Try:
        """The pack nearest to the border between fitting and not; the last end if none fits."""
        good, bad = (COARSEST, FINEST) if coarse else (FINEST, COARSEST)
        best = self._tried(good, measure)
        if not fits(best):
            return best
        for _ in range(_TRIES):
            middle = (good + bad) / 2
            tried = self._tried(middle, measure)
            if fits(tried):
                good, best = middle, tried
            else:
                bad = middle
        return best

    def _tried(self, power: float, measure: bool) -> Try:
        scene, codecs = fit_scene(self.scene, scaled(self.config, power))
        with tempfile.TemporaryDirectory() as folder:
            size = write_fitted(Path(folder) / "a.sundae", scene, codecs).bytes
        tried = Try(scene, codecs, size, None)
        return tried._replace(drop=self._measured(tried)) if measure else tried

    def _measured(self, tried: Try) -> float:
        if tried.drop is not None:
            return tried.drop
        if self._drop is None:
            self._drop = _drop_of(self.run, self.data)
        return self._drop(tried.scene, tried.codecs)


@torch.no_grad()
def _drop_of(run: Path, data: Path | None) -> Callable[[PackedScene, Codecs], float]:
    """What measures the PSNR of a pack below that of the run, on some test views, dB."""
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
