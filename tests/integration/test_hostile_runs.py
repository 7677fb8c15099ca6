"""A stranger's run whose ``config.yml`` starts a program: no command of sundae starts it."""

import json
import shutil
from http.server import ThreadingHTTPServer
from pathlib import Path

import pytest
import yaml

from sundae_ns.cli import main
from sundae_ns.cli.main import COMMANDS

CONFIGS = {
    "nothing else": lambda text: "!!python/object/apply:os.system ['touch PWNED']\n",
    "among options": lambda text: text.replace(
        "\nload_step: null\n", "\nload_step: !!python/object/new:os.system ['touch PWNED']\n"
    ),
}
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


@pytest.fixture(params=CONFIGS)
def hostile(request, tiny, tmp_path, monkeypatch):
    """A hostile run: alone, in a project of ``sundae run``, and in a folder of ``sundae demo``."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(tiny.scene, "CAPTURE")
    config = CONFIGS[request.param](tiny.config.read_text())
    assert "os.system" in config
    for folder in ("RUN", "PROJECT/runs/CAPTURE/sundae-tiny/run", "DEMO/runs/demo/sundae-tiny/run"):
        shutil.copytree(tiny.folder, folder)
        Path(folder, "config.yml").write_text(config)
    settings = {"photos": str(Path("CAPTURE").resolve()), "method": "sundae-tiny", "matching": "exhaustive"}
    Path("PROJECT/run.json").write_text(json.dumps({**settings, "keep": None, "steps": None}))
    yield tmp_path
    assert not list(tmp_path.rglob("PWNED"))


@pytest.mark.parametrize("kind", CONFIGS)
def test_nerfstudio_would_run_it(kind, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    yaml.load(CONFIGS[kind]("a: 1\nload_step: null\n"), Loader=yaml.Loader)
    assert Path("PWNED").exists()


def test_no_command_is_forgotten():
    assert WORDS.keys() == COMMANDS.keys()


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

    monkeypatch.setattr("sundae_ns.cli.run.run_command", start)
    monkeypatch.setattr("sundae_ns.cli.demo.run_command", start)
    monkeypatch.setattr("sundae_ns.cli.train.run_command", start)
    monkeypatch.setattr(ThreadingHTTPServer, "serve_forever", stop)
    with pytest.raises(SystemExit):
        main([command, *WORDS[command]])
    # Of nerfstudio's commands, ns-train reads a config.yml by our own reader; the test below starts it.
    assert set(asked) <= {"ns-train", "sundae"}


@pytest.mark.parametrize(
    "words",
    [
        ["--load-dir", "RUN/nerfstudio_models"],
        ["--load-checkpoint", "RUN/nerfstudio_models/step-000000060.ckpt"],
        ["--pipeline.model.warm-start", "RUN"],
    ],
)
@pytest.mark.usefixtures("hostile")
def test_training_from_it_runs_nothing_of_it(words, call_here, monkeypatch):
    begun = []
    monkeypatch.setattr("nerfstudio.scripts.train.launch", lambda config, **_: begun.append(config.setup(local_rank=0)))
    call_here(
        "ns-train", "sundae-tiny", "--data", "CAPTURE", "--max-num-iterations", "60", "--vis", "tensorboard", *words
    )
    begun[0].setup()
