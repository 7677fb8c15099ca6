"""``sundae bench quality`` and ``sundae bench paper``: whole comparisons that can be stopped and continued."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TimeElapsedColumn

from sundae_ns.cli.bench.options import PaperOptions, QualityOptions
from sundae_ns.cli.bench.plan import (
    Job,
    Schedule,
    done_file,
    job_folder,
    jobs_of_shard,
    parser_of,
    plan_scene,
    schedule_of,
)
from sundae_ns.cli.bench.recipes import plan_paper
from sundae_ns.cli.bench.results import Result, paper_page, quality_page, read_results, write_results
from sundae_ns.cli.bench.shards import parse_shard
from sundae_ns.cli.process import percent_of, run_logged
from sundae_ns.errors import ConfigError, SundaeError
from sundae_ns.evaluation.document import table
from sundae_ns.storage.atomic import write_text, writing

SAID = "sundae: "
"""How a line begins in which a job says why it ends."""

STOPPED = 130
"""Exit code after an interrupt, as shells have it."""

OnPercent = Callable[[float], object]
Runner = Callable[[Job, Path, OnPercent], None]
"""Does one job, and leaves its result in ``done/``."""


def run_quality(options: QualityOptions, *, runner: Runner | None = None, console: Console | None = None) -> int:
    """Compare arms on one capture; the exit code.

    Args:
        options: those of the command.
        runner: does a job; by default in a process of its own (:func:`spawn`).
        console: to report to.

    Raises:
        ConfigError: an option cannot work, or the folder holds results of other jobs of the same names.
        DataError: there is no such capture.
        StorageError: the folder cannot be written to.
    """
    console, part, schedule = console or Console(), parse_shard(options.shard), _schedule(options)
    data = options.scene.resolve()
    plan = plan_scene(
        data.name,
        data,
        parser_of(data, options.downscale),
        schedule,
        arms=options.arms,
        keep_ratios=options.keep_ratios,
        seeds=options.seeds,
        repeat_at=options.repeat_at,
    )
    own = jobs_of_shard(plan, *part)
    return _list_or_do(own, options, lambda results: quality_page(results, options.command()), runner, console)


def run_paper(options: PaperOptions, *, runner: Runner | None = None, console: Console | None = None) -> int:
    """Measure the paper's scenes; the exit code. Arguments are as in :func:`run_quality`.

    Raises:
        ConfigError, DataError, StorageError: as in :func:`run_quality`.
    """
    console, part, schedule = console or Console(), parse_shard(options.shard), _schedule(options)
    plan, missing = plan_paper(
        options.root.resolve(),
        schedule,
        scenes=options.scenes,
        arms=options.arms,
        keep_ratios=options.keep_ratios,
        seed=options.seed,
    )
    if missing:
        console.print(f"[yellow]Not there, and left out: {', '.join(missing)}", highlight=False)
    own = jobs_of_shard(plan, *part)
    return _list_or_do(own, options, lambda results: paper_page(results, missing, options.command()), runner, console)


def _schedule(options: QualityOptions | PaperOptions) -> Schedule:
    return schedule_of(
        options.method, warmup=options.warmup_steps, finetune=options.finetune_steps, scale=options.steps_scale
    )


def show_jobs(jobs: Sequence[Job], out: Path, console: Console) -> None:
    """List jobs, and which of them are done."""
    done = _finished(out)
    rows = [[job.key, job.method, f"{job.steps:,}", job.needs or "", "done" if job.key in done else ""] for job in jobs]
    for line in table(["job", "method", "steps", "needs", ""], rows):
        console.print(line, highlight=False, soft_wrap=True)
    console.print(f"{len(jobs)} jobs, {sum(job.key in done for job in jobs)} done", highlight=False)


def run_jobs(jobs: Sequence[Job], out: Path, runner: Runner, console: Console) -> dict[str, str]:
    """Do what is not done yet; a job that fails does not keep the others from their turn.

    Returns:
        Why it failed, by key, for each job that did.

    Raises:
        ConfigError: the folder holds another job's result under the same name.
        StorageError: the folder cannot be written to.
    """
    done = _finished(out)
    for job in jobs:
        if job.key in done:
            _check_same(job, done[job.key], out)
    # Results may have come without the runs that they are of, and a branch needs its warm-up itself.
    needed = {job.needs for job in jobs if job.key not in done}
    done = {key: result for key, result in done.items() if key not in needed or done_file(out, key).exists()}
    failed: dict[str, str] = {}
    columns = (*Progress.get_default_columns()[:-1], MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        everything = progress.add_task("Jobs", total=len(jobs))
        for job in jobs:
            if job.key not in done:
                task = progress.add_task(job.key, total=100)
                try:
                    if job.needs in failed:
                        raise SundaeError(f"what it needs has failed: {job.needs}")
                    _describe(job, out)
                    runner(job, out, lambda percent, task=task: progress.update(task, completed=percent))  # type: ignore[misc]
                except SundaeError as error:
                    failed[job.key] = str(error)
                    console.print(f"[red]{job.key} failed:[/red] {error}", highlight=False, soft_wrap=True)
                progress.remove_task(task)
            progress.advance(everything)
    return failed


def spawn(job: Job, out: Path, on_percent: OnPercent) -> None:
    """Do a job in a process of its own, so that its memory, its crash and its random numbers are its own."""

    def on_line(line: str) -> None:
        percent = percent_of(line)
        if percent is not None:
            on_percent(percent)

    # Another shard may wait for the same warm-up meanwhile.
    log = job_folder(out, job.key) / f"log-{os.getpid()}.txt"
    try:
        run_logged([sys.executable, "-m", "sundae_ns.cli.bench.job", str(out), job.key], log, on_line)
    except SundaeError as error:
        *_, last = str(error).splitlines()
        if last.startswith(SAID):  # it ended in one of our own lines, which says all
            raise SundaeError(f"{last.removeprefix(SAID)} (log: {log})") from error
        raise


def _describe(job: Job, out: Path) -> None:
    folder = job_folder(out, job.key)
    with writing(f"cannot make {folder}"):
        folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "job.json", json.dumps(asdict(job)) + "\n")


def _finished(out: Path) -> dict[str, Result]:
    return {result["job"]["key"]: result for result in read_results(out)}


def _check_same(job: Job, result: Result, out: Path) -> None:
    """A result must be of this very job; where its capture lies does not matter."""
    ours, theirs = json.loads(json.dumps(asdict(job))), dict(result["job"])
    odd = [name for name, value in ours.items() if name != "data" and theirs.get(name) != value]
    if odd:
        name = odd[0]
        raise ConfigError(
            f"{out} holds {job.key} with other {name} ({theirs.get(name)}, now {ours[name]}); choose another folder"
        )


def _list_or_do(
    jobs: Sequence[Job],
    options: QualityOptions | PaperOptions,
    page: Callable[[Sequence[Result]], str],
    runner: Runner | None,
    console: Console,
) -> int:
    """List the jobs of this shard, or do them and write the tables; the exit code."""
    out = options.out
    if options.jobs:
        show_jobs(jobs, out, console)
        return 0
    try:
        failed = run_jobs(jobs, out, runner or spawn, console)
    except KeyboardInterrupt:
        console.print("stopped; the same command goes on from here", highlight=False)
        return STOPPED
    results = read_results(out)
    if results:
        write_results(out, results, page(results))
        console.print(f"wrote {out / 'table.md'}, results.csv and results.jsonl", highlight=False, soft_wrap=True)
    if failed:
        console.print(f"{len(failed)} jobs failed; the same command does them again", highlight=False)
    return 1 if failed else 0
