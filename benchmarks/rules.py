"""Compare selection rules: one warm-up a capture, then a branch for each rule, keep ratio and seed; one line each.

    python benchmarks/rules.py --scene bonsai --data DIR                          # 1,500 steps of fine-tuning a branch
    python benchmarks/rules.py --scene bonsai --data DIR --steps 15000 --rules random contribution systematic
    python benchmarks/rules.py --scene bonsai --data DIR --sweep gamma
    CUDA_VISIBLE_DEVICES=0 python benchmarks/rules.py --scene bonsai --data DIR --shard 0/2 &
    CUDA_VISIBLE_DEVICES=1 python benchmarks/rules.py --scene bonsai --data DIR --shard 1/2 &

The warm-up is trained once and kept under ``--out``; of several processes the first makes it and the others wait. Branches
that have a line already are passed over, so a run that was stopped goes on where it was. All branches train without a head,
see the same views in the same order for the same seed, and let their rates decay over their own length. ``--abreast N`` trains
up to N of them at a time by one step for all (``abreast.py``), and saves their lines when all have ended. ``--list`` shows
the branches that would run, ``--missing`` those without a line as jobs for ``jobs.py``: the first makes the warm-up.
"""

from __future__ import annotations

import argparse
import copy
import json
import os
import shlex
import sys
import time
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import run
import torch
import tyro
from abreast import Abreast, Start, start_of
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
from nerfstudio.engine.callbacks import TrainingCallbackLocation
from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import Progress

from sundae_ns.cli.bench.plan import schedule_of
from sundae_ns.evaluation import RunRow, append_row
from sundae_ns.evaluation.records import wait_for_lock
from sundae_ns.evaluation.timing import now
from sundae_ns.model import SundaeModel
from sundae_ns.pruning import field_graph
from sundae_ns.pruning.scores import for_graph
from sundae_ns.scenes.measure import sizes
from sundae_ns.storage.runs import checkpoint
from sundae_ns.training.schedulers import Decay
from sundae_ns.training.schedules import make_policy

RESULTS = Path(__file__).parent / "results" / "rules.jsonl"
COLMAP = "colmap --colmap-path sparse/0 --downscale-factor 1 --eval-mode interval --eval-interval 8"

PLAIN = {"selection": "sampled", "edges": "centres", "redistribution": "none"}
"""What rules differ from."""
PAPER = {"selection": "band", "score": "response", "signal": "positions"}
SYSTEMATIC = {"score": "contribution", "selection": "systematic"}
RESPONSE = {"score": "response-contribution", "selection": "systematic"}
DETAIL = {"score": "detail-contribution", "selection": "systematic"}
MERGE = {"redistribution": "merge", "edges": "appearance"}
CONTROLS: dict[str, dict[str, Any]] = {
    "random": {"score": "random"},
    "opacity-top": {"score": "opacity", "selection": "top"},
    "contribution-top": {"score": "contribution", "selection": "top"},
    "contribution": {"score": "contribution"},
}
"""Rules without a spectrum, by the name of their rows: what others have to beat."""
RULES: dict[str, dict[str, Any]] = {
    **CONTROLS,
    "paper": PAPER,
    "response-contribution": {"score": "response-contribution"},
    "color-response": {"score": "response-contribution", "signal": "colors"},
    "coherence": {"score": "coherence-contribution", "selection": "systematic"},
    "coherence-appearance": {"score": "coherence-contribution", "selection": "systematic", "edges": "appearance"},
    "detail": {"score": "detail-contribution"},
    "systematic": SYSTEMATIC,
    "response-systematic": RESPONSE,
    "response-shared": {"score": "response-contribution", "selection": "shared"},
    "detail-systematic": DETAIL,
    "random-merge": {"score": "random", **MERGE},
    "systematic-merge": {**SYSTEMATIC, **MERGE},
    "response-merge": {**RESPONSE, **MERGE},
    "detail-merge": {**DETAIL, **MERGE},
    "detail-merge-centres": {**DETAIL, "redistribution": "merge"},
    "detail-grow": {**DETAIL, "redistribution": "grow"},
    "detail-rounds": {**DETAIL, "rounds": 3},
    "detail-merge-rounds": {**DETAIL, **MERGE, "rounds": 3},
}
"""All rules, by the name of their rows, with the options of pruning that make them."""


