"""Kill trainings and commands with SIGKILL, repeat them, and compare with undisturbed ones; print a JSON line a kind.

    python benchmarks/kill_and_resume.py                       # all kinds on a CPU: 20 + 10 + 24 kills
    python benchmarks/kill_and_resume.py --kinds training --kills 3 --seed 1
    python benchmarks/kill_and_resume.py --kinds training trials --device cuda             # captured steps
    python benchmarks/kill_and_resume.py --kinds training --device cuda --gpus 2           # at any time, any process

- ``training``: while saving, while pruning, at any time.
- ``trials``: the same in the trials of a head and of a length.
- ``commands``: prune, pack and export over an older result: while the file is written, before it is renamed, at any
  time. Afterwards the older result or the new one must be complete, and the same command must succeed.

Every run is nerfstudio's own training command, or one of sundae, on a ray-traced scene, in a process of its own. Exits
with 1 if anything was lost. On a CPU a resumed run must be the same bit for bit. On CUDA sums have no fixed order, so
its test views must be as good as those of two undisturbed runs, less ``SPREAD`` dB.
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any

import torch
import tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
from nerfstudio.engine.trainer import TrainerConfig
from rich.progress import track

import sundae_ns as sn
from harness import killing
from harness.killing import ANY, Bench, command_here, train_here
from harness.still_life import write_still_life
from sundae_ns.core.errors import CheckpointError
from sundae_ns.io import checkpoint
from sundae_ns.plugin.dataparsers import camera_of
from sundae_ns.plugin.finished_runs import load_model

SPREAD = 3.0
"""Decibels that a resumed run on CUDA may be below the worse of two undisturbed ones."""
KILLS = {"training": 20, "trials": 10, "commands": 24}
COMMON = """
--experiment-name e --timestamp t --viewer.quit-on-train-completion True --viewer.websocket-host 127.0.0.1
--steps-per-eval-image 25 --pipeline.model.warmup-length 5 --pipeline.model.refine-every 10
--pipeline.model.densify-grad-thresh 0.0004 --pipeline.model.sh-degree-interval 20 --vis tensorboard
"""
# Steps, steps between saves, places of kills, further options.
TRAININGS: dict[str, tuple[int, int, dict[str, killing.Place], str]] = {
    "training": (70, 12, killing.TRAINING, "--pipeline.model.pruning.prune-at 36"),
    # Trials begin at the prune. With eight views each candidate is tried twice, for four steps.
    "trials": (160, 9, killing.TRIALS, "--pipeline.model.pruning.prune-at 40 --pipeline.model.head.mode auto"),
}
COMMANDS = {
    "pruned.ply": ["prune", "PLY", "--num-cameras", "8"],
    "pruned.sundae": ["prune", "RUN", "--num-cameras", "8"],
    "packed.sundae": ["pack", "RUN"],
    "tuned.sundae": ["pack", "RUN", "--finetune", "10"],
    "page.html": ["export", "RUN"],
    "page": ["export", "RUN"],
    "viewers.spz": ["export", "RUN"],
    "viewers.sog": ["export", "PLY"],
}
"""Commands that write, by the name of their output."""


def config_of(kind: str, options: argparse.Namespace, folder: Path) -> TrainerConfig:
    """Configuration of a training on a small scene, which is written to the folder if it is not there."""
    steps, save_every, _, more = TRAININGS[kind]
    scene = folder / "scene"
    if not scene.exists():
        write_still_life(scene, train_views=8, test_views=2, width=64, height=64, points=300)
    words = f"--max-num-iterations {steps} --steps-per-save {save_every} {COMMON} {more}".split()
    config: TrainerConfig = tyro.cli(AnnotatedBaseConfigUnion, args=["sundae-tiny", "--data", str(scene), *words])
    config.machine.device_type, config.machine.num_devices = options.device, options.gpus
    return config


def run_folder(config: TrainerConfig) -> Path:
    return Path(config.output_dir) / "e" / "sundae-tiny" / "t"


def outcome(folder: Path, steps: int) -> tuple[dict[str, Any], list[str]]:
    """Result of a finished run, bits of the final checkpoint's tensors and its records; names of its files."""
    models = folder / "nerfstudio_models"
    (last,) = models.glob(f"step-*{steps - 1}.ckpt")
    tensors = {name: value for name, value in checkpoint.read(last)["pipeline"].items() if torch.is_tensor(value)}
    prunes = json.loads((folder / "prune.json").read_text())
    result = {
        "tensors": {name: (value.dtype, value.shape, value.numpy().tobytes()) for name, value in tensors.items()},
        "prunes": [{key: prune[key] for key in ("step", "before", "after", "warm_up", "pruned")} for prune in prunes],
        "trials": {path.name: json.loads(path.read_text()) for path in folder.glob("trials.json")},
    }
    return result, sorted(path.name for path in models.iterdir())


def quality(run: Path) -> float:
    """PSNR of the test views, dB."""
    opened = load_model(run)
    cameras = [camera_of(camera, opened.model.device) for camera in opened.cameras]
    return sn.measure(sn.load(run, device=opened.model.device), opened.truths, cameras).psnr


