"""``sundae train``: the options of ``ns-train`` that everyone sets, under short names."""

from __future__ import annotations

import os
import shlex
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated

import tyro

from sundae_ns.cli.process import console_script, word
from sundae_ns.errors import ConfigError, DataError


def methods() -> list[str]:
    """Names of this package's methods in ``ns-train``."""
    points = entry_points(group="nerfstudio.method_configs")
    return sorted(point.name for point in points if point.value.startswith("sundae_ns."))


def train(
    capture: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("outputs"),
    method: str = "sundae",
    keep: float | None = None,
    steps: int | None = None,
) -> int:
    """Print a command of ns-train and run it; copy the command to add further options.

    Args:
        capture: folder of the capture, as ns-process-data writes it.
        out: folder of runs.
        method: one of sundae, sundae-fast, -continuous, -paper; sundae-tiny suits small images and a CPU.
        keep: share of the primitives to keep, in (0, 1]; by default as many as the scene needs, or
            that of the method.
        steps: number of training steps; by default that of the method.
    """
    words = command(capture, out, method, keep, steps)
    print(shlex.join(words), flush=True)
    # The same process: an interrupt reaches the training, and its exit code is ours.
    os.execvp(console_script(words[0]), words)


def command(capture: Path, out: Path, method: str, keep: float | None, steps: int | None) -> list[str]:
    """The words of the command; options as in :func:`train`.

    Raises:
        ConfigError: there is no such method, or a number is out of range.
        DataError: the capture does not exist.
    """
    if not capture.exists():
        raise DataError(f"{capture} does not exist; give the folder of a capture")
    if method not in methods():
        raise ConfigError(f"{method} is no method of sundae; use one of {', '.join(methods())}")
    if keep is not None and not 0 < keep <= 1:
        raise ConfigError(f"keep is {keep}; give a share in (0, 1]")
    if steps is not None and steps < 1:
        raise ConfigError(f"steps is {steps}; give at least 1")
    words = ["ns-train", method, "--data", word(capture), "--output-dir", word(out)]
    if keep is not None:
        words += ["--pipeline.model.pruning.keep-ratio", f"{keep:g}"]
    if steps is not None:
        words += ["--max-num-iterations", str(steps)]
    return words
