"""Whole runs of two ranks over gloo: they train, prune, save, resume and fail as the documentation says.

``rank.py`` runs the checks of this file on each rank; the tests read their results. Started as a program, the file
trains a run whose rank is killed. Every program has a time limit.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import forked
import pytest
import torch
import torch.distributed as dist
from PIL import Image
from torch.multiprocessing.spawn import ProcessExitedException

from sundae_ns.distributed import ShardedField, Shards
from sundae_ns.distributed.checkpoints import state_of_rank
from sundae_ns.distributed.shards import DRIFT
from sundae_ns.errors import rank_ended, show_in_one_line
from sundae_ns.method_configs import sundae_tiny
from sundae_ns.rasterization.sharded import Cameras, Route
from sundae_ns.rendering import StepResolution, View
from sundae_ns.storage.runs import checkpoint
from sundae_ns.trainer import SundaeTrainer, SundaeTrainerConfig
from sundae_ns.training import averaging
from sundae_ns.training.averaging import RunningMean

RunRanks = Callable[[str, Path], None]
Passed = Callable[[Path, str], None]
RANKS = 2
LIMIT = 600
"""Seconds that a program may take on a busy machine."""
NAMES = ("means", "quats", "scales", "opacities", "features_dc", "features_rest", "features")


STEPS, KEEP, PRUNE_AT, SAVE_EVERY = 40, 0.4, 32, 26
SAVED_AT = SAVE_EVERY + RANKS - 1
"""Two ranks save after batch 13, which ends with image 27."""


def configured(folder: Path, name: str) -> SundaeTrainerConfig:
    """A short run on a small scene: it densifies at image 24, prunes at 32, and then enables the head."""
    import copy

    config = copy.deepcopy(sundae_tiny.config)
    assert isinstance(config, SundaeTrainerConfig)
    config.machine.device_type = "cpu"
    config.machine.num_devices = RANKS
    config.output_dir, config.experiment_name, config.timestamp = folder, name, "now"
    config.max_num_iterations, config.steps_per_save, config.steps_per_eval_image = STEPS, SAVE_EVERY, 10
    config.save_only_latest_checkpoint = False
    config.vis = "tensorboard"
    config.viewer.quit_on_train_completion = True
    config.pipeline.datamanager.data = folder / "scene"
    model: Any = config.pipeline.model
    model.rasterizer = "reference"
    model.pruning.prune_at, model.pruning.keep_ratio = PRUNE_AT, KEEP
    model.warmup_length, model.refine_every, model.stop_split_at = 4, 6, PRUNE_AT
    model.num_downscales, model.resolution_schedule = 1, 4
    model.densify_grad_thresh, model.reset_alpha_every, model.sh_degree_interval = 0.003, 100, 8
    return config


def frozen(folder: Path, name: str) -> SundaeTrainerConfig:
    """One step at rates of 0 from the saved warm-up, and a prune: any number of ranks prunes the same field.

    Half of each image is masked; a prune that ignores the masks keeps other primitives.
    """
    config = configured(folder, name)
    config.max_num_iterations = 1
    config.steps_per_eval_image = 1000
    config.pipeline.datamanager.data = folder / "masked"
    model: Any = config.pipeline.model
    model.warm_start = folder / "train" / "sundae-tiny" / "now" / "nerfstudio_models" / f"step-{SAVED_AT:09d}.ckpt"
    model.evaluate_prune = False
    for group in config.optimizers.values():
        group["optimizer"].lr, group["scheduler"] = 0.0, None
    return config


def train(config: SundaeTrainerConfig, rank: int, ranks: int) -> SundaeTrainer:
    from nerfstudio.utils import profiler, writer

    torch.manual_seed(config.machine.seed + rank)
    trainer: SundaeTrainer = config.setup(local_rank=rank, world_size=ranks)
    trainer.setup()
    trainer.train()
    writer.EVENT_WRITERS.clear()
    writer.EVENT_STORAGE.clear()
    writer.GLOBAL_BUFFER.clear()
    profiler.PROFILER.clear()
    return trainer


def check_training(shards: Shards, folder: Path) -> None:
    """A run of two ranks ends with a mean of weights; both have the same head, and no shard is far from the mean."""
    anew, averaged = [], []
    exchange, replace = ShardedField._exchange, RunningMean.replace

    def noted(self: ShardedField, view: View, at: StepResolution | None) -> tuple[Cameras, Route]:
        if at is not None and (self._planned is None or self._planned.at != at):
            anew.append(at.step)
        return exchange(self, view, at)

    def noted_mean(self: RunningMean, weights: Any) -> Any:
        averaged.append(self.count)
        return replace(self, weights)

    ShardedField._exchange, RunningMean.replace = noted, noted_mean  # type: ignore[method-assign]
    averaging.AVERAGED_EVERY = 1
    config = configured(folder, "train")
    config.schedule_length = STEPS  # as ns-train sets it
    trainer = train(config, shards.rank, RANKS)
    ShardedField._exchange, RunningMean.replace = exchange, replace  # type: ignore[method-assign]
    assert averaged == [3]
    # The first step, those after densification, and the one after the prune; the resolution rises at step 2.
    assert anew == [0, *range(1, PRUNE_AT // RANKS + 1, 3), PRUNE_AT // RANKS + 1]
    model: Any = trainer.pipeline.model
    weights = torch.cat([value.detach().flatten() for value in model.head.parameters()])
    every = [torch.empty_like(weights) for _ in range(RANKS)]
    dist.all_gather(every, weights)
    assert torch.equal(every[0], every[1])
    team: Any = trainer.team
    assert team.shards.numbers(model.num_points) == [[count] for count in team.shards.counts]
    assert model.source.total == sum(team.shards.counts)
    assert max(team.shards.counts) <= DRIFT * model.source.total / RANKS
    assert trainer.pipeline.datamanager.place[1] == RANKS
    group = trainer.optimizers.optimizers["opacities"].param_groups[0]
    assert group["lr"] == pytest.approx(0.05 * RANKS**0.5)
    assert group["betas"] == pytest.approx((0.9**RANKS, 0.999**RANKS))
    head = trainer.optimizers.optimizers["compensation"].param_groups[0]
    alone = sundae_tiny.config.optimizers["compensation"]["optimizer"]
    assert (head["initial_lr"], head["betas"]) == (alone.lr, alone.betas)


def check_frozen(shards: Shards, folder: Path) -> None:
    train(frozen(folder, "two"), shards.rank, RANKS)


def check_few(shards: Shards, folder: Path) -> None:
    """A field of one primitive trains, is saved and resumed, with nothing on one rank."""
    config = frozen(folder, "few")
    model: Any = config.pipeline.model
    model.pruning.keep_ratio = 1e-6
    train(config, shards.rank, RANKS)
    config = frozen(folder, "few again")
    config.load_checkpoint = models(folder, "few") / f"step-{RANKS - 1:09d}.ckpt"
    config.max_num_iterations = 2 * RANKS
    trainer = train(config, shards.rank, RANKS)
    assert trainer.step == 2
    team: Any = trainer.team
    assert team.shards.counts == [0, 1]


def models(folder: Path, name: str) -> Path:
    return folder / name / "sundae-tiny" / "now" / "nerfstudio_models"


def checks(folder: Path) -> dict[str, Callable[[Shards], None]]:
    """The checks of each rank, in this order."""
    return {check.__name__: partial(check, folder=folder) for check in (check_training, check_frozen, check_few)}


@dataclass
class DyingTrainerConfig(SundaeTrainerConfig):
    """A run whose rank 1 is killed."""

    _target: type = field(default_factory=lambda: DyingTrainer)


class DyingTrainer(SundaeTrainer):
    """Killed at a step, as the system does when memory is short."""

    def train_iteration(self, step: int) -> Any:
        if step == (SAVED_AT + 1) // RANKS + 2 and dist.get_rank() == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().train_iteration(step)


def train_rank(rank: int, meeting: Path, config: Any) -> None:
    dist.init_process_group("gloo", init_method=f"file://{meeting}", rank=rank, world_size=RANKS)
    torch.manual_seed(config.machine.seed + rank)
    trainer = config.setup(local_rank=rank, world_size=RANKS)
    trainer.setup()
    trainer.train()
    dist.destroy_process_group()


@dataclass
class StoppedTrainerConfig(SundaeTrainerConfig):
    """A run whose rank 1 gets SIGINT."""

    _target: type = field(default_factory=lambda: StoppedTrainer)


class StoppedTrainer(SundaeTrainer):
    """Stopped at its second step."""

    def train_iteration(self, step: int) -> Any:
        if step == 1 and dist.get_rank() == 1:
            os.kill(os.getpid(), signal.SIGINT)
        return super().train_iteration(step)


def start_ranks(meeting: Path, config: Any) -> None:
    """Forked ranks have imported nerfstudio; ns-train spawns them."""
    torch.multiprocessing.start_processes(train_rank, (meeting, config), nprocs=RANKS, start_method="fork")


def main(folder: Path, name: str) -> None:
    """Two ranks resume from a checkpoint, and one is killed; or one gets SIGINT, which ends this program."""
    torch.set_num_threads(1)
    plain = configured(folder, name)
    if name == "stops":
        sys.argv = ["ns-train"]
        show_in_one_line()
        stopped = StoppedTrainerConfig(**{k: v for k, v in vars(plain).items() if k != "_target"})
        start_ranks(folder / "meeting-of-the-stopped", stopped)
        return
    config = DyingTrainerConfig(**{k: v for k, v in vars(plain).items() if k != "_target"})
    config.load_checkpoint = models(folder, "train") / f"step-{SAVED_AT:09d}.ckpt"
    try:
        start_ranks(folder / "meeting-of-the-dead", config)
    except ProcessExitedException as error:
        (folder / "died.txt").write_text(str(rank_ended(error)))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])


# -------------------------------------------------------------------------------------------------------------- tests


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, run_ranks: RunRanks) -> Path:
    """Runs of two ranks, trained once for all tests."""
    folder = tmp_path_factory.mktemp("ranks")
    from ray_tracing import write_still_life  # not above: ranks import this file without pytest's paths

    write_still_life(folder / "scene", train_views=7, test_views=2, width=40, height=32, points=150)
    shutil.copytree(folder / "scene", folder / "masked")
    meta = json.loads((folder / "masked" / "transforms.json").read_text())
    mask = Image.new("L", (40, 32))
    mask.paste(255, (0, 0, 20, 32))
    mask.save(folder / "masked" / "mask.png")
    meta["frames"] = [{**frame, "mask_path": "mask.png"} for frame in meta["frames"]]
    (folder / "masked" / "transforms.json").write_text(json.dumps(meta))
    run_ranks(__file__, folder)
    return folder


@pytest.mark.parametrize("name", checks(Path()))
def test_two_ranks(folder: Path, name: str, passed: Passed) -> None:
    passed(folder, name)


def test_checkpoint_of_two_ranks_is_one_of_one_gpu(folder: Path) -> None:
    (report,) = json.loads((models(folder, "train").parent / "prune.json").read_text())
    assert report["step"] == PRUNE_AT + RANKS - 1
    assert report["after"] == round(KEEP * report["before"])
    assert report["before"] > 150, "densification added nothing"
    before, after = (
        checkpoint.read(models(folder, "train") / f"step-{step:09d}.ckpt") for step in (SAVED_AT, STEPS - 1)
    )
    assert len(after["pipeline"]["_model.gauss_params.means"]) == report["after"]
    n = len(before["pipeline"]["_model.gauss_params.means"])
    assert len(before["pipeline"]["_model._extra_state"]["running"]["densification"]["grad2d"]) == n
    for name in NAMES[:-1]:
        (moments,) = before["optimizers"][name]["state"].values()
        assert len(moments["exp_avg"]) == n
    group = after["optimizers"]["opacities"]["param_groups"][0]
    assert group["lr"] == pytest.approx(0.05, rel=1e-12)
    assert tuple(group["betas"]) == (0.9, 0.999)
    extra = after["pipeline"]["_model._extra_state"]
    assert extra["trained_focal"] is not None
    assert (after["step"], extra["step"]) == (STEPS - 1, STEPS - 1)
    assert extra["running"]["pruning"]["pruned_at"] == report["step"]
    schedule = after["schedulers"]["means"]
    assert schedule["last_epoch"] == STEPS
    assert schedule["base_lrs"] == pytest.approx([1.6e-4])
    assert schedule["lr_lambdas"][0]["max_steps"] == sundae_tiny.config.optimizers["means"]["scheduler"].max_steps
    assert schedule["lr_lambdas"][0]["pruned_at"] == report["step"]


def test_the_prune_is_that_of_one_process(folder: Path) -> None:
    """The same primitives of the same field stay, with the same values."""
    one = train(frozen(folder, "one"), 0, 1)
    two = checkpoint.read(models(folder, "two") / "step-000000001.ckpt")["pipeline"]
    for name, value in one.pipeline.model.gauss_params.items():
        # Weights of a view are sums over fewer rows here, so merged values differ by rounding.
        torch.testing.assert_close(value.detach(), two[f"_model.gauss_params.{name}"], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("ranks", [1, 3])
def test_a_checkpoint_loads_on_another_number_of_ranks(folder: Path, ranks: int) -> None:
    loaded = checkpoint.read(models(folder, "train") / f"step-{SAVED_AT:09d}.ckpt")
    parts = [state_of_rank(loaded, rank, ranks, NAMES) for rank in range(ranks)]
    for key, value in loaded["pipeline"].items():
        if key.startswith("_model.gauss_params."):
            assert torch.equal(torch.cat([part["pipeline"][key] for part in parts]), value)

    def counts(state: dict[str, Any]) -> torch.Tensor:
        found: torch.Tensor = state["pipeline"]["_model._extra_state"]["running"]["densification"]["count"]
        return found

    assert torch.equal(torch.cat([counts(part) for part in parts]), counts(loaded))
    group, whole = (x["optimizers"]["means"]["param_groups"][0] for x in (parts[0], loaded))
    assert group["lr"] == pytest.approx(whole["lr"] * ranks**0.5)
    assert group["betas"] == pytest.approx([beta**ranks for beta in whole["betas"]])
    assert parts[0]["optimizers"]["compensation"] == loaded["optimizers"]["compensation"]
    assert parts[0]["schedulers"]["compensation"]["base_lrs"] == loaded["schedulers"]["compensation"]["base_lrs"]
    assert parts[0]["step"] == (SAVED_AT + 1) // ranks - 1
    assert parts[0]["schedulers"]["means"]["last_epoch"] == round((SAVED_AT + 1) / ranks)


def test_a_checkpoint_of_another_method_or_format_is_left_to_the_loader() -> None:
    """The loader names the method and the option; cutting the checkpoint would fail on the first missing key."""
    pipeline: dict[str, Any] = {"_model.gauss_params.means": torch.zeros(4, 3)}
    for extra in ({}, {"_model._extra_state": {"method": "sundae", "format": 1, "strategy": {}}}):
        loaded = {"step": 3, "pipeline": {**pipeline, **extra}, "optimizers": {}}
        assert state_of_rank(loaded, 1, 2, NAMES) == loaded


def test_one_process_resumes_a_run_of_two(folder: Path) -> None:
    config = configured(folder, "alone")
    config.load_checkpoint = models(folder, "train") / f"step-{SAVED_AT:09d}.ckpt"
    config.max_num_iterations = PRUNE_AT - SAVED_AT + 1
    trainer = train(config, 0, 1)
    assert trainer.optimizers.optimizers["opacities"].param_groups[0]["lr"] == pytest.approx(0.05)
    (report,) = json.loads((models(folder, "alone").parent / "prune.json").read_text())
    assert (report["step"], report["after"]) == (PRUNE_AT, round(KEEP * report["before"]))
    assert trainer.optimizers.schedulers["means"].last_epoch == trainer.step + 1


def test_a_killed_rank_ends_all_with_one_line(folder: Path) -> None:
    """It resumes on two ranks first, from a checkpoint of two."""
    code, printed = forked.run(Path(__file__), folder, "dies")
    assert code == 0, printed
    line = (folder / "died.txt").read_text()
    assert re.fullmatch(r"rank 1 ended \(killed by SIGKILL\).*--load-dir.*--machine\.num-devices", line)
    assert not (models(folder, "dies") / f"step-{SAVED_AT + STEPS:09d}.ckpt").exists()


def test_ranks_stop_together_and_save_when_one_gets_a_signal(folder: Path) -> None:
    code, printed = forked.run(Path(__file__), folder, "stops")
    assert code == 130, printed
    assert printed.count("--load-dir") == 1, "the first rank says how to resume"
    # They agree after the seventeenth batch.
    saved = checkpoint.read(models(folder, "stops") / f"step-{17 * RANKS - 1:09d}.ckpt")
    assert checkpoint.checkpoints(models(folder, "stops"))[-1].name == f"step-{saved['step']:09d}.ckpt"


ON_CPUS = """
import os, sys
import torch
import torch.distributed as dist
import sundae_ns.distributed
from nerfstudio.scripts import train
from nerfstudio.utils import comms
from sundae_ns.errors import show_in_one_line

