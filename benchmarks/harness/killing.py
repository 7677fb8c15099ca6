"""Places at which a process kills itself with SIGKILL: in a save, a prune, a trial, or while a command writes."""

from __future__ import annotations

import io
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import sundae_ns.core.files
import sundae_ns.io.checkpoint
import sundae_ns.pruning.decision
import sundae_ns.train.pruning
from sundae_ns.train import trials

Place = Callable[[int], None]
"""Prepares this process to die the n-th time that it comes there."""


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def after(calls: int, module: Any, name: str, place: Callable[[Callable[..., Any]], Callable[..., Any]]) -> None:
    """Replace ``module.name`` by ``place(original)`` from its ``calls``-th call on."""
    original, seen = getattr(module, name), [0]

    def wrapper(*arguments: Any, **options: Any) -> Any:
        seen[0] += 1
        return (place(original) if seen[0] >= calls else original)(*arguments, **options)

    setattr(module, name, wrapper)


def at_once(original: Callable[..., Any]) -> Callable[..., Any]:
    return lambda *_, **__: die()


def when_done(original: Callable[..., Any]) -> Callable[..., Any]:
    def call(*arguments: Any, **options: Any) -> None:
        original(*arguments, **options)
        die()

    return call


def half_saved(original: Callable[..., Any]) -> Callable[..., Any]:
    def call(state: Any, file: Any) -> None:
        whole = io.BytesIO()
        original(state, whole)
        file.write(whole.getvalue()[: len(whole.getvalue()) // 2])
        file.flush()
        die()

    return call


def half_recorded(original: Callable[..., Any]) -> Callable[..., Any]:
    def call(path: Path, text: str) -> None:
        with sundae_ns.core.files.replacing(path) as partial:
            partial.write_text(text[: len(text) // 2])
            die()

    return call


def half_written(original: Callable[..., Any]) -> Callable[..., Any]:
    def call(path: Path) -> None:
        os.truncate(path, path.stat().st_size // 2)
        die()

    return call


_checkpoint, _atomic = sundae_ns.io.checkpoint, sundae_ns.core.files
SAVES: dict[str, Place] = {
    "save: half written": lambda n: after(n, _checkpoint.torch, "save", half_saved),
    "save: not yet on the disk": lambda n: after(3 * n, _atomic, "flush", at_once),
    "save: the older one not yet gone": lambda n: after(n, _checkpoint, "write", when_done),
}
TRAINING: dict[str, Place] = {
    **SAVES,
    "prune: deciding": lambda n: after(1, sundae_ns.pruning.decision, "decide", at_once),
    "prune: sliced": lambda n: after(1, sundae_ns.pruning.decision, "keep", when_done),
    "prune: half recorded": lambda n: after(1, sundae_ns.train.pruning, "write_text", half_recorded),
}
TRIALS: dict[str, Place] = {
    "trial: started": lambda n: after(n, trials.TrialEngine, "start", when_done),
    "trial: measuring": lambda n: after(n, trials, "measure_heldout", at_once),
    "trial: back to the field before it": lambda n: after(1, trials.TrialEngine, "go_back", when_done),
    "trials: ended": lambda n: after(1, trials.TrialEngine, "end", when_done),
    **SAVES,
}
COMMANDS: dict[str, Place] = {
    "half written": lambda n: after(1, _atomic, "flush", half_written),
    "not yet renamed": lambda n: after(1, _atomic, "flush", at_once),
    "just renamed": lambda n: after(2, _atomic, "flush", at_once),
}
