"""Kill trainings and commands with SIGKILL, repeat them, and compare with undisturbed ones; print a JSON line a kind.

    python benchmarks/kill_and_resume.py                       # all kinds on a CPU: 20 + 10 + 24 kills
    python benchmarks/kill_and_resume.py --kinds training --kills 3 --seed 1
    python benchmarks/kill_and_resume.py --kinds training trials --device cuda             # recorded steps
    python benchmarks/kill_and_resume.py --kinds training --device cuda --gpus 2           # at any time, any process

- ``training``: while saving, while pruning, at any time.
- ``trials``: the same in the trials of a head and of a length.
- ``commands``: prune, pack and export over an older result: while the file is written, before it is renamed, at any
  time. Afterwards the older result or the whole new one must be there, and the same command must succeed.

Every run is nerfstudio's own training command, or one of sundae, on a ray-traced scene, in a process of its own. A
server process without threads imports nerfstudio once and forks the runs. Exits with 1 if anything was lost. On a CPU a
resumed run must be the same bit for bit. On CUDA sums have no fixed order, so that runs of one seed differ and may even
decide differently: there its test views must be as good as those of two undisturbed runs, less ``SPREAD`` dB.
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import torch
import tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
from nerfstudio.engine.trainer import TrainerConfig
from rich.progress import track

import sundae_ns as sn
from harness import killing
from harness.processes import Bench, command_here, train_here
from harness.still_life import write_still_life
from sundae_ns.core.errors import CheckpointError
from sundae_ns.io import checkpoint
from sundae_ns.plugin.camera_models import camera_of
from sundae_ns.plugin.finished_runs import load_model

SPREAD = 3.0
"""Decibels that a resumed run on CUDA may be below the worse of two undisturbed ones."""
ANY = "any time"


@dataclass(frozen=True)
class Training:
    """A training that is killed."""

    steps: int
    save_every: int
    places: dict[str, killing.Place]
    options: str

    def words(self, scene: Path) -> list[str]:
        """Arguments of ``ns-train``."""
        own = f"--max-num-iterations {self.steps} --steps-per-save {self.save_every} {self.options}"
        return ["sundae-tiny", "--data", str(scene), *COMMON.split(), *own.split()]


COMMON = """
--experiment-name e --timestamp t --viewer.quit-on-train-completion True --viewer.websocket-host 127.0.0.1
--steps-per-eval-image 25 --pipeline.model.warmup-length 5 --pipeline.model.refine-every 10
--pipeline.model.densify-grad-thresh 0.0004 --pipeline.model.sh-degree-interval 20
"""
TRAININGS = {
    "training": Training(70, 12, killing.TRAINING, "--vis tensorboard --pipeline.model.pruning.prune-at 36"),
    # Trials begin at the prune. With eight views each candidate is tried twice, for four steps.
    "trials": Training(
        160,
        9,
        killing.TRIALS,
        "--vis tensorboard --pipeline.model.pruning.prune-at 40 --pipeline.model.head.mode auto",
    ),
}
KILLS = {"training": 20, "trials": 10, "commands": 24}


# ------------------------------------------------------------------------------------------------------------ trainings


def run_folder(config: TrainerConfig) -> Path:
    return Path(config.output_dir) / "e" / "sundae-tiny" / "t"


def outcome(folder: Path, steps: int) -> dict[str, Any]:
    """Result of a finished run: tensors of the final checkpoint, its records, and names of its files."""
    models = folder / "nerfstudio_models"
    (last,) = models.glob(f"step-*{steps - 1}.ckpt")
    prunes = json.loads((folder / "prune.json").read_text())
    state = checkpoint.read(last)
    return {
        "tensors": {name: value for name, value in state["pipeline"].items() if isinstance(value, torch.Tensor)},
        "prunes": [{key: prune[key] for key in ("step", "before", "after", "warm_up", "pruned")} for prune in prunes],
        "trials": {path.name: json.loads(path.read_text()) for path in folder.glob("trials.json")},
        "files": sorted(path.name for path in models.iterdir()),
    }


def same_tensors(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def quality(run: Path) -> float:
    """PSNR of the test views, dB."""
    opened = load_model(run)
    cameras = [camera_of(camera, opened.model.device) for camera in opened.cameras]
    return sn.measure(sn.load(run, device=opened.model.device), opened.truths, cameras).psnr


def kill_trainings(kind: str, options: argparse.Namespace, bench: Bench, root: Path, kills: int) -> dict[str, Any]:
    """Kill trainings of one kind; what came of it, with ``lost`` for the number of those that ended otherwise."""
    what, rng = TRAININGS[kind], random.Random(options.seed)
    scene = root / "scene"
    if not scene.exists():
        write_still_life(scene, train_views=8, test_views=2, width=64, height=64, points=300, samples=1)
    parsed = tyro.cli(AnnotatedBaseConfigUnion, args=what.words(scene))
    parsed.machine.device_type, parsed.machine.num_devices = options.device, options.gpus
    exact = options.device == "cpu"

    def configured(name: str) -> TrainerConfig:
        config = deepcopy(parsed)
        config.output_dir = root / kind / name
        return config

    def started(config: TrainerConfig, place: str | None = None, nth: int = 1) -> BaseProcess:
        return bench.start(train_here, config, bench.log, place, nth)

    def trained(config: TrainerConfig) -> float:
        began = time.monotonic()
        bench.finish(started(config))
        return time.monotonic() - began

    whole, second = configured("whole"), configured("again")
    trained(whole)
    seconds = trained(second)  # again: the time of a run, and whether the same seed gives the same
    reference, repeated = (outcome(run_folder(config), what.steps) for config in (whole, second))
    repeatable = not exact or all(
        (same_tensors(reference["tensors"], repeated["tensors"]), reference["prunes"] == repeated["prunes"])
    )
    undisturbed = [] if exact else [quality(run_folder(config)) for config in (whole, second)]

    tally: Counter[str] = Counter()
    lost = 0
    resumed_psnr: list[float] = []
    decisions: Counter[str] = Counter()
    # One kill at each place, then random ones; half of the rest at any time. Ranks have modules of their own.
    every = [ANY, *(what.places if options.gpus == 1 else ())]
    # A seed starts where those before it end, so that short calls reach every place.
    numbers = range(options.seed * kills, (options.seed + 1) * kills)
    places = [every[i] if i < len(every) else ANY if i % 2 else rng.choice(every) for i in numbers]
    for number, place in enumerate(track(places, description=f"Killing: {kind}", transient=True)):
        config = configured(f"killed-{number}")
        folder = run_folder(config)
        models = folder / "nerfstudio_models"
        nth = rng.randint(1, 5)
        if place == ANY:
            again = partial(shutil.rmtree, folder)
            killed = bench.killed_at_any_time(partial(started, config), again, seconds, rng)
        else:
            killed = bench.ended(started(config, place, nth)) == -signal.SIGKILL
        tally["killed"] += killed
        tally[f"at {place}"] += killed
        try:
            done = int(checkpoint.newest_whole(models)[0].stem.partition("-")[2]) + 1
            tally["resumed" if done < what.steps else "killed after the last save"] += 1
        except CheckpointError:
            done = 0
            tally["killed before the first save, so started anew"] += 1
        if done < what.steps:
            resumed = configured(f"killed-{number}")
            resumed.max_num_iterations = what.steps - done
            resumed.load_dir = models if done else None
            trained(resumed)
        found = outcome(folder, what.steps)
        one_prune = len(found["prunes"]) == 1 and found["prunes"][0]["step"] == reference["prunes"][0]["step"]
        clean = done == what.steps or found["files"] == reference["files"]
        if exact:
            same = same_tensors(found["tensors"], reference["tensors"])
            same = same and found["prunes"] == reference["prunes"] and found["trials"] == reference["trials"]
        else:
            resumed_psnr.append(quality(folder))
            same = resumed_psnr[-1] > min(undisturbed) - SPREAD
        decisions[found["trials"].get("trials.json", {}).get("head", {}).get("decision", "")] += 1
        for name, held in (("one prune", one_prune), ("the same result", same), ("nothing left lying", clean)):
            tally[name] += held
        lost += not (killed and one_prune and same and clean)
        shutil.rmtree(config.output_dir)
    about = {
        "steps": what.steps,
        "save_every": what.save_every,
        "primitives": [reference["prunes"][0]["before"], reference["prunes"][0]["after"]],
        **({"decision": reference["trials"]["trials.json"]["head"]["decision"]} if kind == "trials" else {}),
        **({"decisions after kills": decisions} if kind == "trials" and not exact else {}),
        "same seed, same result": repeatable if exact else None,
        **({} if exact else {"psnr, undisturbed": undisturbed, "psnr, resumed": resumed_psnr}),
    }
    return {**about, **tally, "lost": lost + (not repeatable)}


# ------------------------------------------------------------------------------------------------------------- commands


def commands(run: Path, ply: Path) -> dict[str, list[str]]:
    """Commands that write, without their output, by its name."""
    return {
        "pruned.ply": ["prune", str(ply), "--num-cameras", "8"],
        "pruned.sundae": ["prune", str(run), "--num-cameras", "8"],
        "packed.sundae": ["pack", str(run)],
        "tuned.sundae": ["pack", str(run), "--finetune", "10"],
        "page.html": ["export", str(run)],
        "page": ["export", str(run)],
        "viewers.spz": ["export", str(run)],
        "viewers.sog": ["export", str(ply)],
    }


def contents(folder: Path) -> dict[str, bytes]:
    """Contents of all files below a folder, by their paths."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def write_all(folder: Path, files: Mapping[str, bytes]) -> None:
    """Counterpart of :func:`contents`."""
    for path, content in files.items():
        (folder / path).write_bytes(content)


