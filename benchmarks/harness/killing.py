"""Processes that train or run a command of sundae, and kill themselves at a place in the code, or are killed."""

from __future__ import annotations

import io
import multiprocessing
import os
import random
import signal
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import psutil
import torch
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.scripts import train

from sundae_ns.cli.main import main as sundae
from sundae_ns.core import files
from sundae_ns.io import checkpoint
from sundae_ns.pruning import decision
from sundae_ns.train import pruning, trials

Place = Callable[[int], None]
"""Prepares this process to kill itself the n-th time that it comes there."""
ANY = "any time"
LONGEST = 900.0
"""Seconds after which a process counts as hanging; it takes about ten."""


def die(*_: Any, **__: Any) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def at(owner: Any, name: str, replaced: Callable[..., Any], calls: Callable[[int], int] = lambda _: 1) -> Place:
    """Call ``replaced(original, ...)`` in place of ``owner.name`` from its ``calls(n)``-th call on."""

    def prepare(n: int) -> None:
        original, left = getattr(owner, name), [calls(n)]

        def call(*arguments: Any, **options: Any) -> Any:
            left[0] -= 1
            if left[0] > 0:
                return original(*arguments, **options)
            return replaced(original, *arguments, **options)

        setattr(owner, name, call)

    return prepare


def after(original: Callable[..., Any], *arguments: Any, **options: Any) -> None:
    original(*arguments, **options)
    die()


def half_saved(original: Callable[..., Any], state: Any, file: Any) -> None:
    whole = io.BytesIO()
    original(state, whole)
    file.write(whole.getvalue()[: len(whole.getvalue()) // 2])
    file.flush()
    die()


def half_recorded(_: Callable[..., Any], path: Path, text: str) -> None:
    with files.replacing(path) as partial:
        partial.write_text(text[: len(text) // 2])
        die()


def half_written(_: Callable[..., Any], path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)
    die()


SAVES = {
    "save: half written": at(checkpoint.torch, "save", half_saved, lambda n: n),
    "save: not yet on the disk": at(files, "flush", die, lambda n: 3 * n),
    "save: the older one not yet gone": at(checkpoint, "write", after, lambda n: n),
}
TRAINING = {
    **SAVES,
    "prune: deciding": at(decision, "decide", die),
    "prune: sliced": at(decision, "keep", after),
    "prune: half recorded": at(pruning, "write_text", half_recorded),
}
TRIALS = {
    "trial: started": at(trials.Trials, "start", after, lambda n: n),
    "trial: measuring": at(trials, "measure_held_out", die, lambda n: n),
    "trial: back to the Gaussians before it": at(trials.Trials, "go_back", after),
    "trials: ended": at(trials.Trials, "end", after),
    **SAVES,
}
COMMANDS = {
    "half written": at(files, "flush", half_written),
    "not yet renamed": at(files, "flush", die),
    "just renamed": at(files, "flush", die, lambda _: 2),
}


def train_here(config: TrainerConfig, log: Path, place: str = ANY, nth: int = 1) -> None:
    """Train in this process; die the ``nth`` time that ``place`` is reached."""
    _prepare(log, {**TRAINING, **TRIALS}, place, nth)
    train.main(config)


def command_here(words: Sequence[str], log: Path, place: str = ANY) -> None:
    """Run a command of sundae on a CPU in this process; die when ``place`` is reached."""
    os.environ["CUDA_VISIBLE_DEVICES"] = ""
    _prepare(log, COMMANDS, place, 1)
    sundae(words)


def _prepare(log: Path, places: dict[str, Place], place: str, nth: int) -> None:
    torch.set_num_threads(1)
    with open(log, "a") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    if place != ANY:
        places[place](nth)


class Bench:
    """Runs processes one after another, with one log. Processes on CUDA cannot be forked."""

    def __init__(self, device: str, log: Path) -> None:
        self.log = log
        self.context: Any = multiprocessing.get_context("spawn" if device == "cuda" else "forkserver")
        if device == "cpu":
            # Fork from a process without threads: a child could wait for their locks for ever.
            loaded = ["nerfstudio.scripts.train", "sundae_ns.plugin.model", "sundae_ns.plugin.trainer"]
            self.context.set_forkserver_preload(loaded)

    def start(self, work: Any, what: Any, **options: Any) -> BaseProcess:
        """Start a process that calls ``work`` with the log."""
        child: BaseProcess = self.context.Process(target=work, args=(what, self.log), kwargs=options)
        child.start()
        return child

    def ended(self, child: BaseProcess) -> int:
        """Wait for a process; its exit code, or minus the signal that ended it."""
        child.join(LONGEST)
        if child.exitcode is None:
            child.kill()
            child.join()
            self.fail(f"a run did not end within {LONGEST} s")
        return int(child.exitcode or 0)

    def finish(self, work: Any, what: Any) -> float:
        """Run a process that must succeed; its seconds."""
        began = time.monotonic()
        code = self.ended(self.start(work, what))
        if code != 0:
            self.fail(f"a run failed with exit code {code}")
        return time.monotonic() - began

    def fail(self, reason: str) -> None:
        raise SystemExit(f"{reason}; the end of its log:\n{self.log.read_text(errors='replace')[-3000:]}")

    def killed(self, start: Any, place: str, again: Any, seconds: float, rng: random.Random) -> bool:
        """Whether what ``start`` starts was killed: at a place, or at any time within ``seconds``.

        If it ended before, call ``again`` and repeat. Of several processes a random one is killed; the others must end
        by themselves.
        """
        if place != ANY:
            return self.ended(start(place=place)) == -signal.SIGKILL
        for _ in range(10):
            child = start()
            time.sleep(rng.uniform(0.0, seconds))
            children: list[psutil.Process] = []
            with suppress(psutil.NoSuchProcess):  # it has ended
                family = [parent := psutil.Process(child.pid), *(children := parent.children(recursive=True))]
                rng.choice([each for each in family if "resource_tracker" not in " ".join(each.cmdline())]).kill()
            code, until = self.ended(child), time.monotonic() + LONGEST
            while any(map(running, children)):
                if time.monotonic() > until:
                    self.fail("a process outlived the one that was killed")
                time.sleep(0.1)
            if code != 0:
                return True
            again()
            seconds *= 0.8  # the machine has become faster
        return False


def running(process: psutil.Process) -> bool:
    """Whether a process is there, and no zombie that no one has waited for."""
    with suppress(psutil.NoSuchProcess):
        return bool(process.status() != psutil.STATUS_ZOMBIE)
    return False