class Branch(NamedTuple):
    """One prune and what is trained after it."""

    rule: str
    keep: float
    seed: int
    options: dict[str, Any]


class Pruned(NamedTuple):
    """A branch right after its prune."""

    branch: Branch
    start: Start | None
    """None where it is trained alone."""
    choice: dict[str, Any]
    before: int
    quality: dict[str, float]
    prune_s: float


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", required=True)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--method", default="sundae")
    parser.add_argument("--warmup", type=int, help="steps before the prune, in place of the method's own")
    parser.add_argument("--steps", type=int, default=1500, help="steps of a branch after its prune; 0: none")
    parser.add_argument("--keep", type=float, nargs="+", help="default: 0.01 0.1 0.3; 0.01 for a sweep")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--rules", nargs="+", default=list(RULES), choices=list(RULES))
    parser.add_argument("--sweep", choices=list(SWEEPS), help="this in place of the rules")
    parser.add_argument("--shard", default="0/1", help="i/n: every n-th branch, from the i-th on")
    parser.add_argument("--parser", default=COLMAP, help="dataparser with its options, as ns-train takes them")
    parser.add_argument("--extra", default="", help="more options of ns-train, for the warm-up and all branches")
    parser.add_argument("--out", type=Path, default=Path("outputs/rules"))
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--rows", type=Path, default=run.RESULTS, help="CSV file of rows; - for none")
    parser.add_argument("--abreast", type=int, default=1, help="most branches that are trained by one step for all")
    parser.add_argument("--list", action="store_true", help="print the branches and stop")
    parser.add_argument("--missing", action="store_true", help="print jobs of the branches without a line, and stop")
    options = parser.parse_args()
    if options.missing and options.sweep:
        parser.error("--missing lists rules, not the points of a sweep; leave one of the two out")
    return options


def _gamma() -> dict[str, dict[str, Any]]:
    return {f"paper gamma {g / 10:g}": {**PAPER, "gamma": g / 10} for g in range(11)}


def _tau() -> dict[str, dict[str, Any]]:
    # Factors on the distance that edges reach by the robust rule; tau is its square.
    factors = (0.25, 0.5, 1.0, 2.0, 4.0)
    return {f"{name} reach x{f:g}": {**RULES[name], REACH: f} for name in SWEPT for f in factors}


def _neighbors() -> dict[str, dict[str, Any]]:
    return {f"{name} k {k}": {**RULES[name], "num_neighbors": k} for name in SWEPT for k in (4, 8, 16, 32, 64)}


SWEEPS = {"gamma": _gamma, "tau": _tau, "k": _neighbors}
SWEPT = ("paper", "response-contribution", "detail-merge")
REACH = "reach"
"""Not an option of pruning: becomes tau and sigma when the field is known."""


def branches(options: argparse.Namespace) -> list[Branch]:
    rules = SWEEPS[options.sweep]() if options.sweep else {name: RULES[name] for name in options.rules}
    keeps = options.keep or ([0.01] if options.sweep else [0.01, 0.1, 0.3])
    return [Branch(n, k, s, o) for s in options.seeds for k in keeps for n, o in rules.items()]