def is_whole(path: Path) -> bool:
    """Whether a page ends as pages do, or a scene opens."""
    if path.suffix == ".html":
        return path.read_bytes().rstrip().endswith(b"</html>")
    try:
        return sn.load(path).num_gaussians > 0
    except sn.SundaeError:
        return False


def kill_commands(options: argparse.Namespace, bench: Bench, root: Path, kills: int) -> dict[str, Any]:
    """Kill commands that write over older results; as :func:`kill_trainings`."""
    rng, folder, exact = random.Random(options.seed), root / "commands", not torch.cuda.is_available()
    scene = write_still_life(folder / "scene", train_views=8, test_views=2, width=64, height=64, points=300, samples=1)
    config = tyro.cli(AnnotatedBaseConfigUnion, args=TRAININGS["training"].words(scene))
    config.output_dir, config.machine.device_type = folder / "out", options.device
    bench.finish(bench.start(train_here, config, bench.log, None, 1))
    ply = folder / "scene.ply"
    bench.finish(bench.start(command_here, ["export", str(run_folder(config)), "-o", str(ply)], bench.log, None))
    jobs = commands(run_folder(config), ply)

    def place_of(name: str) -> Path:
        return folder / "written" / name.replace(".", "-")

    def begin(name: str, place: str | None = None) -> BaseProcess:
        words = [*jobs[name], "-o", str(place_of(name) / name), "--overwrite"]
        return bench.start(command_here, words, bench.log, place)

    fresh: dict[str, dict[str, bytes]] = {}
    seconds: dict[str, float] = {}
    for name in jobs:
        place_of(name).mkdir(parents=True)
        began = time.monotonic()
        bench.finish(begin(name))
        seconds[name] = time.monotonic() - began
        fresh[name] = contents(place_of(name))

    tally: Counter[str] = Counter()
    lost = 0
    every = [ANY, *killing.COMMANDS]
    numbers = range(options.seed * kills, (options.seed + 1) * kills)
    for number in track(numbers, description="Killing: commands", transient=True):
        name, place = list(jobs)[number % len(jobs)], every[(number // len(jobs)) % len(every)]
        older = dict.fromkeys(fresh[name], b"older")
        age = partial(write_all, place_of(name), older)
        age()
        if place == ANY:
            killed = bench.killed_at_any_time(partial(begin, name), age, seconds[name], rng)
        else:
            killed = bench.ended(begin(name, place)) == -signal.SIGKILL
        found = contents(place_of(name))
        kept = all(
            found.get(path) in (older[path], fresh[name][path]) or (not exact and is_whole(place_of(name) / path))
            for path in older
        )
        bench.finish(begin(name))
        last = contents(place_of(name))
        again = last == fresh[name] if exact else all(is_whole(place_of(name) / path) for path in last)
        again = again and last.keys() == older.keys()
        tally["killed"] += killed
        tally[f"at {place}"] += killed
        tally["older or new, and whole"] += kept
        tally["then the same command succeeds, and nothing is left lying"] += again
        lost += not (killed and kept and again)
    return {"commands": {name: words[0] for name, words in jobs.items()}, **tally, "lost": lost}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kinds", nargs="+", choices=[*KILLS], default=[*KILLS])
    parser.add_argument("--kills", type=int, help=f"of each kind; by default {KILLS}")
    parser.add_argument("--seed", type=int, default=0, help="0, 1, 2 ... go on through the places of the kills")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="of trainings; commands take any GPU")
    parser.add_argument("--gpus", type=int, default=1, help="number of ranks")
    parser.add_argument("--out", type=Path, help="folder to work in; a temporary one by default")
    options = parser.parse_args()
    if options.gpus > 1 and (options.device == "cpu" or options.kinds != ["training"]):
        parser.error("several ranks need --device cuda --kinds training")
    root = options.out or Path(tempfile.mkdtemp(prefix="kill-and-resume-"))
    root.mkdir(parents=True, exist_ok=True)
    bench = Bench(options.device, root / "log")
    lost = 0
    for kind in options.kinds:
        kills = options.kills or KILLS[kind]
        work = (options, bench, root, kills)
        result = kill_commands(*work) if kind == "commands" else kill_trainings(kind, *work)
        lost += result["lost"]
        device = torch.cuda.get_device_name(0) if options.device == "cuda" else "cpu"
        print(json.dumps({"kind": kind, "device": device, "ranks": options.gpus, "kills": kills, **result}), flush=True)
    if options.out is None:
        shutil.rmtree(root)
    sys.exit(1 if lost else 0)


if __name__ == "__main__":
    main()
