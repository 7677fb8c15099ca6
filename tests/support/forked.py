"""Programs in processes that are forked off a server, which has imported nerfstudio once for all tests of a worker.

Its import takes many times longer than what most tests do in such a process. How a program starts, they cannot test.
"""

from __future__ import annotations

import multiprocessing
import os
import runpy
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, TextIO

CONTEXT: Any = multiprocessing.get_context("forkserver")
PRELOADED = ["nerfstudio.scripts.train", "pytest", "sundae_ns.plugin.model", "sundae_ns.plugin.trainer"]


def _run(program: str, arguments: list[str], output: Connection) -> None:
    """``python PROGRAM ARGUMENTS`` in this process, in a session of its own."""
    os.setsid()
    for number in (1, 2):
        os.dup2(output.fileno(), number)
    output.close()
    sys.argv, sys.excepthook = [program, *arguments], sys.__excepthook__
    try:
        runpy.run_path(program, run_name="__main__")
    except SystemExit:
        raise
    except BaseException as error:
        # As Python does; multiprocessing asks no hook.
        sys.excepthook(type(error), error, error.__traceback__)
        raise SystemExit(1) from error
    finally:
        measured = sys.modules.get("coverage")
        if measured is not None and (coverage := measured.Coverage.current()) is not None:
            coverage.stop()
            coverage.save()  # multiprocessing leaves without it


@contextmanager
def started(program: Path, *arguments: object) -> Iterator[tuple[BaseProcess, TextIO]]:
    """Start ``python PROGRAM ARGUMENTS``; the process, and what it prints. It is killed if it is left running.

    What it prints ends when no process is left that could print more.
    """
    CONTEXT.set_forkserver_preload(PRELOADED)
    reader, writer = CONTEXT.Pipe(duplex=False)
    process: BaseProcess = CONTEXT.Process(target=_run, args=(str(program), [*map(str, arguments)], writer))
    process.start()
    writer.close()
    try:
        with os.fdopen(os.dup(reader.fileno()), encoding="utf-8", errors="replace") as output:
            yield process, output
    finally:
        reader.close()
        process.kill()
        process.join()


def run(program: Path, *arguments: object) -> tuple[int, str]:
    """Exit code of ``python PROGRAM ARGUMENTS``, and what it printed."""
    with started(program, *arguments) as (process, output):
        printed = output.read()
        process.join()
        assert process.exitcode is not None
        return process.exitcode, printed
