"""Kill training with SIGKILL, resume it, and compare what comes out with an undisturbed run; print one JSON line.

    python benchmarks/kill_and_resume.py                      # 20 kills: while saving, while pruning, at any time
    python benchmarks/kill_and_resume.py --kills 3 --seed 1

Every run is nerfstudio's own training command on a ray-traced scene, in a process of its own. A server process without
threads imports nerfstudio once and forks the runs. Exits with 1 if any resumed run ended differently.
"""

from __future__ import annotations

import argparse
import io
import json
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from copy import deepcopy
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import torch
import tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.scripts import train
from ray_tracing import write_still_life
from rich.progress import track

import sundae_ns.pruning.cutting
import sundae_ns.storage.atomic
import sundae_ns.storage.runs.checkpoint
import sundae_ns.training.report
from sundae_ns.errors import CheckpointError

STEPS, SAVE_EVERY, PRUNE_AT = 70, 12, 36
LONGEST = 600.0
"""Seconds after which a run counts as hanging; it takes about ten."""

# This process has threads (a progress bar's, torch's): a run forked off it could wait for ever for a lock of theirs.
SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload(["nerfstudio.scripts.train", "sundae_ns.model", "sundae_ns.trainer"])

OPTIONS = f"""
--experiment-name e --timestamp t --max-num-iterations {STEPS} --steps-per-save {SAVE_EVERY} --vis tensorboard
--viewer.quit-on-train-completion True --steps-per-eval-image 25 --pipeline.model.pruning.prune-at {PRUNE_AT}
--pipeline.model.warmup-length 5 --pipeline.model.refine-every 10 --pipeline.model.densify-grad-thresh 0.0004
--pipeline.model.sh-degree-interval 20
""".split()


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def after(calls: int, module: Any, name: str, place: Callable[[Callable[..., Any]], Callable[..., Any]]) -> None:
    """Replace ``module.name`` by ``place(original)`` from its ``calls``-th call on."""
    original, seen = getattr(module, name), [0]

    def wrapper(*arguments: Any, **options: Any) -> Any:
        seen[0] += 1
        return (place(original) if seen[0] >= calls else original)(*arguments, **options)

    setattr(module, name, wrapper)


def at_once(original: Callable[..., Any]) -> Callable[..., Any]:
    return lambda *_, **__: die()


def when_done(original: Callable[..., Any]) -> Callable[..., Any]:
    def call(*arguments: Any, **options: Any) -> None:
        original(*arguments, **options)
        die()

    return call


