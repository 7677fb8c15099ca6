"""Whole runs of two ranks over gloo: they train, prune, save, resume and fail as the documentation says.

``rank.py`` runs the checks of this file on each rank; the tests read their results. Started as a program, the file
trains a run whose rank is killed or gets a signal. Every program has a time limit.
"""

from __future__ import annotations

import copy
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import forked
import pytest
import torch
import torch.distributed as dist
from PIL import Image
from torch.multiprocessing.spawn import ProcessExitedException

from sundae_ns.core.errors import ConfigError, rank_ended, show_in_one_line
from sundae_ns.io import checkpoint
from sundae_ns.method_configs import sundae_tiny
from sundae_ns.plugin import distributed
from sundae_ns.plugin.trainer import SundaeTrainer, SundaeTrainerConfig
from sundae_ns.train import averaging

RANKS = 2
LIMIT = 600
"""Seconds that a program may take on a busy machine."""
NAMES = ("means", "quats", "scales", "opacities", "features_dc", "features_rest")
STEPS, KEEP, PRUNE_AT, SAVED_AT = 40, 0.4, 32, 26


def configured(folder, name):
    """A short run on a small scene: it densifies at image 24, prunes at 32, and then enables the head."""
    config = copy.deepcopy(sundae_tiny.config)
    config.machine.device_type = "cpu"
    config.machine.num_devices = RANKS
    config.output_dir, config.experiment_name, config.timestamp = folder, name, "now"
    config.max_num_iterations, config.steps_per_save, config.steps_per_eval_image = STEPS, SAVED_AT, 10
    config.save_only_latest_checkpoint = False
    config.vis = "tensorboard"
    config.viewer.quit_on_train_completion = True
    config.pipeline.datamanager.data = folder / "scene"
    model = config.pipeline.model
    model.rasterizer = "reference"
    model.pruning.prune_at, model.pruning.keep_ratio = PRUNE_AT, KEEP
    model.warmup_length, model.refine_every, model.stop_split_at = 4, 6, PRUNE_AT
    model.num_downscales, model.resolution_schedule = 1, 4
    model.densify_grad_thresh, model.reset_alpha_every, model.sh_degree_interval = 0.003, 100, 8
    return config


def frozen(folder, name):
    """One batch at rates of 0 from the saved warm-up, and a prune: any number of ranks prunes the same field.

    Half of each image is masked; a prune that ignores the masks keeps other Gaussians.
    """
    config = configured(folder, name)
    config.max_num_iterations = RANKS
    config.steps_per_eval_image = 1000
    config.pipeline.datamanager.data = folder / "masked"
    model = config.pipeline.model
    model.warm_start = models(folder, "train") / f"step-{SAVED_AT:09d}.ckpt"
    model.evaluate_prune = False
    for group in config.optimizers.values():
        group["optimizer"].lr, group["scheduler"] = 0.0, None
    return config


def models(folder, name):
    return folder / name / "sundae-tiny" / "now" / "nerfstudio_models"


def train(config, rank, ranks):
    from nerfstudio.utils import profiler, writer

    torch.manual_seed(config.machine.seed + rank)
    trainer = config.setup(local_rank=rank, world_size=ranks)
    trainer.setup()
    trainer.train()
    writer.EVENT_WRITERS.clear()
    writer.EVENT_STORAGE.clear()
    writer.GLOBAL_BUFFER.clear()
    profiler.PROFILER.clear()
    return trainer


def check_training(rank, folder):
    """A run of two ranks, from a viewer's command; both end with the same head and schedules, and balanced shards."""
    averaging.AVERAGED_EVERY = 1
    config = configured(folder, "train")
    config.schedule_length = STEPS  # as ns-train sets it
    config.vis = "viewer+tensorboard"
    trainer = train(config, rank, RANKS)
    assert (trainer.config.vis, config.vis) == ("tensorboard", "viewer+tensorboard")
    model = trainer.pipeline.model
    weights = torch.cat([value.detach().flatten() for value in model.head.parameters()])
    every = [torch.empty_like(weights) for _ in range(RANKS)]
    dist.all_gather(every, weights)
    assert torch.equal(every[0], every[1])
    assert model.num_points == model.source.sizes[rank]
    assert max(model.source.sizes) - min(model.source.sizes) <= 1
    group = trainer.optimizers.optimizers["opacities"].param_groups[0]
    assert (group["lr"], tuple(group["betas"])) == (0.05, (0.9, 0.999))
    for scheduler in trainer.optimizers.schedulers.values():
        assert scheduler.last_epoch == STEPS
    decays = trainer.optimizers.schedulers["means"].state_dict()["lr_lambdas"]
    assert decays[0]["pruned_at"] == PRUNE_AT


