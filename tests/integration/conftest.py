"""One tiny run for all tests of this folder, made by the commands that users type."""

import io
import os
import shutil
import subprocess
import sys
import urllib.request
from contextlib import redirect_stdout
from importlib.metadata import entry_points
from pathlib import Path
from typing import NamedTuple

import pytest
import yaml
from nerfstudio.utils import profiler, writer
from short_prunes import short_prunes  # noqa: F401

from harness.still_life import write_still_life


class TinyRun(NamedTuple):
    """A finished run and what is known of it."""

    scene: Path
    folder: Path
    output: str
    """What ns-train printed."""
    points: int
    """Size of the sparse cloud."""
    prune_at: int
    save_every: int
    steps: int
    keep_ratio: float

    @property
    def config(self):
        return self.folder / "config.yml"

    @property
    def checkpoints(self):
        return self.folder / "nerfstudio_models"

    def checkpoint(self, step):
        return self.checkpoints / f"step-{step:09d}.ckpt"


@pytest.fixture(scope="session")
def environment(tmp_path_factory):
    """Variables for the installed commands: where they lie, a wide terminal, and no network."""
    folder = tmp_path_factory.mktemp("bin")
    ffmpeg = folder / "ffmpeg"
    ffmpeg.write_text("#!/bin/sh\nexit 1\n")
    ffmpeg.chmod(0o755)
    commands = Path(sys.executable).parent
    # ns-render asks for ffmpeg even where it writes images only; one that is installed comes first.
    path = os.pathsep.join([str(commands), os.environ.get("PATH", ""), str(folder)])
    nowhere = "http://127.0.0.1:9"
    return {"PATH": path, "COLUMNS": "250", "https_proxy": nowhere, "http_proxy": nowhere}


@pytest.fixture(scope="session")
def call(environment):
    """Run an installed command in a fresh process, out of reach of any network; its output is in the error, if any."""

    def run(*arguments):
        words = [str(word) for word in arguments]
        # Beside the interpreter, or where a package was put that the interpreter only knows of.
        command = shutil.which(words[0], path=environment["PATH"])
        assert command is not None, f"{words[0]} is not installed"
        result = subprocess.run(
            [command, *words[1:]],
            capture_output=True,
            text=True,
            env={**os.environ, **environment},
            stdin=subprocess.DEVNULL,
            check=False,
        )
        if result.returncode != 0:
            pytest.fail(f"{' '.join(words)}\nexit code {result.returncode}\n{result.stdout}\n{result.stderr}")
        return result

    return run


@pytest.fixture(scope="session")
def call_here(environment):
    """Run an installed command in this process, which has imported nerfstudio; returns what it printed."""

    def run(*arguments):
        words = [str(word) for word in arguments]
        (command,) = entry_points(group="console_scripts", name=words[0])
        with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()) as out:
            patch.setattr(sys, "argv", words)
            for name, value in environment.items():
                patch.setenv(name, value)
            try:
                command.load()()
            except SystemExit as end:
                if end.code:
                    pytest.fail(f"{' '.join(words)}\nexit code {end.code}\n{out.getvalue()}")
        return out.getvalue()

    return run


@pytest.fixture(scope="session")
def tiny(call, once):
    points, prune_at, save_every, steps, keep_ratio = 300, 45, 30, 120, 0.5

    def train(root):
        write_still_life(root / "scene", train_views=12, test_views=3, width=48, height=48, points=points)
        options = {
            "data": root / "scene",
            "output-dir": root / "outputs",
            "experiment-name": "tiny",
            "timestamp": "now",
            "max-num-iterations": steps,
            "steps-per-save": save_every,
            "save-only-latest-checkpoint": False,
            "steps-per-eval-image": 50,
            "vis": "tensorboard",
            "viewer.quit-on-train-completion": True,
            "logging.steps-per-log": 5,
            "pipeline.model.pruning.prune-at": prune_at,
            "pipeline.model.pruning.keep-ratio": keep_ratio,
            # One round of densification, at step 30.
            "pipeline.model.warmup-length": 20,
            "pipeline.model.refine-every": 15,
            "pipeline.model.densify-grad-thresh": 0.0004,
            "pipeline.model.sh-degree-interval": 20,
        }
        arguments = [word for name, value in options.items() for word in (f"--{name}", value)]
        (root / "output.txt").write_text(call("ns-train", "sundae-tiny", *arguments).stdout)

    root = once("tiny", train)
    folder = root / "outputs" / "tiny" / "sundae-tiny" / "now"
    output = (root / "output.txt").read_text()
    return TinyRun(root / "scene", folder, output, points, prune_at, save_every, steps, keep_ratio)


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
    """Set up nerfstudio's trainer in this process with the tiny run's configuration, changed by a function."""

    def make(change):
        config = yaml.load(tiny.config.read_text(), Loader=yaml.Loader)
        config.output_dir = tmp_path
        config.steps_per_save = 10000
        config.steps_per_eval_image = 10000
        config.pipeline.model.evaluate_prune = False
        change(config)
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        return trainer

    yield make
    # nerfstudio keeps its loggers in globals.
    writer.EVENT_WRITERS.clear()
    writer.EVENT_STORAGE.clear()
    writer.GLOBAL_BUFFER.clear()
    profiler.PROFILER.clear()
