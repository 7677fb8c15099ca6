"""``sundae bench quality``, ``suite`` and ``paper``: comparisons that can be stopped and resumed."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.progress import MofNCompleteColumn, Progress, TimeElapsedColumn

from sundae_ns.cli.bench.arms import choose_arms
from sundae_ns.cli.bench.options import ComparisonOptions, PaperOptions, QualityOptions, SuiteOptions
from sundae_ns.cli.bench.paper import plan_paper
from sundae_ns.cli.bench.plan import SAID, Job, done_file, job_folder, jobs_of_shard, parser_of, plan_scene
from sundae_ns.cli.bench.results import Result, paper_page, quality_page, read_results, suite_page, write_results
from sundae_ns.cli.bench.suite import plan_suite
from sundae_ns.cli.outputs import check_comparison
from sundae_ns.cli.process import percent_of, run_logged
from sundae_ns.errors import ConfigError, SundaeError
from sundae_ns.evaluation.document import table
from sundae_ns.storage.atomic import write_text, writing

STOPPED = 130
"""Exit code after an interrupt, as in shells."""

OnPercent = Callable[[float], object]
Runner = Callable[[Job, Path, OnPercent], None]
"""Runs one job, which writes its result to ``done/``."""


def run_quality(options: QualityOptions, *, runner: Runner | None = None, console: Console | None = None) -> int:
    """Compare arms on one capture; the exit code.

    Args:
        options: those of the command.
        runner: runs a job; by default in a process of its own (:func:`spawn`).
        console: for progress and messages.

    Raises:
        ConfigError: an option or an arm cannot work, or the folder holds results of other jobs with the same names.
        DataError: the folder is no capture.
        StorageError: the folder cannot be written to.
    """
    console, arms = console or Console(), choose_arms(options.arms, options.method, options.steps_scale)
    check_comparison(options.out, reads=[options.scene])
    data = options.scene.resolve()
    plan = plan_scene(
        data.name,
        data,
        parser_of(data, options.downscale),
        arms,
        keep_ratios=options.keep_ratios,
        seeds=options.seeds,
        repeat_at=options.repeat_at,
    )

    def page(results: Sequence[Result], failed: Mapping[str, str]) -> str:
        return quality_page(results, arms, options.command())

    return _list_or_run(jobs_of_shard(plan, options.shard), options, page, runner, console)


def run_suite(options: SuiteOptions, *, runner: Runner | None = None, console: Console | None = None) -> int:
    """Measure all methods on every capture of a folder; the exit code, 1 if a capture or a job is left out.

    Arguments are as in :func:`run_quality`.

    Raises:
        ConfigError, StorageError: as in :func:`run_quality`.
        DataError: the folder is none of captures.
    """
    console = console or Console()
    arms = choose_arms(options.arms, options.method, options.steps_scale, from_scratch=True)
    check_comparison(options.out, reads=[options.captures])
    plan, left_out = plan_suite(options, arms)
    for scene, reason in left_out.items():
        console.print(f"[yellow]Left out: {escape(f'{scene}: {reason}')}", highlight=False, soft_wrap=True)

    jobs = jobs_of_shard(plan, options.shard)
    captures = {key: scene for scene, key in _first_jobs(jobs).items()}

    def page(results: Sequence[Result], failed: Mapping[str, str]) -> str:
        reasons = {captures.get(key, key): reason for key, reason in failed.items()}
        return suite_page(results, arms, {**left_out, **reasons}, options.command())

    code = _list_or_run(jobs, options, page, runner, console, whole_captures=True)
    return code or int(bool(left_out))


def run_paper(options: PaperOptions, *, runner: Runner | None = None, console: Console | None = None) -> int:
    """Measure the paper's scenes; the exit code. Arguments are as in :func:`run_quality`.

    Raises:
        ConfigError, DataError, StorageError: as in :func:`run_quality`.
    """
    console, arms = console or Console(), choose_arms(options.arms, options.method, options.steps_scale)
    plan, missing = plan_paper(
        options.root.resolve(), arms, scenes=options.scenes, keep_ratios=options.keep_ratios, seed=options.seed
    )
    check_comparison(options.out, reads=[Path(job.data) for job in plan])
    if missing:
        console.print(f"[yellow]Scenes that are missing and left out: {escape(', '.join(missing))}", highlight=False)

    def page(results: Sequence[Result], failed: Mapping[str, str]) -> str:
        return paper_page(results, arms, missing, options.command())

    return _list_or_run(jobs_of_shard(plan, options.shard), options, page, runner, console)


def show_jobs(jobs: Sequence[Job], out: Path, console: Console) -> None:
    """List jobs, and mark finished ones."""
    done = _finished(out)
    rows = [[job.key, job.method, f"{job.steps:,}", job.needs or "", "done" if job.key in done else ""] for job in jobs]
    for line in table(["job", "method", "steps", "needs", ""], rows):
        console.print(line, highlight=False, soft_wrap=True)
    console.print(f"{len(jobs)} jobs, {sum(job.key in done for job in jobs)} done", highlight=False)


def run_jobs(
    jobs: Sequence[Job], out: Path, runner: Runner, console: Console, *, whole_captures: bool = False
) -> dict[str, str]:
    """Run the jobs that are not done, one at a time; a job that fails stops only the jobs that need it.

    Args:
        jobs: in an order in which each comes after the one that it needs.
        out: folder of the comparison.
        runner: runs a job.
        console: for progress and messages.
        whole_captures: leave a capture out whose first job fails: it is damaged, or too large for this machine.

    Returns:
        The reason of each failure, by key.

    Raises:
        ConfigError: the folder holds the result of another job under the same name.
        StorageError: the folder cannot be written to.
    """
    done = _finished(out)
    for job in jobs:
        if job.key in done:
            _check_same(job, done[job.key], out)
    # Results may lie here without their runs, and a branch needs the run of its warm-up.
    needed = {job.needs for job in jobs if job.key not in done}
    done = {key: result for key, result in done.items() if key not in needed or done_file(out, key).exists()}
    first = _first_jobs(jobs) if whole_captures else {}
    failed: dict[str, str] = {}
    columns = (*Progress.get_default_columns()[:-1], MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        everything = progress.add_task("Jobs", total=len(jobs))
        for job in jobs:
            if job.key not in done and first.get(job.scene) not in failed:
                task = progress.add_task(escape(job.key), total=100)
                try:
                    if job.needs in failed:
                        raise SundaeError(f"its warm-up has failed: {job.needs}")
                    _describe(job, out)
                    runner(job, out, lambda percent, task=task: progress.update(task, completed=percent))  # type: ignore[misc]
                except SundaeError as error:
                    failed[job.key] = str(error)
                    text = f"[red]{escape(job.key)} failed:[/red] {escape(str(error))}"
                    console.print(text, highlight=False, soft_wrap=True)
                    if first.get(job.scene) == job.key:
                        console.print(f"[yellow]Left out: {escape(job.scene)}", highlight=False)
                progress.remove_task(task)
            progress.advance(everything)
    return failed


def _first_jobs(jobs: Sequence[Job]) -> dict[str, str]:
    """Key of the first job of each capture."""
    return {job.scene: job.key for job in reversed(jobs)}


def spawn(job: Job, out: Path, on_percent: OnPercent) -> None:
    """Run a job in a process of its own: memory, crashes and random numbers stay apart."""

    def on_line(line: str) -> None:
        percent = percent_of(line)
        if percent is not None:
            on_percent(percent)

    # Another shard may wait for the same warm-up.
    log = job_folder(out, job.key) / f"log-{os.getpid()}.txt"
    try:
        run_logged([sys.executable, "-m", "sundae_ns.cli.bench.job", str(out), job.key], log, on_line)
    except SundaeError as error:
        *_, last = str(error).splitlines()
        if last.startswith(SAID):  # an error of this package, complete in one line
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
    """Refuse the result of another job; the capture may have moved."""
    ours, theirs = json.loads(json.dumps(asdict(job))), dict(result["job"])
    odd = [name for name, value in ours.items() if name != "data" and theirs.get(name) != value]
    if odd:
        name = odd[0]
        raise ConfigError(
            f"{out} holds {job.key} with other {name} ({theirs.get(name)}, now {ours[name]}); give another folder"
        )


def _list_or_run(
    jobs: Sequence[Job],
    options: ComparisonOptions,
    page: Callable[[Sequence[Result], Mapping[str, str]], str],
    runner: Runner | None,
    console: Console,
    *,
    whole_captures: bool = False,
) -> int:
    """List the jobs, or run them and write the tables; the exit code."""
    out = options.out
    if options.jobs:
        show_jobs(jobs, out, console)
        return 0
    try:
        failed = run_jobs(jobs, out, runner or spawn, console, whole_captures=whole_captures)
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