def check_frozen(rank, folder):
    train(frozen(folder, "two"), rank, RANKS)


def check_few(rank, folder):
    """A field of one Gaussian trains, is saved and resumed, with nothing on one rank."""
    config = frozen(folder, "few")
    model = config.pipeline.model
    model.pruning.keep_ratio = 1e-6
    train(config, rank, RANKS)
    config = frozen(folder, "few again")
    config.load_checkpoint = models(folder, "few") / f"step-{RANKS - 1:09d}.ckpt"
    config.max_num_iterations = 2 * RANKS
    trainer = train(config, rank, RANKS)
    assert trainer.step == 3 * RANKS - 1
    assert trainer.model.source.sizes == [0, 1]


def checks(folder):
    """The checks of each rank, in this order."""
    return {check.__name__: partial(check, folder=folder) for check in (check_training, check_frozen, check_few)}


@dataclass
class HitTrainerConfig(SundaeTrainerConfig):
    """A run whose rank 1 gets a signal."""

    _target: type = field(default_factory=lambda: HitTrainer)
    hit: tuple[int, int] = (0, 0)
    """Step and signal."""


class HitTrainer(SundaeTrainer):
    """Killed, as the system does when memory is short, or interrupted."""

    def train_iteration(self, step):
        at, number = self.config.hit
        if step == at and dist.get_rank() == 1:
            os.kill(os.getpid(), number)
        return super().train_iteration(step)


def train_rank(rank, meeting, config):
    dist.init_process_group("gloo", init_method=f"file://{meeting}", rank=rank, world_size=RANKS)
    train(config, rank, RANKS)
    dist.destroy_process_group()


def main(folder, name):
    """Two ranks resume from a checkpoint, and one is killed; or one gets SIGINT, which ends this program."""
    torch.set_num_threads(1)
    config = HitTrainerConfig(**{k: v for k, v in vars(configured(folder, name)).items() if k != "_target"})
    config.hit = (2, signal.SIGINT)
    if name == "dies":
        config.load_checkpoint = models(folder, "train") / f"step-{SAVED_AT:09d}.ckpt"
        config.hit = (SAVED_AT + 5, signal.SIGKILL)
    else:
        sys.argv = ["ns-train"]
        show_in_one_line()
    try:  # forked ranks have imported nerfstudio; ns-train spawns them
        start = torch.multiprocessing.start_processes
        start(train_rank, (folder / f"meeting-{name}", config), nprocs=RANKS, start_method="fork")
    except ProcessExitedException as error:
        if name != "dies":
            raise
        (folder / "died.txt").write_text(str(rank_ended(error)))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])


# -------------------------------------------------------------------------------------------------------------- tests


@pytest.fixture(scope="module")
def folder(tmp_path_factory, run_ranks):
    """Runs of two ranks, trained once for all tests."""
    folder = tmp_path_factory.mktemp("ranks")
    from harness.still_life import write_still_life  # not above: ranks import this file without pytest's paths

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
def test_two_ranks(folder, name, passed):
    passed(folder, name)


def test_checkpoint_of_two_ranks_is_one_of_one_gpu(folder):
    (report,) = json.loads((models(folder, "train").parent / "prune.json").read_text())
    assert report["step"] == PRUNE_AT
    assert report["after"] == round(KEEP * report["before"])
    assert report["before"] > 150, "densification added nothing"
    before, after = (
        checkpoint.read(models(folder, "train") / f"step-{step:09d}.ckpt") for step in (SAVED_AT, STEPS - 1)
    )
    assert len(after["pipeline"]["_model.gauss_params.means"]) == report["after"]
    n = len(before["pipeline"]["_model.gauss_params.means"])
    assert len(before["pipeline"]["_model._extra_state"]["running"]["densification"]["grad2d"]) == n
    for name in NAMES:
        (moments,) = before["optimizers"][name]["state"].values()
        assert len(moments["exp_avg"]) == n
    group = after["optimizers"]["opacities"]["param_groups"][0]
    assert (group["lr"], tuple(group["betas"])) == (0.05, (0.9, 0.999))
    extra = after["pipeline"]["_model._extra_state"]
    assert extra["trained_focal"] is not None
    assert (after["step"], extra["step"]) == (STEPS - 1, STEPS - 1)
    assert extra["running"]["pruning"]["pruned_at"] == PRUNE_AT


def test_the_prune_is_that_of_one_process(folder):
    """The same Gaussians of the same field stay, with the same values."""
    one = train(frozen(folder, "one"), 0, 1)
    two = checkpoint.read(models(folder, "two") / f"step-{RANKS - 1:09d}.ckpt")["pipeline"]
    for name, value in one.pipeline.model.gauss_params.items():
        assert torch.equal(value.detach(), two[f"_model.gauss_params.{name}"]), name


