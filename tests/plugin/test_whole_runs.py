"""Whole runs of two ranks over gloo: they train, prune, save, resume and fail as the documentation says.

``rank.py`` runs the checks of this file on each rank; the tests read their results. Started as a program, the file
trains a run whose rank is killed or gets a signal. Every program has a time limit.
"""

from __future__ import annotations

import copy
import json
import logging
import multiprocessing
import os
import re
import shutil
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import forked
import pytest
import torch
import torch.distributed as dist
from PIL import Image
from trial_runs import set_options, tidy

from harness.still_life import write_still_life
from sundae_ns.core.errors import NOTHING_SAVED, ConfigError, show_in_one_line
from sundae_ns.io import checkpoint
from sundae_ns.method_configs import sundae_tiny
from sundae_ns.plugin import distributed
from sundae_ns.plugin.trainer import SundaeTrainer
from sundae_ns.train import averaging

RANKS = 2
LIMIT = 600  # Seconds that a program may take on a busy machine
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
    model.warm_start = saved(folder, "train")
    model.evaluate_prune = False
    for group in config.optimizers.values():
        group["optimizer"].lr, group["scheduler"] = 0.0, None
    return config


def models(folder, name):
    return folder / name / "sundae-tiny" / "now" / "nerfstudio_models"


def saved(folder, name, step=SAVED_AT):
    return models(folder, name) / f"step-{step:09d}.ckpt"


def train(config, rank, ranks):
    torch.manual_seed(config.machine.seed + rank)
    trainer = config.setup(local_rank=rank, world_size=ranks)
    trainer.setup()
    trainer.train()
    tidy()
    return trainer


def check_training(rank, folder):
    """A run of two ranks, from a viewer's command; both end with the same head and schedules, and balanced shards."""
    averaging.AVERAGED_EVERY = 1
    config = configured(folder, "train")
    config.schedule_length = STEPS  # as ns-train sets it
    config.vis = "viewer+tensorboard"
    trainer = train(config, rank, RANKS)
    assert (trainer.config.vis, config.vis) == ("tensorboard", "viewer+tensorboard")
    assert logging.getLogger("sundae_ns.train").isEnabledFor(logging.WARNING) == (rank == 0), "each line is logged once"
    model = trainer.pipeline.model
    weights = torch.cat([value.detach().flatten() for value in model.head.parameters()])
    every = [torch.empty_like(weights) for _ in range(RANKS)]
    dist.all_gather(every, weights)
    assert torch.equal(every[0], every[1])
    assert model.state.harmonics_every == 2 * RANKS  # an image of each rank counts as a step
    assert model.num_points == model.source.sizes[rank]
    assert max(model.source.sizes) - min(model.source.sizes) <= 1
    group = trainer.optimizers.optimizers["opacities"].param_groups[0]
    assert (group["lr"], tuple(group["betas"])) == (0.05, (0.9, 0.999))
    for scheduler in trainer.optimizers.schedulers.values():
        assert scheduler.last_epoch == STEPS
    assert trainer.optimizers.schedulers["means"].state_dict()["lr_lambdas"][0]["pruned_at"] == PRUNE_AT


def check_frozen(rank, folder):
    train(frozen(folder, "two"), rank, RANKS)


def check_few(rank, folder):
    """A field of one Gaussian trains, is saved and resumed within a batch, with nothing on one rank."""
    config = frozen(folder, "few")
    config.pipeline.model.pruning.keep_ratio = 1e-6
    config.max_num_iterations = RANKS + 1
    train(config, rank, RANKS)
    config = frozen(folder, "few again")
    config.load_checkpoint = saved(folder, "few", RANKS)
    config.max_num_iterations = 2 * RANKS
    trainer = train(config, rank, RANKS)
    assert trainer.step == 3 * RANKS
    assert trainer.model.source.sizes == [0, 1]
    (moments,) = trainer.optimizers.optimizers["features_rest"].state.values()
    before = checkpoint.read(config.load_checkpoint)["optimizers"]["features_rest"]["state"][0]
    assert moments["step"] == before["step"] + 1


def checks(folder):
    """The checks of each rank, in this order."""
    return {check.__name__: partial(check, folder=folder) for check in (check_training, check_frozen, check_few)}


def train_rank(rank, folder, name, send):
    """Train from a checkpoint of two ranks; rank 1 sends a signal in the second of its batches."""
    train_iteration = SundaeTrainer.train_iteration

    def iteration(self, step):
        if (rank, step) == (1, SAVED_AT + 3):
            send()
        return train_iteration(self, step)

    SundaeTrainer.train_iteration = iteration
    config = configured(folder, name)
    config.load_checkpoint = saved(folder, "train")
    dist.init_process_group("gloo", init_method=f"file://{folder}/meeting-{name}", rank=rank, world_size=RANKS)
    train(config, rank, RANKS)
    dist.destroy_process_group()


def main(folder, name):
    """Two ranks resume: one is killed, as the system does when memory is short, or a terminal sends Ctrl-C to all."""
    torch.set_num_threads(1)
    sys.argv = ["ns-train"]
    show_in_one_line()
    distributed.forward_signals()
    send = {"dies": lambda: os.kill(os.getpid(), signal.SIGKILL), "stops": lambda: os.killpg(0, signal.SIGINT)}[name]
    # Forked ranks have imported nerfstudio; ns-train spawns them.
    torch.multiprocessing.start_processes(train_rank, (folder, name, send), nprocs=RANKS, start_method="fork")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])


