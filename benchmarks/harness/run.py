"""Carry out a comparison: jobs that can be stopped and resumed, and the tables of their results."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, NoReturn

import tyro
from rich.console import Console
from rich.markup import escape
from rich.progress import track

from harness.plan import Job, done_file, job_folder
from harness.results import Result, read_results, write_results
from sundae_ns.cli.main import exit_with
from sundae_ns.cli.process import run_logged
from sundae_ns.cli.refusals import check_folder
from sundae_ns.core.errors import ConfigError, StorageError, SundaeError, writing
from sundae_ns.core.files import write_text

STOPPED = 130
"""Exit code after an interrupt, as in shells."""
START_JOB = "import sys; sys.path[0] = sys.argv.pop(1); from harness.job import main; main()"
"""Program that does one job; its arguments are the folder of this package, that of the comparison, and the key."""
ERROR = "sundae: "
"""Start of the line in which a command reports an error of the package."""

Runner = Callable[[Job, Path], None]
"""Runs one job, which writes its result to ``done/``."""
Page = Callable[[Sequence[Result], Mapping[str, str]], str]
"""Makes the page of all results, and of the reasons of failed jobs by key."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of every comparison."""

    folder: Annotated[Path, tyro.conf.Positional]
    """folder of a capture."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """folder for jobs, results and tables; its finished jobs are not run again."""
    arms: tuple[str, ...] = ()
    """files of arms (.yaml), and names of default arms: those of harness/arms.yaml."""
    keep_ratios: tuple[float, ...] = (0.1,)
    """shares of the warm-up's Gaussians to keep."""
    seeds: tuple[int, ...] = (42,)
    """the first for every job, the others for the shares of --repeat-at."""
    repeat_at: tuple[float, ...] = (0.1,)
    """shares that run with all seeds."""
    method: str = "sundae"
    """method of arms that name none; one of this package that prunes once."""
    downscale: int = 1
    """use the images of images_2, images_4 ... (COLMAP layout)."""
    steps_scale: float = 1.0
    """factor on all lengths, for a trial."""


def check_out(out: Path, *, reads: Iterable[Path]) -> None:
    """Raise ``StorageError`` for a folder that holds something else than a comparison, or belongs to the captures."""
    reads = list(reads)
    if any(out.resolve().is_relative_to(path.resolve()) for path in reads):
        raise StorageError(f"{out} belongs to what the command reads; choose another folder")
    check_folder(out, reads=reads, overwrite=True)
    begun = any((out / name).is_dir() for name in ("jobs", "done")) or any(out.glob("*.jsonl"))
    if out.is_dir() and any(out.iterdir()) and not begun:
        raise StorageError(f"{out} holds files of something else; choose another folder")


def compare(jobs: Sequence[Job], out: Path, page: Page, runner: Runner | None = None, *, whole: bool = False) -> int:
    """Run the jobs and write the tables; the exit code, 1 if a job failed.

    ``whole`` captures are left out once their first job has failed.
    """
    console = Console()
    try:
        failed = run_jobs(jobs, out, runner or spawn, console, whole=whole)
    except KeyboardInterrupt:
        console.print("stopped; the same command resumes", highlight=False)
        return STOPPED
    results = read_results(out)
    if results:
        write_results(out, results, page(results, failed))
        console.print(f"wrote {out / 'table.md'}, results.csv and results.jsonl", highlight=False, soft_wrap=True)
    if failed:
        console.print(f"{len(failed)} jobs failed; the same command runs them again", highlight=False)
    return 1 if failed else 0


def run_jobs(
    jobs: Sequence[Job], out: Path, runner: Runner, console: Console, *, whole: bool = False
) -> dict[str, str]:
    """Run the jobs that are not done, one at a time; a job that fails stops only the jobs that need it.

    Returns the reason of each failure, by key; arguments and errors are those of :func:`compare`.
    """
    done = {result["job"]["key"]: result for result in read_results(out)}
    for job in jobs:
        if job.key in done:
            _check_same(job, done[job.key], out)
    # Results may lie here without their runs, and a branch needs the run of its warm-up.
    needed = {job.needs for job in jobs if job.key not in done}
    done = {key: result for key, result in done.items() if key not in needed or done_file(out, key).exists()}
    first = first_jobs(jobs) if whole else {}
    failed: dict[str, str] = {}
    for job in track(jobs, "Jobs", console=console, transient=True):
        if job.key in done or first.get(job.scene) in failed:
            continue
        try:
            if job.needs in failed:
                raise SundaeError(f"its warm-up has failed: {job.needs}")
            folder = job_folder(out, job.key)
            with writing(f"cannot make {folder}"):
                folder.mkdir(parents=True, exist_ok=True)
            write_text(folder / "job.json", json.dumps(asdict(job)) + "\n")
            runner(job, out)
        except SundaeError as error:
            failed[job.key] = str(error)
            text = f"[red]{escape(job.key)} failed:[/red] {escape(str(error))}"
            console.print(text, highlight=False, soft_wrap=True)
            if first.get(job.scene) == job.key:
                console.print(f"[yellow]Left out: {escape(job.scene)}", highlight=False)
    return failed


def first_jobs(jobs: Sequence[Job]) -> dict[str, str]:
    """Key of the first job of each capture."""
    return {job.scene: job.key for job in reversed(jobs)}


def spawn(job: Job, out: Path) -> None:
    """Run a job in a process of its own: memory, crashes and random numbers stay apart."""
    # Another shard may wait for the same warm-up.
    log = job_folder(out, job.key) / f"log-{os.getpid()}.txt"
    words = [sys.executable, "-c", START_JOB, str(Path(__file__).parents[1]), str(out), job.key]
    code, end = run_logged(words, log)
    if code == 130:
        raise KeyboardInterrupt
    if code:
        *_, last = end.splitlines() or [""]
        if last.startswith(ERROR):  # an error of the package, complete in one line
            raise SundaeError(f"{last.removeprefix(ERROR)} (log: {log})")
        raise SundaeError(f"the job failed with {code}; {log} ends with:\n{end}")


def _check_same(job: Job, result: Result, out: Path) -> None:
    """Refuse the result of another job; the capture may have moved."""
    ours, theirs = json.loads(json.dumps(asdict(job))), dict(result["job"])
    odd = [name for name, value in ours.items() if name != "data" and theirs.get(name) != value]
    if odd:
        name = odd[0]
        raise ConfigError(
            f"{out} holds {job.key} with other {name} ({theirs.get(name)}, now {ours[name]}); give another folder"
        )


def run_script(parsed: Callable[..., Any], description: str | None, run: Callable[[Any], int] = int) -> NoReturn:
    """Parse the command line into the arguments of a function or a class, and exit with the code that ``run`` returns.

    Errors of the package are printed on one line, as by ``sundae``.
    """
    prog = Path(sys.argv[0]).name
    exit_with(lambda: run(tyro.cli(parsed, prog=prog, description=description)), prog)
