"""Processes that train or run a command of sundae, each with its output in a log, one after another."""

from __future__ import annotations

import multiprocessing
import os
import random
import signal
import time
from collections.abc import Sequence
from contextlib import suppress
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import torch
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.scripts import train

from harness import killing
from sundae_ns.cli.main import main as sundae

LONGEST = 900.0
"""Seconds after which a process counts as hanging; it takes about ten."""


def with_log(log: Path) -> None:
    """Write the output of this process to a log."""
    torch.set_num_threads(1)
    with open(log, "a") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)


def train_here(config: TrainerConfig, log: Path, place: str | None, nth: int) -> None:
    """Train in this process; die the ``nth`` time that ``place`` is reached."""
    with_log(log)
    if place is not None:
        {**killing.TRAINING, **killing.TRIALS}[place](nth)
    train.main(config)


def command_here(words: Sequence[str], log: Path, place: str | None) -> None:
    """Run a command of sundae in this process; die when ``place`` is reached."""
    with_log(log)
    if place is not None:
        killing.COMMANDS[place](1)
    sundae(words)


class Bench:
    """Runs processes one after another, with one log.

    Args:
        device: of the trainings; processes on CUDA cannot be forked.
        log: file for their output.
    """

    def __init__(self, device: str, log: Path) -> None:
        self.context: Any = multiprocessing.get_context("spawn" if device == "cuda" else "forkserver")
        if device == "cpu":
            # This process has threads (a progress bar's, torch's): a run forked off it could wait for ever for a lock
            # of theirs.
            self.context.set_forkserver_preload(
                ["nerfstudio.scripts.train", "sundae_ns.plugin.model", "sundae_ns.plugin.trainer"]
            )
        self.log = log

    def start(self, work: Any, *arguments: Any) -> BaseProcess:
        """Start a process that calls ``work``."""
        child: BaseProcess = self.context.Process(target=work, args=arguments)
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

    def finish(self, child: BaseProcess) -> None:
        """Wait for a process that must succeed."""
        code = self.ended(child)
        if code != 0:
            self.fail(f"a run failed with exit code {code}")

    def fail(self, reason: str) -> None:
        raise SystemExit(f"{reason}; the end of its log:\n{self.log.read_text(errors='replace')[-3000:]}")

    def killed_at_any_time(self, start: Any, again: Any, seconds: float, rng: random.Random) -> bool:
        """Kill what ``start`` starts within ``seconds``; try ``again`` if it ended before. Whether it was killed.

        Of several processes a random one is killed; the others must end by themselves.
        """
        for _ in range(10):
            child = start()
            time.sleep(rng.uniform(0.0, seconds))
            family = [child.pid, *descendants(child.pid)]
            with suppress(ProcessLookupError):  # it has ended
                victims = [pid for pid in family if b"resource_tracker" not in command_line(pid)]
                os.kill(rng.choice(victims), signal.SIGKILL)
            code = self.ended(child)
            until = time.monotonic() + LONGEST
            while any(command_line(pid) for pid in family[1:]):
                if time.monotonic() > until:
                    self.fail("a process outlived the one that was killed")
                time.sleep(0.1)
            if code != 0:
                return True
            again()
            seconds *= 0.8  # the machine has become faster
        return False


def command_line(pid: int) -> bytes:
    """Words of a running process; empty if there is none."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


def descendants(pid: int) -> list[int]:
    """Processes that a process started, and theirs."""
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return []
    return [one for child in children for one in (int(child), *descendants(int(child)))]
