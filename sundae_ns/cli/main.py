"""Entry point of ``sundae``: one module per subcommand, errors on one line."""

from __future__ import annotations

import atexit
import gc
import importlib
import io
import logging
import os
import re
import signal
import sys
import warnings
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr
from difflib import get_close_matches
from functools import partial, wraps
from tempfile import gettempdir
from typing import NoReturn

from sundae_ns.core.errors import ConfigError, SundaeError, writing

ENVIRONMENT = {
    # Threads that spin while they wait make a step on a busy CPU ten times as long.
    "OMP_WAIT_POLICY": "PASSIVE",
    # glibc would return the memory of each step's images to the system.
    "MALLOC_MMAP_THRESHOLD_": str(2**25),
    "MALLOC_TRIM_THRESHOLD_": str(2**28),
    "USER": str(getattr(os, "getuid", int)()),  # torch asks for a name; a container's user may have no account
}
"""Variables of threads, memory and the account; those that the user has set stay."""
COMMANDS = {
    "run": "photos or a video to a packed scene, its report and its web page; resumes",
    "poses": "camera poses of photos or of a video: a capture to train on; resumes",
    "train": "train by ns-train, with short options",
    "prune": "make any splat scene smaller, without its photos; by --distill trained on its images",
    "pack": "pack a scene into one file; says what that costs",
    "export": "write a scene as a web page, .ply, .spz, .sog or .glb",
    "view": "show a scene with its head in the browser",
    "render": "render a scene to an image, or to a film along a smooth path",
    "compare": "compare scenes, formats or runs: quality, bytes, speed; a page with sliders",
    "info": "what a file holds: count, bounds, bytes, cameras, floaters, a crop box",
    "demo": "train and evaluate the embedded capture; takes minutes on a CPU",
    "doctor": "check this machine, and say how to repair it",
}
"""Commands with their lines in ``sundae --help``. Each is the function of its name in the module of its name."""
typed: list[str] = []  # words of the command, as it records them
STEP = "SUNDAE_STEP"  # variable of a command that another one started, which tells how to continue


def _dispatch(words: Sequence[str]) -> int:
    """Run the command that the words name; its exit code."""
    name, *options = words or ["help"]
    typed[:] = words
    options = ["".join(map(os.path.expanduser, re.split("^(-[^=]+=)", word))) for word in options]  # --out=~/a too
    if name in ("--version", "-V", "version"):
        print(f"sundae_ns {sys.modules['sundae_ns'].__version__}")
        return 0
    if name in ("help", "-h", "--help") and not options:
        print("usage: sundae COMMAND ...\n\nSmall 3D Gaussian scenes by pruning and a compensation head.\n")
        print("\n".join(f"  {command:<8} {line}" for command, line in COMMANDS.items()))
        print("\nsundae COMMAND --help shows the options of a command; sundae --version the version.")
        return 0 if words else 2
    if name == "help":
        name, options = options[0], ["--help"]
    if name not in COMMANDS:
        near = get_close_matches(name, COMMANDS, n=1)
        raise ConfigError(f"there is no command {name}; {f'use {near[0]}' if near else 'sundae --help lists them'}")
    no_room = "no folder for temporary files can be written; make room in /tmp, or set TMPDIR to another"
    for folder_of, lack in ((os.getcwd, "the working folder is gone; cd to another"), (gettempdir, no_room)):
        try:  # else libraries fail at their import
            folder_of()
        except FileNotFoundError as error:
            raise ConfigError(lack) from error
    import tyro

    if (flag := "--remove-floaters") in options:  # its number may be left out
        at = options.index(flag) + 1
        options[at:at] = [] if re.fullmatch(r"-?[\d.]+(e-?\d+|%)?", "".join(options[at : at + 1])) else ["0.25"]
    # Only the module of this command: some import torch, which takes a second.
    run = getattr(importlib.import_module(f"sundae_ns.cli.{name}"), name)
    messages = io.StringIO()
    later = wraps(run)(lambda *given, **named: partial(run, *given, **named))  # runs behind tyro's own errors
    run.__doc__ = re.sub(r"\n {12}(?=\S)", " ", run.__doc__ or "")  # the help would keep the line breaks of arguments
    try:
        with redirect_stderr(messages):
            chosen = tyro.cli(later, prog=f"sundae {name}", args=options)
    except SystemExit as end:
        if end.code != 2:  # it was the help, or a signal
            raise
        # Of a box of many lines, those that are not indented further; between its rules are parts.
        rows = " ".join(re.findall(r"(?m)^[│ ] {1,5}(\S.*?)\.? *│?$", messages.getvalue()))
        text = (re.sub(r" [─-]{9,} ", "; ", rows) or messages.getvalue()).replace("Expected 1 values", "Give one")
        text = re.sub(r"(Argument helptext: .*)?For full helptext, \w+:? (.*)", r"\2 shows the options", text)
        raise ConfigError(re.sub(r"could not convert .*?: |invalid literal .*?: ", "no number: ", text)) from end
    return chosen()


def exit_with(command: Callable[[], int], name: str) -> NoReturn:
    """Run a command and exit with its code; 2 after the one line of a :class:`SundaeError`, 130 for an interrupt."""
    home = os.path.expanduser("~")  # of no account: numba would make a folder ~ here for its cache
    os.environ.update({**ENVIRONMENT, "HOME": "/" if home == "~" else home, **os.environ})
    try:
        # Commands name the file that they cannot write; this covers others, such as a full disk behind stdout.
        with writing(f"{name} ended early"):
            try:
                code = command()
            finally:
                sys.stdout.flush()
    except (SundaeError, BrokenPipeError) as error:
        if early := isinstance(error, BrokenPipeError) or " ended early: " in str(error):
            sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - at its end Python would write the rest, and fail
        if isinstance(error, BrokenPipeError):  # the reader of stdout has left, as head does
            sys.exit(141)
        if os.environ.get("SUNDAE_TRACEBACK"):
            raise
        file = getattr(error.__cause__, "filename", None) if early else None
        print(f"sundae: {f'{file}: ' if file else ''}{error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        if not os.environ.get(STEP):  # the command that started this one says so
            print("sundae: interrupted", file=sys.stderr)
        sys.exit(130)
    sys.exit(code)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run ``sundae``."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if arguments is None:
        for each in (signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)):  # else no half-written file is removed
            if signal.getsignal(each) == signal.SIG_DFL:
                signal.signal(each, lambda number, _: sys.exit(128 + number))
        warnings.simplefilter("ignore")  # of libraries; PYTHONWARNINGS=error would make them errors
        logging.getLogger("matplotlib").setLevel(logging.ERROR)  # it looks for a home
        for name in ("stdout", "stderr"):
            if getattr(sys, name) is None:  # it is closed; else the next file that opens would get its number
                setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
            if isinstance(stream := getattr(sys, name), io.TextIOWrapper):  # names of files may be no text
                stream.reconfigure(errors="backslashreplace")
        # Looking for garbage among the million objects of imports takes a sixth of the start, and 0.6 s of the end.
        gc.set_threshold(100_000)
        atexit.register(gc.freeze)
    exit_with(lambda: _dispatch(words), " ".join(words[:1]))
