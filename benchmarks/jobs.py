"""Run a list of commands on several GPUs, several on each, in order of priority.

    python benchmarks/rules.py --scene fox --data DIR --steps 15000 --missing > jobs.jsonl
    python benchmarks/jobs.py jobs.jsonl --gpus 0 1 --per-gpu 5 --seconds 1500

A line of the file is an object: ``name``, ``command`` and, where they matter, ``needs`` (names of jobs that must have ended
well, or paths that must exist), ``gpu`` (the only one to run on), ``alone`` (nothing else runs on that GPU meanwhile, as for
what is timed) and ``seconds`` (it is not started with less than that left). What runs when the time is over is ended. Logs
are in ``STATE/logs``; ``STATE/done`` has a file for each job that ended well, which is not run again. The exit code is 1 if
a job failed or was ended.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn


@dataclass
class Job:
    """One command."""

    name: str
    command: str
    needs: list[str] = field(default_factory=list)
    gpu: int | None = None
    alone: bool = False
    seconds: float = 0.0


@dataclass
class Running:
    job: Job
    gpu: int
    process: subprocess.Popen[bytes]
    since: float


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("jobs", type=Path, help="JSON lines")
    parser.add_argument("--gpus", type=int, nargs="+", default=[0])
    parser.add_argument("--per-gpu", type=int, default=1)
    parser.add_argument("--threads", type=int, default=2, help="OMP_NUM_THREADS of each job")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="time for all of them")
    parser.add_argument("--state", type=Path, default=Path("outputs/jobs"))
    return parser.parse_args()


def read(path: Path, gpus: list[int]) -> list[Job]:
    """Jobs of a file of JSON lines."""
    jobs = [Job(**json.loads(line)) for line in path.read_text().splitlines() if line.strip()]
    for job in jobs:
        if job.gpu is not None and job.gpu not in gpus:
            raise SystemExit(
                f"{job.name} is to run on GPU {job.gpu}, which is not of --gpus; add it there, or change the job"
            )
    return jobs


class Queue:
    """What waits, what runs, and what has ended."""

    def __init__(self, jobs: list[Job], options: argparse.Namespace) -> None:
        self.options = options
        self.started = time.monotonic()
        self.done = options.state / "done"
        self.logs = options.state / "logs"
        for folder in (self.done, self.logs):
            folder.mkdir(parents=True, exist_ok=True)
        self.waiting = [job for job in jobs if not (self.done / job.name).exists()]
        self.running: list[Running] = []
        self.failed: list[str] = []

    @property
    def left(self) -> float:
        """Seconds until the time is over."""
        return float(self.options.seconds - (time.monotonic() - self.started))

    def ready(self, job: Job) -> bool:
        return all((self.done / need).exists() or Path(need).exists() for need in job.needs)

    def hopeless(self, job: Job) -> bool:
        """Whether it will never start: what it needs has failed, or it would not end in time."""
        return bool(set(job.needs) & set(self.failed)) or job.seconds > self.left

    def start(self) -> None:
        """Start what can start, in order; a GPU on which one is to run alone gets no others to wait for."""
        load = {gpu: [r for r in self.running if r.gpu == gpu] for gpu in self.options.gpus}
        kept = {r.gpu for r in self.running if r.job.alone}
        for job in list(self.waiting):
            if self.hopeless(job):
                self.waiting.remove(job)
                self.failed.append(job.name)
                CONSOLE.print(f"[yellow]{job.name} is left out: too late, or what it needs has failed", soft_wrap=True)
                continue
            allowed = [gpu for gpu in self.options.gpus if gpu not in kept and job.gpu in (None, gpu)]
            if not allowed or not self.ready(job):
                continue
            gpu = min(allowed, key=lambda gpu: len(load[gpu]))
            if job.alone:
                kept.add(gpu)
            if len(load[gpu]) < (1 if job.alone else self.options.per_gpu):
                self.waiting.remove(job)
                self.running.append(self._started(job, gpu))
                load[gpu].append(self.running[-1])

    def _started(self, job: Job, gpu: int) -> Running:
        threads = str(self.options.threads)
        environment = {**os.environ, "CUDA_VISIBLE_DEVICES": str(gpu), "OMP_NUM_THREADS": threads}
        with open(self.logs / f"{job.name}.log", "ab") as log:
            process = subprocess.Popen(
                job.command, shell=True, env=environment, stdout=log, stderr=log, start_new_session=True
            )
        return Running(job, gpu, process, time.monotonic())

    def collect(self) -> int:
        """Take note of what has ended; how many ended."""
        over = [r for r in self.running if r.process.poll() is not None]
        for r in over:
            self.running.remove(r)
            took = f"after {time.monotonic() - r.since:.0f} s on GPU {r.gpu}"
            if r.process.returncode == 0:
                (self.done / r.job.name).touch()
                CONSOLE.print(f"{r.job.name} {took}")
            else:
                self.failed.append(r.job.name)
                CONSOLE.print(f"[red]{r.job.name} failed ({r.process.returncode}) {took}")
        return len(over)

    def end(self) -> None:
        """End what still runs, with all that it has started."""
        self.collect()
        for r in self.running:
            os.killpg(r.process.pid, signal.SIGTERM)
        for r in self.running:
            try:
                r.process.wait(timeout=10)
            except subprocess.TimeoutExpired:
                pass
            with suppress(ProcessLookupError):  # those that it started may take no notice of the first signal
                os.killpg(r.process.pid, signal.SIGKILL)
            self.failed.append(r.job.name)
            CONSOLE.print(f"[yellow]{r.job.name} was ended: the time is over")
        self.running.clear()


def main() -> int:
    options = parse()
    queue = Queue(read(options.jobs, options.gpus), options)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that what was started is ended too
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=CONSOLE, transient=True) as progress:
        task = progress.add_task("Jobs", total=len(queue.waiting))
        try:
            while queue.waiting or queue.running:
                if queue.left <= 0:
                    break
                queue.start()
                if queue.waiting and not queue.running and not any(map(queue.ready, queue.waiting)):
                    names = ", ".join(job.name for job in queue.waiting)
                    CONSOLE.print(f"[red]nothing makes what these need: {names}", soft_wrap=True)
                    queue.failed += [job.name for job in queue.waiting]
                    break
                time.sleep(0.2)
                progress.advance(task, queue.collect())
        finally:
            queue.end()
    return 1 if queue.failed or queue.waiting else 0


if __name__ == "__main__":
    raise SystemExit(main())
