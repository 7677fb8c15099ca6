"""A stranger's run whose ``config.yml`` starts a program: no command of sundae starts it."""

import json
import shutil
from http.server import ThreadingHTTPServer
from pathlib import Path

import pytest
import yaml

from sundae_ns.cli import main
from sundae_ns.cli.main import COMMANDS

HOSTILE = "!!python/object/new:os.system ['touch PWNED']\n"
WORDS = {
    "run": ["CAPTURE", "-o", "PROJECT", "--method", "sundae-tiny"],
    "poses": ["RUN", "-o", "capture"],
    "train": ["CAPTURE", "-o", "runs"],
    "prune": ["RUN", "-o", "out.ply", "--num-cameras", "2"],
    "pack": ["RUN", "-o", "out.sundae"],
    "export": ["RUN", "-o", "out.html"],
    "view": ["RUN", "--no-open-browser"],
    "render": ["RUN", "-o", "out.png"],
    "compare": ["RUN", "-o", "report"],
    "info": ["RUN"],
    "demo": ["DEMO", "--overwrite"],
    "doctor": [],
}
"""Words of each command on a run, or on a folder with one."""


@pytest.fixture
def hostile(tiny, tmp_path, monkeypatch):
    """A hostile run: alone, in a project of ``sundae run``, and in a folder of ``sundae demo``."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(tiny.scene, "CAPTURE")
    config = tiny.config.read_text().replace("\nload_step: null\n", f"\nload_step: {HOSTILE}")
    assert HOSTILE in config
    for folder in ("RUN", "PROJECT/runs/CAPTURE/sundae-tiny/run", "DEMO/runs/scene/sundae-tiny/run"):
        shutil.copytree(tiny.folder, folder)
        Path(folder, "config.yml").write_text(config)
    settings = {"photos": str(Path("CAPTURE").resolve()), "method": "sundae-tiny", "matching": "exhaustive"}
    Path("PROJECT/run.json").write_text(json.dumps({**settings, "keep": None, "steps": None}))
    yield tmp_path
    assert not list(tmp_path.rglob("PWNED"))


def test_nerfstudio_would_run_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    yaml.load(f"a: 1\nload_step: {HOSTILE}", Loader=yaml.Loader)
    assert Path("PWNED").exists()


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.usefixtures("hostile", "short_prunes", "short_distillation")
def test_no_command_runs_it(command, monkeypatch):
    asked = []

    def start(words, *_, **__):
        """A command of sundae in this process; one of nerfstudio is only noted."""
        asked.append(Path(words[0]).name)
        if asked[-1] != "sundae":
            return 0
        with pytest.raises(SystemExit) as caught:
            main(list(words[1:]))
        return int(caught.value.code or 0)

    def stop(server):
        raise KeyboardInterrupt

    for module in ("run", "train"):
        monkeypatch.setattr(f"sundae_ns.cli.{module}.run_command", start)
    monkeypatch.setattr(ThreadingHTTPServer, "serve_forever", stop)
    with pytest.raises(SystemExit):
        main([command, *WORDS[command]])
    # Of nerfstudio's commands, ns-train reads a config.yml by our own reader; the test below starts it.
    assert set(asked) <= {"ns-train", "sundae"}


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("--load-dir", "RUN/nerfstudio_models"),
        ("--load-checkpoint", "RUN/nerfstudio_models/step-000000060.ckpt"),
        ("--pipeline.model.warm-start", "RUN"),
    ],
)
@pytest.mark.usefixtures("hostile")
def test_training_from_it_runs_nothing_of_it(option, value, call_here, monkeypatch):
    begun, usual = [], ("--data", "CAPTURE", "--max-num-iterations", "60", "--vis", "tensorboard")
    monkeypatch.setattr("nerfstudio.scripts.train.launch", lambda config, **_: begun.append(config.setup(local_rank=0)))
    call_here("ns-train", "sundae-tiny", *usual, option, value)
    begun[0].setup()
