"""Saving and finding checkpoints: whole ones only, and a full disk costs none."""

import fcntl
import os
import random
import re
import sys
import zipfile
from copy import deepcopy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion, all_methods
from nerfstudio.engine.trainer import Trainer
from nerfstudio.viewer.render_state_machine import RenderStateMachine
from torch.multiprocessing.spawn import ProcessExitedException, ProcessRaisedException
from trial_runs import set_options

from harness.still_life import write_still_life
from sundae_ns.core.errors import NOTHING_SAVED, CheckpointError, ConfigError, DataError, StorageError, show_in_one_line
from sundae_ns.io import checkpoint
from sundae_ns.io.checkpoint import random_state, set_random_state
from sundae_ns.io.config_file import load_config
from sundae_ns.plugin.trainer import SundaeTrainer, SundaeTrainerConfig
from sundae_ns.train.progress import Interruption
from sundae_ns.train.schedules import set_schedule


def state(step, n=50):
    return {"step": step, "pipeline": {"_model.gauss_params.means": torch.full((n, 3), float(step))}}


def name(step):
    return f"step-{step:09d}.ckpt"


def saved(folder, *steps):
    for step in steps:
        checkpoint.write(state(step), folder / name(step))


def test_the_newest_is_by_step(tmp_path):
    models = tmp_path / "nerfstudio_models"
    saved(models, 999, 1_000_000_000)
    (models / "step-best.ckpt").write_text("a user's own file")
    for folder in (tmp_path, models):
        assert checkpoint.newest_whole(folder) == (models / name(1_000_000_000), [])
        assert checkpoint.newest_step(folder) == 1_000_000_000
    loaded = checkpoint.read(models / name(999))
    assert loaded["step"] == 999
    assert torch.equal(loaded["pipeline"]["_model.gauss_params.means"], torch.full((50, 3), 999.0))


def flip(path):
    """One bit of a tensor, which torch would load without a word."""
    content = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        (entry,) = (entry for entry in archive.infolist() if entry.filename.endswith("data/0"))
    content[entry.header_offset + 300] ^= 1
    path.write_bytes(content)
    torch.load(path, weights_only=True)


@pytest.mark.parametrize("harm", [lambda path: path.write_bytes(b""), flip], ids=["empty", "flipped"])
def test_what_is_not_whole_is_passed_over(tmp_path, harm):
    saved(tmp_path, 10, 20, 30)
    harm(tmp_path / name(30))
    path, passed_over = checkpoint.newest_whole(tmp_path)
    assert path == tmp_path / name(20)
    assert checkpoint.newest_step(tmp_path) == 20
    assert [name(30) in line for line in passed_over] == [True]
    with pytest.raises(CheckpointError, match="is not a checkpoint"):
        checkpoint.read(tmp_path / name(30))
    for step in (10, 20):
        harm(tmp_path / name(step))
    with pytest.raises(CheckpointError, match="no whole checkpoint[^\n]*give the folder of a run[^\n]*$"):
        checkpoint.newest_whole(tmp_path)


@pytest.mark.parametrize(
    ("older", "remedy"), [((10, 15), r"make room \(the one of step 10 is whole, "), ((), "no older checkpoint")]
)
def test_a_full_disk_leaves_the_older_checkpoint(tmp_path, monkeypatch, older, remedy):
    saved(tmp_path, *older)
    for step in older[1:]:
        flip(tmp_path / name(step))

    def full(state, file):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(StorageError, match=f"disk is full; [^\n]*{remedy}[^\n]*$"):
        saved(tmp_path, 20)
    assert sorted(os.listdir(tmp_path)) == [name(step) for step in older]


