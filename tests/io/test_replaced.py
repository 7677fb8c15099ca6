"""Reading a run while its training replaces the checkpoint."""

import shutil
import threading
from pathlib import Path

import pytest
import torch
from fields import random_field

import sundae_ns as sn
from sundae_ns.cli import main
from sundae_ns.core.errors import CheckpointError
from sundae_ns.io import checkpoint
from sundae_ns.io.formats import read_gaussians

N = 20


class Training:
    """A run whose checkpoint is replaced as the trainer does it: the next one appears, then the others go."""

    def __init__(self, folder):
        self.run, self.step, self.models = folder / "run", 0, folder / "run" / "nerfstudio_models"
        self.models.mkdir(parents=True)
        (self.run / "config.yml").write_text("pipeline:\n  model: {}\n")
        self.whole = folder / "whole"
        state = {f"_model.gauss_params.{name}": value for name, value in random_field(N, features=0).items()}
        torch.save({"step": 0, "pipeline": state}, self.whole)
        self.save()

    def save(self):
        self.step += 1
        partial = shutil.copy(self.whole, self.models / "partial")
        new = Path(partial).replace(self.models / f"step-{self.step:09d}.ckpt")
        for other in self.models.glob("step-*"):
            if other != new:
                other.unlink()


@pytest.fixture
def training(tmp_path):
    return Training(tmp_path)


def exported(run):
    with pytest.raises(SystemExit) as end:
        main(["export", str(run), "-o", str(run.parent / "a.ply"), "--overwrite"])
    assert not end.value.code


READERS = {
    "load": sn.load,
    "read_gaussians": read_gaussians,
    "export": exported,
}


@pytest.mark.parametrize("lost", ["listed", "checked"])
@pytest.mark.parametrize("reader", READERS)
def test_a_checkpoint_may_go_between_any_two_steps_of_a_read(training, monkeypatch, reader, lost):
    module, name = {"listed": (checkpoint, "checkpoints"), "checked": (torch, "load")}[lost]
    original, after = getattr(module, name), lost == "listed"
    replaced = []

    def replacing(*arguments, **options):
        found = original(*arguments, **options) if after else None
        if len(replaced) < 2:
            replaced.append(True)
            training.save()
        return found if after else original(*arguments, **options)

    monkeypatch.setattr(module, name, replacing)
    READERS[reader](training.run)
    assert replaced


def test_every_read_beside_a_training_that_saves_all_the_time_succeeds(training):
    done = threading.Event()

    def save():
        while not done.is_set():
            training.save()

    thread = threading.Thread(target=save)
    thread.start()
    try:
        while training.step < 50:
            assert sn.load(training.run).num_gaussians == N
    finally:
        done.set()
        thread.join()


def test_a_run_without_a_whole_checkpoint_is_refused_at_once(training):
    (newest,) = training.models.iterdir()
    newest.write_bytes(b"half")
    (training.models / "step-000000009.ckpt").symlink_to("nowhere")
    with pytest.raises(CheckpointError, match=r"step-000000009.ckpt is not whole \(No such file.*; step-000000001"):
        sn.load(training.run)
