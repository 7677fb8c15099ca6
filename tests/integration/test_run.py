"""``sundae run`` with the real commands after poses that are given: an interrupted training, and its rest."""

import json
import shutil
import signal
import sys
from importlib.metadata import entry_points
from pathlib import Path

import command_line
import pytest
from fake_colmap import FakeColmap

from sundae_ns.io.formats import kind_of
from sundae_ns.plugin.trainer import SundaeTrainer

STEPS, STOP_AT = 40, 25


@pytest.fixture
def run(tiny, tmp_path, monkeypatch):
    """Run ``sundae run`` with its commands in this process, which has imported nerfstudio; poses are the scene's."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(tiny.scene / "images", "photos")
    monkeypatch.setitem(sys.modules, "pycolmap", FakeColmap())

    def here(words, log=None):
        if words[:2] == ["sundae", "poses"]:
            shutil.copytree(tiny.scene, words[words.index("-o") + 1])
            return 0
        # A viewer in this process would outlive the test.
        words = ["tensorboard" if word == "viewer+tensorboard" else word for word in words]
        (command,) = entry_points(group="console_scripts", name=words[0])
        with monkeypatch.context() as patch:
            patch.setattr(sys, "argv", words)
            try:
                command.load()()
            except SystemExit as end:
                return int(end.code or 0)
        return 0

    for module in ("run", "train"):
        monkeypatch.setattr(f"sundae_ns.cli.{module}.run_command", here)
    return lambda *words: command_line.run("run", *words)


def test_photos_to_a_report_with_an_interruption(run, monkeypatch, capfd):
    words = ("photos", "-o", "out", "--method", "sundae-tiny", "--keep", "0.5", "--steps", STEPS)
    folder, train = Path("out/runs/photos/sundae-tiny/run"), SundaeTrainer.train_iteration

    def interrupted(self, step):
        if step == STOP_AT:
            signal.raise_signal(signal.SIGINT)
        return train(self, step)

    with monkeypatch.context() as patch:
        patch.setattr(SundaeTrainer, "train_iteration", interrupted)
        assert run(*words) == 130
    assert "the same command continues here" in capfd.readouterr().err
    assert [path.name for path in folder.glob("*/*.ckpt")] == [f"step-{STOP_AT:09d}.ckpt"]
    assert not Path("out/scene.sundae").exists()

    assert run(*words) == 0
    assert f"Resuming after step {STOP_AT}" in capfd.readouterr().out
    assert [path.name for path in folder.glob("*/*.ckpt")] == [f"step-{STEPS - 1:09d}.ckpt"]
    (prune,) = json.loads((folder / "prune.json").read_text())
    assert prune["after"] == round(prune["before"] / 2)
    assert {row["primitives"] for row in json.loads(Path("out/report/report.json").read_text())} == {prune["after"]}
    assert kind_of(Path("out/scene.sundae")) == "packed"
    assert "scene.sundae" in Path("out/report/report.html").read_text(encoding="utf-8")
    assert "<canvas" in Path("out/scene.html").read_text(encoding="utf-8")

    assert run(*words) == 0
    assert capfd.readouterr().out.count(": done\n") == 5