def kill_trainings(kind: str, options: argparse.Namespace, bench: Bench, root: Path, kills: range) -> dict[str, Any]:
    """Kill trainings of one kind; counts of the outcomes, with ``lost`` for those that differ."""
    (steps, save_every, inner, _), rng = TRAININGS[kind], random.Random(options.seed)
    parsed, exact = config_of(kind, options, root), options.device == "cpu"

    def configured(name: str) -> TrainerConfig:
        config = deepcopy(parsed)
        config.output_dir = root / kind / name
        return config

    undisturbed = [configured("first"), configured("second")]
    seconds = [bench.finish(train_here, config) for config in undisturbed][1]
    (reference, files), (repeated, _) = (outcome(run_folder(config), steps) for config in undisturbed)
    repeatable = not exact or repeated == reference
    psnr = [] if exact else [quality(run_folder(config)) for config in undisturbed]

    tally: Counter[str] = Counter()
    resumed_psnr: list[float] = []
    lost = 0
    # One kill at each place, then random ones; half of the rest at any time. Ranks have modules of their own.
    every = [ANY, *(inner if options.gpus == 1 else ())]
    places = [every[i] if i < len(every) else ANY if i % 2 else rng.choice(every) for i in kills]
    for number, place in enumerate(track(places, description=f"Killing: {kind}", transient=True)):
        config, nth = configured(f"killed-{number}"), rng.randint(1, 5)
        folder = run_folder(config)
        models = folder / "nerfstudio_models"
        start = partial(bench.start, train_here, config, nth=nth)
        killed = bench.killed(start, place, partial(shutil.rmtree, folder), seconds, rng)
        try:
            done = int(checkpoint.newest_whole(models)[0].stem.partition("-")[2]) + 1
            tally["resumed" if done < steps else "killed after the last save"] += 1
        except CheckpointError:
            done = 0
            tally["killed before the first save, so started anew"] += 1
        if done < steps:
            config.max_num_iterations, config.load_dir = steps - done, models if done else None
            bench.finish(train_here, config)
        result, left = outcome(folder, steps)
        one_prune = len(result["prunes"]) == 1 and result["prunes"][0]["step"] == reference["prunes"][0]["step"]
        clean = done == steps or left == files
        if not exact:
            resumed_psnr.append(quality(folder))
        equal = result == reference if exact else resumed_psnr[-1] > min(psnr) - SPREAD
        held = {"one prune": one_prune, "the same result": equal, "nothing left lying": clean}
        for fact, true in {"killed": killed, f"at {place}": killed, **held}.items():
            tally[fact] += true
        lost += not (killed and all(held.values()))
        shutil.rmtree(config.output_dir)
    about: dict[str, Any] = {"steps": steps, "save_every": save_every}
    about |= {"same seed, same result": repeatable} if exact else {"psnr": [psnr, resumed_psnr]}
    return {**about, **tally, "lost": lost + (not repeatable)}


def contents(folder: Path) -> dict[str, bytes]:
    """Contents of all files below a folder, by their paths."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def write_all(folder: Path, files: Mapping[str, bytes]) -> None:
    for path, content in files.items():
        (folder / path).write_bytes(content)


def kill_commands(kind: str, options: argparse.Namespace, bench: Bench, root: Path, kills: range) -> dict[str, Any]:
    """Kill commands that write over older results; as :func:`kill_trainings`."""
    rng, folder = random.Random(options.seed), root / kind
    config = config_of("training", options, folder)
    config.output_dir = folder / "out"
    bench.finish(train_here, config)
    inputs = {"RUN": str(run_folder(config)), "PLY": str(folder / "scene.ply")}
    bench.finish(command_here, ["export", inputs["RUN"], "-o", inputs["PLY"]])
    outputs = {name: folder / "written" / name.replace(".", "-") for name in COMMANDS}

    def words(name: str) -> list[str]:
        return [*(inputs.get(word, word) for word in COMMANDS[name]), "-o", str(outputs[name] / name), "--overwrite"]

    fresh: dict[str, dict[str, bytes]] = {}
    seconds: dict[str, float] = {}
    for name, output in outputs.items():
        output.mkdir(parents=True)
        seconds[name] = bench.finish(command_here, words(name))
        fresh[name] = contents(output)

    tally: Counter[str] = Counter()
    lost = 0
    every = [ANY, *killing.COMMANDS]
    for number in track(kills, description="Killing: commands", transient=True):
        name, place = list(COMMANDS)[number % len(COMMANDS)], every[(number // len(COMMANDS)) % len(every)]
        output, older = outputs[name], dict.fromkeys(fresh[name], b"older")
        age: partial[None] = partial(write_all, output, older)
        age()
        killed = bench.killed(partial(bench.start, command_here, words(name)), place, age, seconds[name], rng)
        left = contents(output)
        kept = all(left.get(path) in (older[path], fresh[name][path]) for path in older)
        bench.finish(command_here, words(name))
        again = contents(output) == fresh[name]
        held = {"older or new, and whole": kept, "then the same command succeeds, and nothing is left lying": again}
        for fact, true in {"killed": killed, f"at {place}": killed, **held}.items():
            tally[fact] += true
        lost += not (killed and all(held.values()))
    return {"commands": {name: words[0] for name, words in COMMANDS.items()}, **tally, "lost": lost}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kinds", nargs="+", choices=[*KILLS], default=[*KILLS])
    parser.add_argument("--kills", type=int, help=f"of each kind; by default {KILLS}")
    parser.add_argument("--seed", type=int, default=0, help="0, 1, 2 ... go on through the places of the kills")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="of trainings; commands run on a CPU")
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
        # A seed starts where those before it end, so that short calls reach every place.
        numbers = range(options.seed * kills, (options.seed + 1) * kills)
        result = (kill_commands if kind == "commands" else kill_trainings)(kind, options, bench, root, numbers)
        lost += result["lost"]
        device = torch.cuda.get_device_name(0) if options.device == "cuda" else "cpu"
        print(json.dumps({"kind": kind, "device": device, "ranks": options.gpus, "kills": kills, **result}), flush=True)
    if options.out is None:
        shutil.rmtree(root)
    sys.exit(1 if lost else 0)


if __name__ == "__main__":
    main()