class Bench:
    """A trainer that goes back to the end of its warm-up before each branch."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        arguments = [options.method, "--data", str(options.data), "--pipeline.model.head.mode", "off"]
        if options.warmup is not None:
            arguments += ["--pipeline.model.pruning.prune-at", str(options.warmup)]
        arguments += shlex.split(options.extra)
        config = tyro.cli(AnnotatedBaseConfigUnion, args=[*arguments, *shlex.split(options.parser)])
        self.command = " ".join(["ns-train", options.method, "--data", options.scene, *arguments[3:], options.parser])
        config.pipeline.datamanager.data = config.data
        config.output_dir = options.out
        # Processes that begin in the same second are told apart.
        config.experiment_name = f"{options.scene}-{os.getpid()}"
        config.set_timestamp()
        config.vis = "tensorboard"
        config.pipeline.model.evaluate_prune = False
        run._set_random_seed(config.machine.seed)
        self.trainer = config.setup(local_rank=0, world_size=1)
        self.trainer.setup()
        self.model: SundaeModel = self.trainer.pipeline.model
        self.pruning = config.pipeline.model.pruning
        self.step = self.pruning.prune_at
        self.weights: dict[tuple[bool, float], torch.Tensor] = {}
        self._measured = self.model.contribution
        self.start = self._warm_up(warm_up_of(options, self.step))

    def _warm_up(self, path: Path) -> dict[str, Any]:
        """The state right before the prune: from the file, or trained into it."""
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path.with_suffix(".lock"), "w") as lock:
            wait_for_lock(lock.fileno())
            if not path.exists():
                self.model.policy = make_policy(replace(self.pruning, mode="off"))
                started = time.perf_counter()
                self._train(range(self.step + 1), "Warm-up")
                state = {
                    "step": self.step,
                    "pipeline": self.trainer.pipeline.state_dict(),
                    "optimizers": {k: v.state_dict() for k, v in self.trainer.optimizers.optimizers.items()},
                    "schedulers": {k: v.state_dict() for k, v in self.trainer.optimizers.schedulers.items()},
                    "scalers": self.trainer.grad_scaler.state_dict(),
                }
                checkpoint.save(state, path)
                CONSOLE.log(f"warm-up: {self.model.num_points} primitives in {time.perf_counter() - started:.0f} s")
        return checkpoint.load(path)

    def _train(self, steps: range, what: str) -> None:
        with Progress(console=CONSOLE, transient=True) as progress:
            for step in progress.track(steps, description=what):
                self.trainer.pipeline.train()
                for location in (TrainingCallbackLocation.BEFORE_TRAIN_ITERATION, None):
                    if location is None:
                        self.trainer.train_iteration(step)
                        location = TrainingCallbackLocation.AFTER_TRAIN_ITERATION
                    for callback in self.trainer.callbacks:
                        callback.run_callback_at_location(step, location)

    def _rewind(self, seed: int, steps: int) -> None:
        self.trainer._restore(copy.deepcopy(self.start))
        self.model.pruning_state.update(self.model.policy.initialize_state())
        for scheduler in self.trainer.optimizers.schedulers.values():
            for decay in scheduler.lr_lambdas:
                assert isinstance(decay, Decay)
                decay.max_steps, decay.pruned_at = self.step + steps, None
        data = self.trainer.pipeline.datamanager
        data.config.train_cameras_sampling_seed = 42 + seed
        data._order = (-1, [])
        run._set_random_seed(42 + seed)

    def _contribution(self, data: Any) -> torch.Tensor:
        """What a pass over the training views gives, kept for the field as it was when the warm-up ended."""
        if self.model.pruning_state["num_prunes"]:
            return self._measured(data)
        pruning = self.model.config.pruning
        key = (pruning.uses_detail, pruning.keep_ratio if pruning.uses_detail else 1.0)
        if key not in self.weights:
            self.weights[key] = self._measured(data)
        return self.weights[key]

    def prune(self, branch: Branch, *, alone: bool) -> Pruned:
        """Go back, prune, evaluate."""
        options = self.options
        self._rewind(branch.seed, options.steps)
        choice = dict(branch.options)
        if REACH in choice:
            graph = field_graph(for_graph(self.model.gaussians, self.pruning), self.pruning)
            choice |= {"sigma": graph.sigma, "tau": graph.tau * choice.pop(REACH) ** 2}
        if in_rounds(branch):
            # A tenth of the branch apart: all branches are trained for the same time in all.
            choice.setdefault("round_every", max(options.steps // 10, 1))
        config = replace(self.pruning, keep_ratio=branch.keep, seed=branch.seed, **{**PLAIN, **choice})
        self.model.config.pruning, self.model.policy = config, make_policy(config)
        self.model.contribution = self._contribution  # type: ignore[method-assign]
        before = self.model.num_points
        started = now(self.model.device)
        for callback in self.trainer.callbacks:
            if getattr(callback.func, "__name__", "") == "prune_if_due":
                callback.run_callback(self.step)
        prune_s = now(self.model.device) - started
        self.trainer.pipeline.eval()
        start = None if alone else start_of(self.trainer)
        return Pruned(branch, start, choice, before, run.evaluate(self.trainer.pipeline), prune_s)

    def branch(self, branches: list[Branch]) -> list[dict[str, Any]]:
        """Prune, evaluate, train, evaluate; several branches are trained by one step for all."""
        steps = range(self.step + 1, self.step + 1 + self.options.steps)
        pruned = [self.prune(branch, alone=len(branches) == 1) for branch in branches]
        what = ", ".join(f"{branch.rule} {branch.keep:g}" for branch in branches)
        run._set_random_seed(42 + branches[0].seed)  # the same backgrounds, whatever a prune has drawn
        started = now(self.model.device)
        starts = [p.start for p in pruned if p.start is not None]
        together = Abreast(self.trainer, starts) if starts else None
        if together is None:
            self._train(steps, what)
        else:
            together.train(steps, what)
        train_s = now(self.model.device) - started
        self.trainer.pipeline.eval()
        lines = []
        for number, one in enumerate(pruned):
            if together is not None:
                together.show(number)
            tuned = run.evaluate(self.trainer.pipeline) if self.options.steps else one.quality
            lines.append(self._line(one, tuned, train_s / len(pruned)))
            if together is not None:
                lines[-1]["abreast"] = len(pruned)
        return lines

    def _line(self, pruned: Pruned, tuned: dict[str, float], train_s: float) -> dict[str, Any]:
        return {
            **key_of(self.options, pruned.branch, self.step),
            "options": pruned.choice,
            "before": pruned.before,
            "primitives": self.model.num_points,
            "psnr_pruned": pruned.quality["psnr"],
            "ssim_pruned": pruned.quality["ssim"],
            "psnr": tuned["psnr"],
            "ssim": tuned["ssim"],
            "prune_s": pruned.prune_s,
            "train_s": train_s,
            "gpu": torch.cuda.get_device_name(0) if torch.cuda.is_available() else "",
            "commit": run.commit(),
            "command": self.command,
        }

    def row(self, line: dict[str, Any]) -> RunRow:
        command = command_of(line, self.options.parser)
        return row(line, sizes(self.model).primitives, run.resolution(self.trainer.pipeline), command)


def command_of(line: dict[str, Any], parser: str) -> str:
    """A run that makes what a branch does, with a warm-up of its own."""
    options = {"keep_ratio": line["keep"], "seed": line["seed"], **PLAIN, **line["options"]}
    flags = [f"--pipeline.model.pruning.{k.replace('_', '-')} {v}" for k, v in options.items()]
    steps = f"--max-num-iterations {line['warmup'] + line['steps']}"
    return " ".join([line["command"].removesuffix(parser).strip(), steps, *flags, parser])


def row(line: dict[str, Any], bytes_primitives: int, resolution: str, command: str) -> RunRow:
    """What ``runs.csv`` has of a branch; no frame of it is timed."""
    return RunRow(
        **{key: line[key] for key in ("scene", "method", "seed", "primitives", "psnr", "ssim", "gpu", "commit")},
        **{key: line[key] for key in ("train_s", "prune_s")},
        variant=line["rule"],
        keep_ratio=line["keep"],
        steps=line["warmup"] + line["steps"],
        psnr_base=line["psnr"],
        ssim_base=line["ssim"],
        bytes_primitives=bytes_primitives,
        bytes_head=0,
        bytes_total=bytes_primitives,
        resolution=resolution,
        command=command,
    )


def key_of(options: argparse.Namespace, branch: Branch, warmup: int) -> dict[str, Any]:
    """What tells branches apart."""
    return {
        "scene": options.scene,
        "method": options.method,
        "warmup": warmup,
        "steps": options.steps,
        "rule": branch.rule,
        "keep": branch.keep,
        "seed": branch.seed,
    }


def warm_up_of(options: argparse.Namespace, step: int) -> Path:
    """File of the field before the prune; a folder for each capture, since files in the making have one name in a folder."""
    return Path(options.out) / options.scene / f"{options.method}-{step}.ckpt"


def is_finished(path: Path, key: dict[str, Any]) -> bool:
    return any(all(line[name] == value for name, value in key.items()) for line in finished(path))


def finished(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def in_rounds(branch: Branch) -> bool:
    return branch.options.get("rounds", 1) > 1


def groups(branches: list[Branch], most: int) -> list[list[Branch]]:
    """Branches that can be trained abreast: as many primitives, the same views, and no prune while they are trained."""
    found = []
    for (_, _, rounds), same in groupby(branches, lambda b: (b.keep, b.seed, in_rounds(b))):
        own, size = list(same), 1 if rounds else max(most, 1)
        found += [own[i : i + size] for i in range(0, len(own), size)]
    return found


def jobs_of(options: argparse.Namespace, wanted: list[Branch]) -> list[dict[str, Any]]:
    """Jobs for ``jobs.py``; all but the first wait for the warm-up, which the first makes if need be."""
    step = schedule_of(options.method, warmup=options.warmup, finetune=None, scale=1.0).warmup
    rows = options.rows if str(options.rows) == "-" else options.rows.resolve()
    shared = ["--scene", options.scene, "--method", options.method, "--steps", str(options.steps), "--rows", str(rows)]
    for name in ("data", "out", "results"):
        shared += [f"--{name}", str(vars(options)[name].resolve())]
    shared += [] if options.warmup is None else ["--warmup", str(options.warmup)]
    shared += [] if options.abreast == 1 else ["--abreast", str(options.abreast)]
    jobs: list[dict[str, Any]] = []
    missing = [branch for branch in wanted if not is_finished(options.results, key_of(options, branch, step))]
    for group in groups(missing, options.abreast):
        first, rules = group[0], [branch.rule for branch in group]
        own = ["--rules", *rules, "--keep", f"{first.keep:g}", "--seeds", str(first.seed)]
        # Also the name of a file.
        name = f"{options.scene}-{first.keep:g}-{first.rule}-{first.seed}" + (
            f"-and-{len(group) - 1}" if rules[1:] else ""
        )
        command = shlex.join([sys.executable, str(Path(__file__).resolve()), *shared, *own])
        needs = [str(warm_up_of(options, step).resolve())] if jobs else []
        jobs.append({"name": name, "command": command, "needs": needs})
    return jobs


def main() -> None:
    options = parse()
    number, of = (int(part) for part in options.shard.split("/"))
    mine = branches(options)[number::of]
    if options.list:
        for branch in mine:
            print(json.dumps(branch._asdict()))
        return
    if options.missing:
        for job in jobs_of(options, mine):
            print(json.dumps(job))
        return
    bench = Bench(options)
    for group in groups(mine, options.abreast):
        left = [branch for branch in group if not is_finished(options.results, key_of(options, branch, bench.step))]
        for line in bench.branch(left) if left else []:
            run.append_line(options.results, line)
            if str(options.rows) != "-":
                append_row(options.rows, bench.row(line))
            what = f"{line['rule']}, {line['keep']:g}"
            CONSOLE.print(f"{what}: {line['psnr_pruned']:.2f} then {line['psnr']:.2f} dB")


if __name__ == "__main__":
    main()