def half_saved(original: Callable[..., Any]) -> Callable[..., Any]:
    def call(state: Any, file: Any) -> None:
        whole = io.BytesIO()
        original(state, whole)
        file.write(whole.getvalue()[: len(whole.getvalue()) // 2])
        file.flush()
        die()

    return call


def half_recorded(original: Callable[..., Any]) -> Callable[..., Any]:
    def call(path: Path, text: str) -> None:
        with sundae_ns.storage.atomic.replacing(path) as partial:
            partial.write_text(text[: len(text) // 2])
            die()

    return call


PLACES: dict[str, Callable[[int], None]] = {
    "save: half written": lambda n: after(n, sundae_ns.storage.runs.checkpoint.torch, "save", half_saved),
    "save: not yet on the disk": lambda n: after(3 * n, sundae_ns.storage.atomic, "flush", at_once),
    "save: the older one not yet gone": lambda n: after(n, sundae_ns.storage.runs.checkpoint, "write", when_done),
    "prune: deciding": lambda n: after(1, sundae_ns.pruning.cutting, "decide", at_once),
    "prune: sliced": lambda n: after(1, sundae_ns.pruning.cutting, "keep", when_done),
    "prune: half recorded": lambda n: after(1, sundae_ns.training.report, "write_text", half_recorded),
}
ANY = "any time"


def plan(kills: int, rng: random.Random) -> list[str]:
    """Places of the kills: one at each, then random ones; half of the rest at any time."""
    places = [ANY, *PLACES][:kills]
    while len(places) < kills:
        places.append(ANY if len(places) % 2 else rng.choice(list(PLACES)))
    return places


def train_here(config: TrainerConfig, log: Path, place: str | None, nth: int) -> None:
    """Train in this process, with its output in ``log``; die the ``nth`` time that ``place`` is reached."""
    torch.set_num_threads(1)
    with open(log, "a") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    if place is not None:
        PLACES[place](nth)
    train.main(config)


def start(config: TrainerConfig, log: Path, place: str | None = None, nth: int = 1) -> BaseProcess:
    """Train in a new process."""
    child = SERVER.Process(target=train_here, args=(config, log, place, nth))
    child.start()
    return child


def ended(child: BaseProcess, log: Path) -> int:
    """Wait for a process; its exit code, or minus the signal that ended it."""
    child.join(LONGEST)
    if child.exitcode is None:
        child.kill()
        child.join()
        raise SystemExit(f"a run did not end within {LONGEST} s; the end of its log:\n{log.read_text()[-3000:]}")
    return child.exitcode


def finish(child: BaseProcess, log: Path) -> None:
    code = ended(child, log)
    if code != 0:
        raise SystemExit(f"a run failed with exit code {code}; the end of its log:\n{log.read_text()[-3000:]}")


def was_killed(child: BaseProcess, log: Path) -> bool:
    """Wait for a process; whether it was killed."""
    return ended(child, log) == -signal.SIGKILL


def kill_at_any_time(config: TrainerConfig, log: Path, seconds: float, rng: random.Random) -> bool:
    """Start a run that takes about ``seconds``, and kill it; try again if it ended before. Whether it was killed."""
    for _ in range(10):
        child = start(config, log)
        time.sleep(rng.uniform(0.0, seconds))
        child.kill()
        if was_killed(child, log):
            return True
        shutil.rmtree(run_folder(config))
        seconds *= 0.8  # the machine has become faster
    return False


def run_folder(config: TrainerConfig) -> Path:
    return Path(config.output_dir) / "e" / "sundae-tiny" / "t"


def outcome(folder: Path) -> dict[str, Any]:
    """Result of a finished run: tensors of the final checkpoint, the record of its prune, and names of its files."""
    models = folder / "nerfstudio_models"
    state = sundae_ns.storage.runs.checkpoint.read(models / f"step-{STEPS - 1:09d}.ckpt")
    prunes = json.loads((folder / "prune.json").read_text())
    return {
        "tensors": {name: value for name, value in state["pipeline"].items() if isinstance(value, torch.Tensor)},
        "prunes": [{key: prune[key] for key in ("step", "before", "after", "warm_up", "pruned")} for prune in prunes],
        "files": sorted(path.name for path in models.iterdir()),
    }


def same_tensors(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="folder to work in; a temporary one by default")
    options = parser.parse_args()
    rng = random.Random(options.seed)
    root = options.out or Path(tempfile.mkdtemp(prefix="kill-and-resume-"))
    root.mkdir(parents=True, exist_ok=True)
    log = root / "log"
    write_still_life(root / "scene", train_views=8, test_views=2, width=64, height=64, points=300, samples=1)
    arguments = ["sundae-tiny", "--data", str(root / "scene"), *OPTIONS]
    parsed = tyro.cli(AnnotatedBaseConfigUnion, args=arguments)

    def configured(name: str) -> TrainerConfig:
        config = deepcopy(parsed)
        config.output_dir = root / name
        return config

    whole = configured("whole")
    finish(start(whole, log), log)
    began = time.monotonic()
    expected = configured("again")  # again: the time of a run, and whether the same seed gives the same
    finish(start(expected, log), log)
    seconds = time.monotonic() - began
    reference, again = outcome(run_folder(whole)), outcome(run_folder(expected))
    repeatable = same_tensors(reference["tensors"], again["tensors"]) and reference["prunes"] == again["prunes"]

    tally: Counter[str] = Counter()
    places = plan(options.kills, rng)
    for number, place in enumerate(track(places, description="Killing and resuming", transient=True)):
        config = configured(f"killed-{number}")
        models = run_folder(config) / "nerfstudio_models"
        nth = rng.randint(1, STEPS // SAVE_EVERY)
        if place == ANY:
            killed = kill_at_any_time(config, log, seconds, rng)
        else:
            killed = was_killed(start(config, log, place, nth), log)
        tally["killed"] += killed
        tally[f"at {place}"] += killed
        try:
            newest, _ = sundae_ns.storage.runs.checkpoint.newest_whole(models)
            done = int(newest.stem.partition("-")[2]) + 1
            tally["resumed" if done < STEPS else "killed after the last save"] += 1
        except CheckpointError:
            done = 0
            tally["killed before the first save, so started anew"] += 1
        if done < STEPS:
            resumed = configured(f"killed-{number}")
            resumed.max_num_iterations = STEPS - done
            resumed.load_dir = models if done else None
            finish(start(resumed, log), log)
        found = outcome(run_folder(config))
        tally["same count"] += found["prunes"] == reference["prunes"] and len(found["prunes"]) == 1
        tally["bit for bit the same"] += same_tensors(found["tensors"], reference["tensors"])
        tally["nothing left lying"] += done == STEPS or found["files"] == reference["files"]

    result = {
        "kills": options.kills,
        "steps": STEPS,
        "save_every": SAVE_EVERY,
        "prune_at": PRUNE_AT,
        "primitives": [reference["prunes"][0]["before"], reference["prunes"][0]["after"]],
        "same seed, same result": repeatable,
        **tally,
    }
    print(json.dumps(result))
    if options.out is None:
        shutil.rmtree(root)
    always = ("killed", "same count", "bit for bit the same", "nothing left lying")
    sys.exit(0 if repeatable and all(tally[name] == options.kills for name in always) else 1)


if __name__ == "__main__":
    main()