def test_nerfstudio_finds_its_newest_beside_a_killed_save(tmp_path):
    """nerfstudio's own commands read a step off every name in the folder."""
    saved(tmp_path, 10, 20)
    (tmp_path / checkpoint._PARTIAL.format(os.getpid())).write_bytes(b"half")
    assert sorted(int(x[x.find("-") + 1 : x.find(".")]) for x in os.listdir(tmp_path))[-1] == 20
    saved(tmp_path, 30)
    assert sorted(os.listdir(tmp_path)) == [name(10), name(20), name(30)]


def test_random_numbers_go_on_where_they_were_left(tmp_path):
    def draw():
        return [random.random(), random.gauss(0, 1), np.random.rand(), np.random.randn(), torch.randn(3).tolist()]

    draw()
    checkpoint.write({**state(1), "random": random_state()}, tmp_path / name(1))
    expected = draw()
    assert draw() != expected
    set_random_state(checkpoint.read(tmp_path / name(1))["random"])
    assert draw() == expected


def test_a_checkpoint_that_unpacks_to_more_is_refused(tmp_path):
    saved(tmp_path, 1)
    deflated = tmp_path / name(2)
    with zipfile.ZipFile(tmp_path / name(1)) as source, zipfile.ZipFile(deflated, "w", zipfile.ZIP_DEFLATED) as target:
        for entry in source.namelist():
            target.writestr(entry, source.read(entry))
    with pytest.raises(CheckpointError, match="unpack to more"):
        checkpoint.read(deflated)


def test_a_config_is_written_into_a_folder_of_its_own(tmp_path):
    config = SundaeTrainerConfig(method_name="m", experiment_name="e", timestamp="t", output_dir=tmp_path)
    config.set_timestamp()  # the user's own stays
    run = tmp_path / "e" / "m" / "t"
    run.mkdir(parents=True)
    with (run / "training.lock").open("w") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        print("process 17 on another", file=other, flush=True)
        with pytest.raises(StorageError, match="^process 17 on another trains in .*/t; "):
            config.save_config()
    assert os.listdir(run) == ["training.lock"]
    config.save_config()
    assert sorted(os.listdir(run)) == ["config.yml", "training.lock"]
    assert (run / "config.yml").read_text().startswith("!!python/object:sundae_ns.plugin.trainer.")
    config.output_dir = run / "config.yml"
    with pytest.raises(StorageError, match="cannot write to the run.s folder .*: a file stands where"):
        config.save_config()


def test_a_fault_while_training_is_named_and_ends_the_viewer(tmp_path, monkeypatch):
    def fail(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Trainer, "train", fail)
    made = SundaeTrainer.__new__(SundaeTrainer)
    made.base_dir, made._interruption = tmp_path, Interruption(lambda: None)
    viewer = SimpleNamespace(ready=False, render_statemachines={})
    machine = viewer.render_statemachines[0] = RenderStateMachine(viewer, 1.0, None)
    machine.start()
    made.viewer_state = viewer
    with pytest.raises(StorageError, match="cannot write to the run's folder .*disk is full"):
        made.train()
    assert not machine.is_alive(), "a thread that renders when Python exits aborts the process"


def stopped(code, signal=None):
    return ProcessExitedException("process 1 ended", error_index=1, error_pid=2, exit_code=code, signal_name=signal)


def raised(line):
    text = f"\n\n-- Process 1 terminated with the following error:\nTraceback ...\n{line}\n"
    return ProcessRaisedException(text, error_index=1, error_pid=2)