@pytest.fixture(scope="module")
def folder(tmp_path_factory, run_ranks):
    """Runs of two ranks, trained once for all tests."""
    folder = tmp_path_factory.mktemp("ranks")
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
    before, after = (checkpoint.read(saved(folder, "train", step)) for step in (SAVED_AT, STEPS - 1))
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
    two = checkpoint.read(saved(folder, "two", RANKS - 1))["pipeline"]
    for name, value in one.pipeline.model.gauss_params.items():
        assert torch.equal(value.detach(), two[f"_model.gauss_params.{name}"]), name


def test_one_process_resumes_a_run_of_two(folder):
    config = configured(folder, "alone")
    config.load_checkpoint = saved(folder, "train")
    config.max_num_iterations = PRUNE_AT - SAVED_AT + 1
    trainer = train(config, 0, 1)
    (report,) = json.loads((models(folder, "alone").parent / "prune.json").read_text())
    assert (report["step"], report["after"]) == (PRUNE_AT, round(KEEP * report["before"]))
    assert trainer.optimizers.schedulers["means"].last_epoch == trainer.step + 1


def test_a_killed_rank_ends_all_with_one_line(folder):
    code, printed = forked.run(Path(__file__), folder, "dies")
    assert code == 1, printed
    line = r"sundae: rank 1 ended \(killed by SIGKILL\).*--load-dir.*--machine\.num-devices"
    assert re.fullmatch(line, printed.strip().splitlines()[-1])
    assert not saved(folder, "dies", SAVED_AT + STEPS).exists()


def test_ranks_stop_together_and_save_after_a_signal_of_the_terminal(folder):
    code, printed = forked.run(Path(__file__), folder, "stops")
    assert code == 130, printed
    assert printed.count("--load-dir") == 1, "the first rank says how to resume"
    assert "Traceback" not in printed
    # They agree after each sixteenth batch.
    assert checkpoint.checkpoints(models(folder, "stops")) == [saved(folder, "stops", 17 * RANKS - 1)]


def test_a_signal_to_the_command_ends_it_or_reaches_the_ranks(still_life, tmp_path, capsys, monkeypatch):
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    ranks, passed_on = [], []
    monkeypatch.setattr(distributed, "passed_on", passed_on)
    monkeypatch.setattr(multiprocessing, "active_children", lambda: ranks)
    try:
        config = configured(tmp_path, "signals")
        config.pipeline.datamanager.data = still_life
        config.print_to_terminal()
        for number in before:
            with pytest.raises(SystemExit) as ended:
                signal.raise_signal(number)
            assert ended.value.code == 128 + number
        assert capsys.readouterr().err.count(NOTHING_SAVED) == 2
        ranks.append(subprocess.Popen(["sleep", "60"]))
        signal.raise_signal(signal.SIGINT)
        assert (passed_on, ranks[0].wait()) == ([signal.SIGINT], -signal.SIGTERM)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"pipeline.model.camera_optimizer.mode": "SO3xR3"}, "a camera optimizer does not work on several GPUs"),
        ({"mixed_precision": True}, "--mixed-precision"),
        (
            {"pipeline.model.pruning.mode": "continuous", "pipeline.model.pruning.max_gaussians": 9},
            "continuous pruning to a count",
        ),
        ({"machine.device_type": "cpu"}, "needs GPUs.*device-type is cpu; give 1"),
        ({"machine.num_devices": 3}, "is 3 and there are 2 GPUs; give 2"),
    ],
)
def test_what_several_ranks_cannot_do_is_refused_before_anything_is_written(tmp_path, monkeypatch, options, words):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    config = configured(tmp_path, "refused")
    config.machine.device_type = "cuda"
    set_options(config, options)
    with pytest.raises(ConfigError, match=words):
        config.save_config()
    assert not config.get_base_dir().exists()


@pytest.mark.gpu
@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs")
def test_ns_train_on_two_gpus(tmp_path):
    """The command of users; the run opens on one GPU like any other."""
    from nerfstudio.utils.eval_utils import eval_setup

    write_still_life(tmp_path / "scene", train_views=12, test_views=3, width=64, height=48, points=300)
    options = f"--machine.num-devices 2 --data {tmp_path}/scene --output-dir {tmp_path} --experiment-name gpus"
    options += f" --timestamp now --max-num-iterations 240 --pipeline.model.pruning.keep-ratio {KEEP}"
    options += " --pipeline.model.pruning.prune-at 120 --pipeline.model.warmup-length 10"
    options += " --pipeline.model.refine-every 30 --viewer.quit-on-train-completion True"
    program = [sys.executable, "-m", "nerfstudio.scripts.train", "sundae-tiny"]
    subprocess.run([*program, *options.split()], timeout=2 * LIMIT, check=True, cwd=tmp_path)
    run = tmp_path / "gpus" / "sundae-tiny" / "now"
    (report,) = json.loads((run / "prune.json").read_text())
    assert report["after"] == round(KEEP * report["before"])
    _, pipeline, _, step = eval_setup(run / "config.yml", test_mode="test")
    assert step == 239
    assert pipeline.model.num_points == report["after"]
    # 16 dB is far above a field that has not learned, and far below one that has.
    assert pipeline.get_average_eval_image_metrics()["psnr"] > 16
