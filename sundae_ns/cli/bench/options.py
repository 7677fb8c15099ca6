"""Options of the comparisons, as the command line is parsed into them."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

import tyro

SUITE = (
    *("splatfacto", "sundae", "sundae-with-head", "sundae-no-head", "sundae-no-head-bytes"),
    *("mcmc", "band", "sundae-fast", "sundae-auto"),
)
"""Default arms of ``sundae bench suite``."""


@dataclass(frozen=True, kw_only=True)
class ComparisonOptions:
    """Options of all comparisons."""

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """folder for jobs, results and tables; its finished jobs are not run again."""
    method: str = "sundae"
    """method of arms that name none; one of this package that prunes once."""
    steps_scale: float = 1.0
    """factor on all lengths, for a trial."""
    shard: str = "1/1"
    """i/n runs the i-th of n parts."""
    jobs: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """only list the jobs, and which are done."""

    def _command(self, name: str, folder: Path) -> str:
        """The command of the whole comparison, without the shard."""
        words = ["sundae", "bench", name, str(folder), "-o", str(self.out)]
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name in ("out", "shard", "jobs") or value is folder:
                continue
            values = [value] if isinstance(value, str) or not isinstance(value, Sequence) else list(value)
            if values:
                words += [f"--{field.name.replace('_', '-')}", *map(str, values)]
        return shlex.join(words)


@dataclass(frozen=True, kw_only=True)
class QualityOptions(ComparisonOptions):
    """Options of ``sundae bench quality``."""

    scene: Annotated[Path, tyro.conf.Positional]
    """folder of a capture: COLMAP layout (sparse/0, images), or with a transforms.json."""
    arms: tuple[str, ...] = ()
    """files of arms (.yaml), and names of default arms: sundae, band (the paper's rule), contribution, random, each also with
    -no-head; sundae-with-head, sundae-no-head-bytes; mcmc (from scratch to the same count), sundae-fast, sundae-auto,
    splatfacto, splatfacto-7k. All default arms if none is given."""
    keep_ratios: tuple[float, ...] = (0.01, 0.1)
    """shares of the warm-up's primitives to keep."""
    seeds: tuple[int, ...] = (42, 43, 44)
    """the first for every job, the others for the shares of --repeat-at."""
    repeat_at: tuple[float, ...] = (0.1,)
    """shares that run with all seeds."""
    downscale: int = 1
    """use the images of images_2, images_4 ... (COLMAP layout)."""

    def command(self) -> str:
        """The command that a page names."""
        return self._command("quality", self.scene)


@dataclass(frozen=True, kw_only=True)
class SuiteOptions(ComparisonOptions):
    """Options of ``sundae bench suite``."""

    captures: Annotated[Path, tyro.conf.Positional]
    """folder of captures, each in COLMAP layout (sparse/0, images) or with a transforms.json."""
    scenes: tuple[str, ...] = ()
    """names of captures to measure; by default every folder in it."""
    arms: tuple[str, ...] = SUITE
    """files of arms (.yaml), and names of default arms, as in bench quality; those without options train from scratch."""
    keep_ratios: tuple[float, ...] = (0.1,)
    """shares of the primitives to keep."""
    seeds: tuple[int, ...] = (42,)
    """the first for every job, the others for the shares of --repeat-at."""
    repeat_at: tuple[float, ...] = (0.1,)
    """shares that run with all seeds."""
    downscale: int = 1
    """use the images of images_2, images_4 ... (COLMAP layout)."""

    def command(self) -> str:
        """The command that a page names."""
        return self._command("suite", self.captures)


@dataclass(frozen=True, kw_only=True)
class PaperOptions(ComparisonOptions):
    """Options of ``sundae bench paper``."""

    root: Annotated[Path, tyro.conf.Positional]
    """folder with the unpacked archives (360_v2, tandt, db), or with the scenes themselves."""
    scenes: tuple[str, ...] = ()
    """some of the eleven; by default all that the folder has."""
    arms: tuple[str, ...] = ("sundae", "sundae-no-head", "splatfacto")
    """files of arms and names of default arms, as in bench quality."""
    keep_ratios: tuple[float, ...] = (0.01, 0.1, 0.3, 0.5)
    """shares of the warm-up's primitives to keep."""
    seed: int = 42
    """of every job."""

    def command(self) -> str:
        """The command that a page names."""
        return self._command("paper", self.root)