@pytest.mark.parametrize(
    ("program", "error", "code", "printed"),
    [
        ("ns-train", DataError("the cause; the remedy"), 1, "sundae: the cause; the remedy\n"),
        ("other", DataError("the cause; the remedy"), 1, "Traceback .*"),
        ("ns-train with SUNDAE_TRACEBACK", DataError("the cause; the remedy"), 1, "Traceback .*"),
        ("ns-train", OSError("odd"), 1, "Traceback .*"),
        ("ns-viewer", KeyboardInterrupt(), 130, "\nStopped.\n"),
        ("ns-train", stopped(143), 143, ""),
        ("ns-train that gets SIGINT", stopped(-15), 130, f"\n{NOTHING_SAVED}\n"),
        ("ns-train", stopped(-9, "SIGKILL"), 1, "sundae: rank 1 ended .killed by SIGKILL.[^\n]*\n"),
        ("ns-train", raised("sundae_ns.core.errors.DataError: cause; mend"), 1, "sundae: rank 1: cause; mend\n"),
        ("ns-train", raised("ValueError: odd"), 1, "sundae: rank 1 ended .ValueError: odd.[^\n]*\n"),
    ],
)
def test_how_commands_of_nerfstudio_end(monkeypatch, capsys, program, error, code, printed):
    monkeypatch.setattr(sys, "argv", [f"/usr/bin/{program}"])
    monkeypatch.setattr(sys, "excepthook", sys.__excepthook__)
    monkeypatch.setattr("sundae_ns.core.errors.passed_on", [2] if "SIGINT" in program else [])
    monkeypatch.setenv("SUNDAE_TRACEBACK", "1" if "TRACEBACK" in program else "")
    show_in_one_line()
    ended = 1  # as Python does after the hook
    try:
        raise error
    except BaseException:
        try:
            sys.excepthook(*sys.exc_info())
        except SystemExit as end:
            ended = end.code
    assert ended == code
    assert re.fullmatch(printed, capsys.readouterr().err, re.DOTALL)


def configured(tmp_path, **options):
    """The configuration of ``ns-train sundae`` with options by their dotted names, and its schedule."""
    config = deepcopy(all_methods["sundae"])
    config.output_dir, config.experiment_name, config.timestamp = tmp_path, "e", "t"
    set_options(config, options)
    set_schedule(config, all_methods["sundae"], [f"--{name.replace('_', '-')}" for name in options])
    return config


def test_the_number_of_steps_alone_sets_the_schedule(tmp_path):
    words = {"max_num_iterations": 3000, "pipeline.model.stop_split_at": 15000}
    config = configured(tmp_path, **words)
    model = config.pipeline.model
    assert (config.schedule_length, model.pruning.prune_at, model.stop_split_at) == (3000, 1200, 15000)
    first_part = configured(tmp_path, **words, schedule_length=30000)
    assert (first_part.schedule_length, first_part.pipeline.model.pruning.prune_at) == (30000, 12000)
    for option in ("max_num_iterations", "schedule_length"):
        with pytest.raises(ConfigError, match="length of the run is 0; give"):
            configured(tmp_path, **{option: 0})


def test_a_fine_tune_takes_the_place_of_the_last_steps(tmp_path):
    def steps(tuned=1500, **options):
        return configured(tmp_path, finetune_steps=tuned, **options).max_num_iterations

    config = configured(tmp_path, finetune_steps=1500)
    assert (config.max_num_iterations, config.schedule_length) == (28500, 30000)
    assert config.pipeline.model.pruning.prune_at == 12000, "the schedule is that of the whole run"
    for length, left in ((29999, 29999), (60000, 58500)):  # at most a twentieth
        assert steps(max_num_iterations=length) == left
    assert steps(max_num_iterations=10000, schedule_length=30000) == 10000
    config.save_config()
    folder = config.get_base_dir() / "nerfstudio_models"
    saved(folder, 19999)
    assert [steps(tuned, load_dir=folder) for tuned in (1500, None)] == [8500, 10000]
    assert steps(load_dir=folder, max_num_iterations=9000) == 9000
    saved(folder, 28499)
    assert steps(load_dir=folder) == 1500, "all others are done"
    with pytest.raises(ConfigError, match="finetune-steps is 0; give 1500, or leave it out"):
        steps(0)


