"""The end of every script here: a command line, one-line errors, an exit code."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import tyro

from sundae_ns.cli.main import exit_with


def run_script(parsed: Callable[..., Any], description: str | None, run: Callable[[Any], int] = int) -> NoReturn:
    """Parse the command line into the arguments of a function or a class, and exit.

    Errors of the package are printed on one line, as by ``sundae``.

    Args:
        parsed: a function that returns the exit code, or a class of options.
        description: text of ``--help``.
        run: makes the exit code from the value of ``parsed``.
    """
    prog = Path(sys.argv[0]).name
    exit_with(lambda: run(tyro.cli(parsed, prog=prog, description=description)), prog)
