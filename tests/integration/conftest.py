"""One tiny run for all tests of this folder, made by the command that users type."""

import io
import os
import sys
import urllib.request
from contextlib import redirect_stdout
from copy import deepcopy
from importlib.metadata import entry_points
from pathlib import Path
from typing import NamedTuple

import pytest
import torch
import yaml
from nerfstudio.configs.method_configs import all_methods
from trial_runs import set_options, tidy

from harness.still_life import write_still_life
from sundae_ns.core.gaussians import sh_degree
from sundae_ns.io import checkpoint

SHORT = """
--experiment-name tiny --timestamp now --vis tensorboard --viewer.quit-on-train-completion True
--save-only-latest-checkpoint False --steps-per-eval-image 50 --logging.steps-per-log 5
--pipeline.model.warmup-length 20 --pipeline.model.refine-every 15 --pipeline.model.densify-grad-thresh 0.0004
--pipeline.model.sh-degree-interval 20
"""
"""Options of the tiny run: one round of densification, at step 30."""


class TinyRun(NamedTuple):
    """A finished run and what is known of it."""

    scene: Path
    folder: Path
    output: str  # What ns-train printed
    points: int = 300  # Size of the sparse cloud
    prune_at: int = 45
    save_every: int = 30
    steps: int = 120
    keep_ratio: float = 0.5

    @property
    def config(self):
        return self.folder / "config.yml"

    @property
    def checkpoints(self):
        return self.folder / "nerfstudio_models"

    def checkpoint(self, step):
        return self.checkpoints / f"step-{step:09d}.ckpt"


@pytest.fixture(scope="session")
def call_here(tmp_path_factory):
    """Run an installed command in this process, which has imported nerfstudio, out of reach of any network.

    Returns what it printed.
    """
    ffmpeg = tmp_path_factory.mktemp("bin") / "ffmpeg"
    ffmpeg.write_text("#!/bin/sh\nexit 1\n")
    ffmpeg.chmod(0o755)
    # ns-render asks for ffmpeg even where it writes images only; one that is installed comes first.
    path, nowhere = os.pathsep.join([os.environ.get("PATH", ""), str(ffmpeg.parent)]), "http://127.0.0.1:9"

    def run(*arguments):
        words = [str(word) for word in arguments]
        (command,) = entry_points(group="console_scripts", name=words[0])
        with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()) as out:
            patch.setattr(sys, "argv", words)
            patch.setattr(urllib.request, "_opener", None)  # urlopen keeps the proxies of its first call
            for name, value in {"PATH": path, "https_proxy": nowhere, "http_proxy": nowhere}.items():
                patch.setenv(name, value)
            try:
                command.load()()
            except SystemExit as end:
                if end.code:
                    pytest.fail(f"{' '.join(words)}\nexit code {end.code}\n{out.getvalue()}")
        return out.getvalue()

    return run


@pytest.fixture(scope="session")
def tiny(call_here, once):
    known = TinyRun(Path(), Path(), "")

    def train(root):
        scene = write_still_life(root / "scene", train_views=12, test_views=3, width=48, height=48, points=known.points)
        options = {"data": scene, "output-dir": root / "outputs", "max-num-iterations": known.steps}
        options |= {"steps-per-save": known.save_every, "pipeline.model.pruning.prune-at": known.prune_at}
        options |= {"pipeline.model.pruning.keep-ratio": known.keep_ratio}
        words = [word for name, value in options.items() for word in (f"--{name}", value)] + SHORT.split()
        (root / "output.txt").write_text(call_here("ns-train", "sundae-tiny", *words))
        tidy()

    root = once("tiny", train)
    folder = root / "outputs" / "tiny" / "sundae-tiny" / "now"
    return TinyRun(root / "scene", folder, (root / "output.txt").read_text())


@pytest.fixture(scope="session")
def stock_run(tiny):
    """Write a run of splatfacto as nerfstudio does, with Gaussians that are given: it cannot train without CUDA."""

    def write(folder, gaussians, step):
        config = deepcopy(all_methods["splatfacto"])
        config.data = config.pipeline.datamanager.data = tiny.scene
        config.pipeline.model.sh_degree = sh_degree(gaussians["features_rest"])
        state = {f"_model.gauss_params.{name}": value for name, value in gaussians.items() if name != "features"}
        state["_model.device_indicator_param"] = torch.zeros(0)
        checkpoint.write({"step": step, "pipeline": state}, folder / "nerfstudio_models" / f"step-{step:09d}.ckpt")
        (folder / "config.yml").write_text(yaml.dump(config))
        return folder

    return write


@pytest.fixture(autouse=True)
def _no_network(monkeypatch):
    def refuse(*_, **__):
        raise OSError("no network in tests")

    monkeypatch.setattr(urllib.request, "urlopen", refuse)


@pytest.fixture
def trainer_of(tiny, tmp_path):
    """Set up nerfstudio's trainer in this process with the configuration of the tiny run; options, and those of the
    model, by their dotted names."""

    def make(model=(), **options):
        config = yaml.load(tiny.config.read_text(), Loader=yaml.Loader)
        rare = {"output_dir": tmp_path, "steps_per_save": 10000, "steps_per_eval_image": 10000}
        set_options(config, {**rare, **options})
        set_options(config.pipeline.model, {"evaluate_prune": False, **dict(model)})
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        return trainer

    yield make
    tidy()


@pytest.fixture
def resumed(trainer_of):
    """Resume a run, of the checkpoints in a folder, after a step and for some steps."""
    names = ("load_dir", "load_step", "max_num_iterations")
    return lambda *start, **options: trainer_of(**dict(zip(names, start, strict=True)), **options)
