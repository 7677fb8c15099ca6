"""Options of the comparisons, as the command line is parsed into them.

The two classes share no base: its fields would come first in ``--help`` and in the command that a page names.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class QualityOptions:
    """Options of ``sundae bench quality``."""

    scene: Annotated[Path, tyro.conf.Positional]
    """folder of a capture: COLMAP layout (sparse/0, images), or with a transforms.json."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """folder for jobs, results and tables; its finished jobs are not run again."""
    arms: tuple[str, ...] = ()
    """files of arms (.yaml), and names of default arms: sundae, band, contribution, random, each also with -no-head;
    mcmc, splatfacto, splatfacto-7k. All default arms if none is given."""
    keep_ratios: tuple[float, ...] = (0.01, 0.1)
    """shares of the warm-up's primitives to keep."""
    seeds: tuple[int, ...] = (42, 43, 44)
    """the first for every job, the others for the shares of --repeat-at."""
    repeat_at: tuple[float, ...] = (0.1,)
    """shares that run with all seeds."""
    method: str = "sundae"
    """method of arms that name none; one of this package that prunes once."""
    warmup_steps: int | None = None
    """steps of the warm-up, instead of the method's own."""
    finetune_steps: int | None = None
    """steps of the fine-tuning, instead of the method's own."""
    steps_scale: float = 1.0
    """factor on all lengths, for a trial."""
    downscale: int = 1
    """use the images of images_2, images_4 ... (COLMAP layout)."""
    shard: str = "1/1"
    """i/n runs the i-th of n parts."""
    jobs: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """only list the jobs, and which are done."""

    def command(self) -> str:
        """The command that a page names."""
        return _command("quality", self)


@dataclass(frozen=True)
class PaperOptions:
    """Options of ``sundae bench paper``."""

    root: Annotated[Path, tyro.conf.Positional]
    """folder with the unpacked archives (360_v2, tandt, db), or with the scenes themselves."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """folder for jobs, results and tables; its finished jobs are not run again."""
    scenes: tuple[str, ...] = ()
    """some of the eleven; by default all that the folder has."""
    arms: tuple[str, ...] = ("sundae", "sundae-no-head", "splatfacto")
    """files of arms and names of default arms, as in bench quality."""
    keep_ratios: tuple[float, ...] = (0.01, 0.1, 0.3, 0.5)
    """shares of the warm-up's primitives to keep."""
    seed: int = 42
    """of every job."""
    method: str = "sundae"
    """method of arms that name none; one of this package that prunes once."""
    warmup_steps: int | None = None
    """steps of the warm-up, instead of the method's own."""
    finetune_steps: int | None = None
    """steps of the fine-tuning, instead of the method's own."""
    steps_scale: float = 1.0
    """factor on all lengths, for a trial."""
    shard: str = "1/1"
    """i/n runs the i-th of n parts."""
    jobs: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """only list the jobs, and which are done."""

    def command(self) -> str:
        """The command that a page names."""
        return _command("paper", self)


def _command(name: str, options: QualityOptions | PaperOptions) -> str:
    """The command of the whole comparison, without the shard."""
    positional, *others = (field.name for field in fields(options))
    words = ["sundae", "bench", name, str(getattr(options, positional)), "-o", str(options.out)]
    for other in others:
        if other in ("out", "shard", "jobs"):
            continue
        value = getattr(options, other)
        values = [value] if isinstance(value, str) or not isinstance(value, Sequence) else list(value)
        if values and values != [None]:
            words += [f"--{other.replace('_', '-')}", *map(str, values)]
    return shlex.join(words)