def test_one_process_resumes_a_run_of_two(folder):
    config = configured(folder, "alone")
    config.load_checkpoint = models(folder, "train") / f"step-{SAVED_AT:09d}.ckpt"
    config.max_num_iterations = PRUNE_AT - SAVED_AT + 1
    trainer = train(config, 0, 1)
    (report,) = json.loads((models(folder, "alone").parent / "prune.json").read_text())
    assert (report["step"], report["after"]) == (PRUNE_AT, round(KEEP * report["before"]))
    assert trainer.optimizers.schedulers["means"].last_epoch == trainer.step + 1


def test_a_killed_rank_ends_all_with_one_line(folder):
    """It resumes on two ranks first, from a checkpoint of two."""
    code, printed = forked.run(Path(__file__), folder, "dies")
    assert code == 0, printed
    line = (folder / "died.txt").read_text()
    assert re.fullmatch(r"rank 1 ended \(killed by SIGKILL\).*--load-dir.*--machine\.num-devices", line)
    assert not (models(folder, "dies") / f"step-{SAVED_AT + STEPS:09d}.ckpt").exists()


def test_ranks_stop_together_and_save_when_one_gets_a_signal(folder):
    code, printed = forked.run(Path(__file__), folder, "stops")
    assert code == 130, printed
    assert printed.count("--load-dir") == 1, "the first rank says how to resume"
    # They agree after the seventeenth batch.
    assert checkpoint.checkpoints(models(folder, "stops"))[-1].name == f"step-{17 * RANKS - 1:09d}.ckpt"


ON_CPUS = """
import os, sys
import torch
import torch.distributed as dist
import sundae_ns.plugin.distributed
from nerfstudio.scripts import train
from nerfstudio.utils import comms
from sundae_ns.core.errors import show_in_one_line

show_in_one_line()  # as the first import of our methods does

def worker(rank, train_loop, ranks, _, __, url, config, *___):
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=url, world_size=ranks, rank=rank)
    comms.LOCAL_PROCESS_GROUP = dist.new_group(list(range(ranks)))
    train_loop(rank, ranks, config, rank)

# nerfstudio starts several ranks on GPUs only.
train._distributed_worker = worker
sundae_ns.plugin.distributed.check_machine = lambda *_: None
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
def test_signals_to_the_command_of_two_ranks(folder, tmp_path, number, whole_group, after, saves):
    (tmp_path / "ns-train").write_text(ON_CPUS)
    options = "--timestamp now --vis tensorboard --machine.num-devices 2 --machine.device-type cpu"
    words = ["sundae-tiny", "--data", str(folder / "scene"), "--output-dir", str(tmp_path), *options.split()]
    with forked.started(tmp_path / "ns-train", *words) as (process, output):
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


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"pipeline.model.camera_optimizer.mode": "SO3xR3"}, "a camera optimizer does not work on several GPUs"),
        ({"mixed_precision": True}, "--mixed-precision"),
        ({"gradient_accumulation_steps": {"means": 2}}, "--gradient-accumulation-steps"),
        (
            {"pipeline.model.pruning.mode": "continuous", "pipeline.model.pruning.max_gaussians": 9},
            "continuous pruning to a count",
        ),
        ({"machine.device_type": "cpu"}, "needs GPUs.*device-type is cpu"),
        ({"machine.num_devices": 3}, "is 3 and there are 2 GPUs; give --machine.num-devices 2"),
    ],
)
def test_what_several_ranks_cannot_do_is_refused_before_anything_is_written(tmp_path, monkeypatch, options, words):
    from trial_runs import set_options

    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    config = configured(tmp_path, "refused")
    config.machine.device_type = "cuda"
    set_options(config, options)
    with pytest.raises(ConfigError, match=words):
        config.save_config()
    assert not config.get_base_dir().exists()


def test_one_process_is_left_as_it_is():
    ranks, config = distributed.Ranks(), object()
    assert ranks.configured(config) is config
    assert ranks.agreed(15, 3) == 15
    with ranks.whole() as first:
        assert first


def test_an_error_of_sundae_in_a_rank_keeps_its_message():
    class Raised(Exception):
        error_index = 1

    text = "\n\n-- Process 1 terminated with the following error:\n"
    text += "Traceback ...\nsundae_ns.core.errors.DataError: cause; mend\n"
    assert str(rank_ended(Raised(text))) == "rank 1: cause; mend"
    assert "rank 1 ended (ValueError: odd)" in str(rank_ended(Raised("Traceback ...\nValueError: odd")))


@pytest.mark.gpu
@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs")
def test_ns_train_on_two_gpus(tmp_path):
    """The command of users; the run opens on one GPU like any other."""
    from nerfstudio.utils.eval_utils import eval_setup

    from harness.still_life import write_still_life

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
