"""One tiny run for all tests of this folder, made by the command that users type."""

import io
import os
import sys
import urllib.request
from contextlib import redirect_stdout
from importlib.metadata import entry_points
from pathlib import Path
from typing import NamedTuple

import pytest
import yaml
from short_prunes import short_distillation, short_prunes  # noqa: F401
from trial_runs import set_options, tidy

from harness.still_life import write_still_life


class TinyRun(NamedTuple):
    """A finished run and what is known of it."""

    scene: Path
    folder: Path
    output: str
    """What ns-train printed."""
    points: int = 300
    """Size of the sparse cloud."""
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
        options = {
            "data": scene,
            "output-dir": root / "outputs",
            "experiment-name": "tiny",
            "timestamp": "now",
            "max-num-iterations": known.steps,
            "steps-per-save": known.save_every,
            "save-only-latest-checkpoint": False,
            "steps-per-eval-image": 50,
            "vis": "tensorboard",
            "viewer.quit-on-train-completion": True,
            "logging.steps-per-log": 5,
            "pipeline.model.pruning.prune-at": known.prune_at,
            "pipeline.model.pruning.keep-ratio": known.keep_ratio,
            # One round of densification, at step 30.
            "pipeline.model.warmup-length": 20,
            "pipeline.model.refine-every": 15,
            "pipeline.model.densify-grad-thresh": 0.0004,
            "pipeline.model.sh-degree-interval": 20,
        }
        words = [word for name, value in options.items() for word in (f"--{name}", value)]
        (root / "output.txt").write_text(call_here("ns-train", "sundae-tiny", *words))
        tidy()

    root = once("tiny", train)
    folder = root / "outputs" / "tiny" / "sundae-tiny" / "now"
    return TinyRun(root / "scene", folder, (root / "output.txt").read_text())


@pytest.fixture(scope="session")
def exported(tiny, call_here, open3d, once):
    """The .ply that ns-export writes of the tiny run; skips where open3d does not import."""

    def export(folder):
        call_here("ns-export", "gaussian-splat", "--load-config", tiny.config, "--output-dir", folder)

    return once("exported", export) / "splat.ply"


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
    return lambda folder, step, steps, **options: trainer_of(
        load_dir=folder, load_step=step, max_num_iterations=steps, **options
    )
