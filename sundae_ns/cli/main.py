"""Entry point of ``sundae``: one module per subcommand, errors on one line."""

from __future__ import annotations

import atexit
import gc
import importlib
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from typing import NoReturn

from sundae_ns.core.errors import ConfigError, SundaeError, writing

ENVIRONMENT = {
    # Threads that spin while they wait make a step on a busy CPU ten times as long.
    "OMP_WAIT_POLICY": "PASSIVE",
    # glibc would return the memory of each step's images to the system.
    "MALLOC_MMAP_THRESHOLD_": str(2**25),
    "MALLOC_TRIM_THRESHOLD_": str(2**28),
}
"""Variables of threads and memory; those that the user has set stay."""
COMMANDS = {
    "run": "photos or a video to a packed scene, its report and its web page; resumes",
    "poses": "camera poses of photos or of a video: a capture to train on; resumes",
    "train": "train by ns-train, with short options",
    "prune": "make any splat scene smaller, without its photos",
    "distill": "prune, then train on the full scene's own images, without photos",
    "pack": "pack a scene into one file; says what that costs",
    "export": "write a scene as a web page, .ply, .spz, .sog or .glb",
    "view": "show a scene with its head in the browser",
    "render": "render a scene to an image, or to a film along a smooth path",
    "report": "measure and compare finished runs: quality, speed, size",
    "demo": "train and evaluate the embedded capture; takes minutes on a CPU",
    "doctor": "check this machine, and say how to repair it",
}
"""Commands with their lines in ``sundae --help``. Each is the function of its name in the module of its name."""


def _dispatch(words: Sequence[str]) -> int:
    """Run the command that the words name; its exit code."""
    if words[:1] in (["-h"], ["--help"]):
        print("usage: sundae COMMAND ...\n\nSmall 3D Gaussian scenes by pruning and a compensation head.\n")
        for name, line in COMMANDS.items():
            print(f"  {name:<8} {line}")
        print("\nsundae COMMAND --help shows the options of a command.")
        return 0
    if not words:
        raise ConfigError("no command is given; sundae --help lists them")
    name = words[0]
    if name not in COMMANDS:
        near = get_close_matches(name, COMMANDS, n=1)
        raise ConfigError(f"there is no command {name}; {f'use {near[0]}' if near else 'sundae --help lists them'}")
    import tyro

    # Only the module of this command: some import torch, which takes a second.
    command = getattr(importlib.import_module(f"sundae_ns.cli.{name}"), name)
    return tyro.cli(command, prog=f"sundae {name}", args=words[1:])


def exit_with(command: Callable[[], int], name: str) -> NoReturn:
    """Run a command and exit with the code that it returns; errors of the file system name the command.

    A :class:`SundaeError` is printed on one line, and the code is 2. An interrupt is 130.
    """
    for variable, value in ENVIRONMENT.items():
        os.environ.setdefault(variable, value)
    try:
        # Commands name the file that they cannot write; this covers others, such as a full disk behind stdout.
        with warnings.catch_warnings(), writing(f"{name} ended early"):
            warnings.filterwarnings("ignore", category=FutureWarning, module="nerfstudio")
            code = command()
            sys.stdout.flush()
    except SundaeError as error:
        if os.environ.get("SUNDAE_TRACEBACK"):
            raise
        print(f"sundae: {error}", file=sys.stderr)
        sys.exit(2)
    except BrokenPipeError:  # the reader of stdout has left, as head does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
    except KeyboardInterrupt:
        print("sundae: interrupted", file=sys.stderr)
        sys.exit(130)
    sys.exit(code)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run ``sundae``."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if arguments is None:
        # Looking for garbage among the million objects of imports takes a sixth of the start, and 0.6 s of the end.
        gc.set_threshold(100_000)
        atexit.register(gc.freeze)
    exit_with(lambda: _dispatch(words), " ".join(words[:1]))
