"""Make every figure of docs/results.md anew, one program after the other, alone on one GPU. Stopped, it goes on.

    cd benchmarks; python -m harness.record CAPTURES -o DIR            # six captures: some six hours of an H100
    cd benchmarks; python -m harness.record CAPTURES -o DIR --list     # its commands, and which are done

Three seeds of the default, one of everything else. Each command that has ended well is a file in DIR/done; one that
fails leaves its output in DIR/logs, the others go on, and the exit code is 1. Rows are gathered in DIR/results. A file
of benchmarks/results is replaced once all commands that write to it have ended well; then tables and plots are drawn.
``splat-transform`` takes part where it is in PATH, JOD where cvvdp is installed.
"""

from __future__ import annotations

import shlex
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import tyro
from rich.console import Console
from rich.markup import escape
from rich.progress import track

from harness.plan import job_folder
from harness.run import STOPPED
from harness.script import run_script
from harness.stored import RESULTS
from sundae_ns.cli.options import check_folder
from sundae_ns.cli.process import run_logged
from sundae_ns.errors import DataError, SundaeError
from sundae_ns.storage.atomic import write_text

FOLDER = Path(__file__).parents[1]
SEEDS = ("42", "43", "44")
SHARES = ("1", "0.4", "0.2", "0.1", "0.05", "0.025")
"""Fixed shares beside the default's choice: the curve of what a scene needs."""
OTHERS = ("splatfacto", "sundae", "sundae-with-head", "sundae-no-head", "sundae-fast", "band")
TIMED = ("splatfacto", "sundae", "sundae-fast")
LOOKED = (1000, 2000, 3000, 4500, 6000, 8000, 10000, 12000, 15000, 18000, 21000, 25000)
"""Steps of a timed training after which the test views are measured, with the clock stopped."""


class Step(NamedTuple):
    """A command."""

    name: str
    words: tuple[str, ...]
    table: str = ""
    """File of results that it writes to, if any."""


@dataclass(frozen=True, kw_only=True)
class RecordOptions:
    """Options of the record."""

    folder: Annotated[Path, tyro.conf.Positional]
    """folder of captures, each a folder with images and sparse/0."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """folder for runs, logs and what is done; the same one goes on."""
    list: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """only list the commands, and which are done."""


def steps_of(captures: Sequence[Path], out: Path, *, others: bool) -> list[Step]:
    """The commands, each after those that it needs.

    Args:
        captures: their folders.
        out: folder for the runs.
        others: let splat-transform take part.
    """
    folder, steps = str(captures[0].parent), []
    theirs = ("--splat-transform", "splat-transform") if others else ()

    def add(name: str, script: str, *words: object, table: str = "") -> None:
        to = ("-o", out / "results" / table) if table else ()
        steps.append(Step(name, (sys.executable, str(FOLDER / script), *map(str, (*words, *to))), table))

    def folder_of(capture: Path, arm: str, share: str = "") -> Path:
        place = out / ("default" if arm == "sundae-auto" else "others")
        return job_folder(place, f"{capture.name}-{arm}-{share}s{SEEDS[0]}")

    add("default", "suite.py", folder, "-o", out / "default", "--arms", "sundae-auto", "--seeds", *SEEDS)
    add("others", "suite.py", folder, "-o", out / "others", "--arms", *OTHERS, "--seeds", SEEDS[0])
    for capture in captures:
        stock = folder_of(capture, "splatfacto") / "splatfacto/splatfacto/run"
        ours = folder_of(capture, "sundae-auto") / "sundae-auto/sundae-auto/run"
        shares = ("--arms", "sundae", "--keep-ratios", *SHARES, "--seeds", SEEDS[0])
        add(f"{capture.name}-curve", "quality.py", capture, "-o", out / "curve" / capture.name, *shares)
        for run in (stock, ours):
            name = f"{capture.name}-formats-{run.parent.name}"
            add(name, "bench_formats.py", run, *theirs, table="formats.csv")
        add(f"{capture.name}-prune", "prune_without_photos.py", stock, *theirs, table="prune.csv")
        timed = ("--arms", *TIMED, "--curve", *LOOKED)
        add(f"{capture.name}-seconds", "bench_training.py", capture, *timed, table="training_time.jsonl")
    for name in ("default", "others", *(f"curve/{capture.name}" for capture in captures)):
        add(f"tables-{name.replace('/', '-')}", "tables.py", "--suite", out / name / "results.jsonl")
    return steps


def record(options: RecordOptions, run: Callable[..., None] = run_logged, console: Console | None = None) -> int:
    """List the commands, or run those that are not done; the exit code, 1 if one failed.

    Raises:
        DataError: the folder holds no capture.
        StorageError: the folder for the runs may not be written.
    """
    console = console or Console()
    captures = sorted(path.parent.parent.resolve() for path in options.folder.glob("*/sparse/0"))
    if not captures:
        raise DataError(f"{options.folder} holds no capture; give the folder that holds the captures")
    out = options.out.resolve()
    check_folder(out, reads=captures, overwrite=True)
    steps = steps_of(captures, out, others=shutil.which("splat-transform") is not None)
    done = {step.name for step in steps if (out / "done" / step.name).is_file()}
    if options.list:
        for step in steps:
            state = "done" if step.name in done else "    "
            console.print(f"{state}  {shlex.join(step.words)}", markup=False, highlight=False, soft_wrap=True)
        return 0
    for name in ("done", "logs", "results"):
        (out / name).mkdir(parents=True, exist_ok=True)
    for step in track(steps, "Record", console=console):
        if step.name in done:
            continue
        try:
            run(step.words, out / "logs" / f"{step.name}.log")
        except KeyboardInterrupt:
            return STOPPED
        except SundaeError as error:
            reason = str(error).strip().splitlines()[-1]
            console.print(f"[red]{step.name} failed: {escape(reason)}", highlight=False, soft_wrap=True)
            continue
        write_text(out / "done" / step.name, shlex.join(step.words) + "\n")
        done.add(step.name)
    left = [step for step in steps if step.name not in done]
    for table in sorted({step.table for step in steps if step.table} - {step.table for step in left}):
        write_text(RESULTS / table, (out / "results" / table).read_text(encoding="utf-8"))
    for script in ("tables.py", "plot.py"):
        run((sys.executable, str(FOLDER / script)), out / "logs" / f"{script}.log")
    return int(bool(left))


if __name__ == "__main__":
    run_script(RecordOptions, __doc__, record)