def test_a_resumed_run_has_the_schedule_of_its_config(tmp_path):
    run = configured(tmp_path, max_num_iterations=3000, **{"pipeline.model.pruning.prune_at": 1000})
    run.save_config()
    folder = run.get_base_dir()
    checkpoints = folder / "nerfstudio_models"
    checkpoints.mkdir()
    for place in (folder, checkpoints):
        words = {"max_num_iterations": 700, "pipeline.model.sh_degree_interval": 5}
        again = configured(tmp_path, load_dir=place, **words)
        assert (again.schedule_length, again.max_num_iterations) == (3000, 700)
        model = again.pipeline.model
        assert (model.pruning.prune_at, model.resolution_schedule, model.sh_degree_interval) == (1000, 300, 5)
        assert again.optimizers == run.optimizers
    saved(checkpoints, 999, 1999)
    (checkpoints / name(2999)).write_text("half")  # the steps that are lost are left
    for place in (folder, checkpoints):
        assert configured(tmp_path, load_dir=place).max_num_iterations == 1000
    assert configured(tmp_path, load_dir=folder, load_step=999).max_num_iterations == 2000
    saved(checkpoints, 2999)
    with pytest.raises(ConfigError, match="has trained all of its 3,000 steps; give .*--max-num-iterations"):
        configured(tmp_path, load_dir=folder)
    (folder / "config.yml").write_text("damaged: [")
    alone = configured(tmp_path, load_dir=folder, max_num_iterations=700)
    assert alone.pipeline.model.pruning.prune_at == 12000, "nothing says how long the run was meant to be"


def test_the_schedule_is_logged_and_saved(tmp_path, monkeypatch, capsys):
    config = tyro.cli(AnnotatedBaseConfigUnion, args=["sundae", "--max-num-iterations", "3000"])
    config.output_dir, config.experiment_name, config.timestamp = Path("outputs"), "e", "t"
    config.pipeline.datamanager.data = Path("capture")
    monkeypatch.setattr(sys, "argv", ["ns-train", "sundae", "--max-num-iterations", "3000"])
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for name, value, says in (
        ("machine.num_devices", 0, "^--machine.num-devices is 0; give a whole number, at least 1$"),
        ("machine.seed", -1, "^--machine.seed is -1; give a whole number, at least 0$"),
        ("machine.device_type", "cuda", "device-type is cuda and torch sees no GPU; give cpu, or run"),
        ("gradient_accumulation_steps", {"means": 2}, "loses gradients at prunes and at a resume; leave it out$"),
        ("max_num_iterations", 3000, "capture does not exist"),
    ):
        set_options(wrong := deepcopy(config), {"machine.device_type": "cpu", name: value})
        with pytest.raises((ValueError, RuntimeError), match=says):
            wrong.print_to_terminal()
    assert list(tmp_path.iterdir()) == []
    write_still_life(tmp_path / "capture", train_views=3, test_views=1, width=16, height=16, points=9)
    config.pipeline.model.refine_every = 0
    with pytest.raises(ConfigError, match="refine-every is 0; give 1 or more"):
        config.print_to_terminal()
    config.pipeline.model.refine_every = all_methods["sundae"].pipeline.model.refine_every
    config.print_to_terminal()
    config.save_config()
    shown = capsys.readouterr().out
    assert len(shown.splitlines()) <= 20
    assert re.search(r"3,000 steps", shown)
    assert re.search(r"prune .* after 1,200", shown)
    saved = load_config(tmp_path / "outputs" / "e" / "sundae" / "t" / "config.yml")
    assert saved.pipeline.datamanager.data == tmp_path / "capture"
    assert saved.get_base_dir() == tmp_path / "outputs" / "e" / "sundae" / "t"
    assert (saved.pipeline.model.pruning.prune_at, saved.schedule_length) == (1200, 3000)
    monkeypatch.setenv("HOME", str(tmp_path))
    config.load_dir = Path("~/run that is resumed")
    config.make_paths_absolute()
    assert config.load_dir == tmp_path / "run that is resumed", "sundae train --resume offers no run twice"
