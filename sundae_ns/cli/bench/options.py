"""Options of the comparisons: what the command line is parsed into, what the runners take, and what their pages name.

No base holds what both have: the order of the fields is that of ``--help`` and of the command on a page, and fields of a
base would come before the others.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

import tyro

from sundae_ns.cli.bench.plan import ARMS


@dataclass(frozen=True)
class QualityOptions:
    """Options of ``sundae bench quality``."""

    scene: Annotated[Path, tyro.conf.Positional]
    """folder of a capture: COLMAP layout (sparse/0, images), or with a transforms.json."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """folder for jobs, results and tables; what is finished in it is not done again."""
    arms: tuple[str, ...] = ARMS
    """what to compare: sundae, band, contribution, random, each also with -no-head; mcmc, splatfacto, splatfacto-7k."""
    keep_ratios: tuple[float, ...] = (0.01, 0.1)
    """shares of the warm-up's primitives."""
    seeds: tuple[int, ...] = (42, 43, 44)
    """the first for everything, the others for what is at --repeat-at."""
    repeat_at: tuple[float, ...] = (0.1,)
    """shares that all seeds are run for."""
    method: str = "sundae"
    """method of ours whose options the jobs have."""
    warmup_steps: int | None = None
    """length of the warm-up instead of the method's own."""
    finetune_steps: int | None = None
    """length of the fine-tuning instead of the method's own."""
    steps_scale: float = 1.0
    """factor on all lengths, for a trial."""
    downscale: int = 1
    """take the pictures of images_2, images_4 ... (COLMAP layout)."""
    shard: str = "1/1"
    """i/n does the i-th of n parts."""
    jobs: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """list the jobs, and which are done, and do nothing."""

    def command(self) -> str:
        """The command that a page names."""
        return _command("quality", self)


@dataclass(frozen=True)
class PaperOptions:
    """Options of ``sundae bench paper``."""

    root: Annotated[Path, tyro.conf.Positional]
    """folder with the archives as they unpack: 360_v2, tandt and db, or the scenes themselves."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """folder for jobs, results and tables; what is finished in it is not done again."""
    scenes: tuple[str, ...] = ()
    """some of the eleven; all that are there by default."""
    arms: tuple[str, ...] = ("sundae", "sundae-no-head", "splatfacto")
    """as in bench quality."""
    keep_ratios: tuple[float, ...] = (0.01, 0.1, 0.3, 0.5)
    """shares of the warm-up's primitives."""
    seed: int = 42
    """of everything."""
    method: str = "sundae"
    """method of ours whose options the jobs have."""
    warmup_steps: int | None = None
    """length of the warm-up instead of the method's own."""
    finetune_steps: int | None = None
    """length of the fine-tuning instead of the method's own."""
    steps_scale: float = 1.0
    """factor on all lengths, for a trial."""
    shard: str = "1/1"
    """i/n does the i-th of n parts."""
    jobs: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """list the jobs, and which are done, and do nothing."""

    def command(self) -> str:
        """The command that a page names."""
        return _command("paper", self)


def _command(name: str, options: QualityOptions | PaperOptions) -> str:
    """The command of the whole comparison, whichever part of it was done here."""
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