show_in_one_line()  # as the first import of our methods does

def worker(rank, train_loop, ranks, _, __, url, config, *___):
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=url, world_size=ranks, rank=rank)
    comms.LOCAL_PROCESS_GROUP = dist.new_group(list(range(ranks)))
    train_loop(rank, ranks, config, rank)

# nerfstudio starts several ranks on GPUs only.
train._distributed_worker = worker
sundae_ns.distributed.check_machine = lambda *_: None
if __name__ == "__main__":
    train.entrypoint()
"""


@pytest.mark.parametrize(
    ("number", "whole_group", "after", "saves"),
    [
        # Ctrl-C reaches the ranks too.
        pytest.param(signal.SIGINT, True, "left at", True, marks=pytest.mark.long),
        (signal.SIGTERM, False, "Saving config", False),  # there are no ranks yet
    ],
)
def test_signals_to_the_command_of_two_ranks(
    folder: Path, tmp_path: Path, number: signal.Signals, whole_group: bool, after: str, saves: bool
) -> None:
    (tmp_path / "ns-train").write_text(ON_CPUS)
    options = "--timestamp now --vis tensorboard --machine.num-devices 2 --machine.device-type cpu"
    words = ["sundae-tiny", "--data", str(folder / "scene"), "--output-dir", str(tmp_path), *options.split()]
    with forked.started(tmp_path / "ns-train", *words) as (process, output):
        assert process.pid is not None
        assert any(after in line for line in output)
        (os.killpg if whole_group else os.kill)(process.pid, number)
        said = output.read()
        process.join()
    assert process.exitcode == 128 + number
    assert said.count("--load-dir") == (1 if saves else 0)
    assert "Traceback" not in said
    saved = list(tmp_path.glob("*/*/now/nerfstudio_models/step-*.ckpt"))
    assert len(saved) == (1 if saves else 0)
    # The output ended, so no rank is left that could write to it.


@pytest.mark.gpu
@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs")
def test_ns_train_on_two_gpus(tmp_path: Path) -> None:
    """The command of users; the run opens on one GPU like any other."""
    from nerfstudio.utils.eval_utils import eval_setup
    from ray_tracing import write_still_life

    write_still_life(tmp_path / "scene", train_views=12, test_views=3, width=64, height=48, points=300)
    options = {
        "machine.num-devices": 2,
        "data": tmp_path / "scene",
        "output-dir": tmp_path,
        "experiment-name": "gpus",
        "timestamp": "now",
        "max-num-iterations": 240,
        "pipeline.model.pruning.prune-at": 120,
        "pipeline.model.pruning.keep-ratio": KEEP,
        "pipeline.model.warmup-length": 10,
        "pipeline.model.refine-every": 30,
        "viewer.quit-on-train-completion": True,
    }
    words = [str(word) for name, value in options.items() for word in (f"--{name}", value)]
    program = [sys.executable, "-m", "nerfstudio.scripts.train"]
    subprocess.run([*program, "sundae-tiny", *words], timeout=2 * LIMIT, check=True, cwd=tmp_path)
    run = tmp_path / "gpus" / "sundae-tiny" / "now"
    (report,) = json.loads((run / "prune.json").read_text())
    assert report["after"] == round(KEEP * report["before"])
    _, pipeline, _, step = eval_setup(run / "config.yml", test_mode="test")
    assert step == 239
    assert pipeline.model.num_points == report["after"]
    # 16 dB is far above a field that has not learned, and far below one that has.
    assert pipeline.get_average_eval_image_metrics()["psnr"] > 16
