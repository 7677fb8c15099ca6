"""``sundae run`` with the real commands: an interrupted training and its rest; poses by a COLMAP that can wait."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from importlib.metadata import entry_points
from pathlib import Path

import pytest
from fake_colmap import FakeColmap
from PIL import Image

from sundae_ns.cli import main
from sundae_ns.cli.process import run_command
from sundae_ns.core.errors import StorageError
from sundae_ns.io.formats import kind_of
from sundae_ns.io.run_folder import reserve
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

    def sundae_run(*words):
        with pytest.raises(SystemExit) as caught:
            main(["run", *words])
        assert isinstance(caught.value.code, int)
        return caught.value.code

    return sundae_run


def test_photos_to_a_report_with_an_interruption(run, monkeypatch, capfd):
    words = ("photos", "-o", "out", "--method", "sundae-tiny", "--keep", "0.5", "--steps", str(STEPS))
    folder = Path("out/runs/photos/sundae-tiny/run")
    trained = SundaeTrainer.train_iteration

    def interrupted(self, step):
        if step == STOP_AT:
            signal.raise_signal(signal.SIGINT)
        return trained(self, step)

    with monkeypatch.context() as patch:
        patch.setattr(SundaeTrainer, "train_iteration", interrupted)
        assert run(*words) == 130
    assert "the same command continues here" in capfd.readouterr().err
    assert [path.name for path in folder.glob("*/*.ckpt")] == [f"step-{STOP_AT:09d}.ckpt"]
    assert not Path("out/scene.sundae").exists()

    assert run(*words) == 0
    said = capfd.readouterr().out
    assert f"Resuming after step {STOP_AT}" in said
    assert [path.name for path in folder.glob("*/*.ckpt")] == [f"step-{STEPS - 1:09d}.ckpt"]
    (prune,) = json.loads((folder / "prune.json").read_text())
    assert prune["after"] == round(prune["before"] / 2)
    assert {row["primitives"] for row in json.loads(Path("out/report/report.json").read_text())} == {prune["after"]}
    assert kind_of(Path("out/scene.sundae")) == "packed"
    assert "scene.sundae" in Path("out/report/report.html").read_text(encoding="utf-8")
    assert "<canvas" in Path("out/scene.html").read_text(encoding="utf-8")

    assert run(*words) == 0
    assert capfd.readouterr().out.count(": done\n") == 5


COLMAP = """
import os, sys, time
from pathlib import Path
sys.path[:0] = {support!r}
from fake_colmap import FakeColmap


def wait(self, *given, **named):
    if Path("slow").exists():
        Path("pid").write_text(f"{{os.getpid()}}\\n")
        time.sleep(600)
    return mapped(self, *given, **named)


mapped, FakeColmap.incremental_mapping = FakeColmap.incremental_mapping, wait
sys.modules["pycolmap"] = FakeColmap()
"""
NASTY = """-a b'c"d$(touch PWNED)`touch PWNED`;touch PWNED&"""


@pytest.fixture
def poses(tmp_path, monkeypatch):
    """Our own program with another COLMAP; no command runs after it. Those asked."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "site").mkdir()
    support = [str(Path(__file__).parents[1] / "support")]
    (tmp_path / "site" / "pycolmap.py").write_text(COLMAP.format(support=support))
    monkeypatch.syspath_prepend(tmp_path / "site")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))
    asked = []

    def only_poses(words, log=None):
        asked.append(words)
        return run_command(words) if words[:2] == ["sundae", "poses"] else 3

    monkeypatch.setattr("sundae_ns.cli.run.run_command", only_poses)
    return asked


def run_poses(photos, out):
    with pytest.raises(SystemExit) as caught:
        main(["run", photos, "-o", out])
    assert caught.value.code == 3


def test_no_name_reaches_a_shell(poses, tmp_path):
    folder, out = Path(NASTY), Path(f"out{NASTY}")
    folder.mkdir()
    for name in (f"{NASTY}.png", "-b.PNG", "--help.png", "plain.png"):
        Image.new("RGB", (16, 12), "grey").save(folder / name, format="png")
    run_poses(f"./{folder}", str(out))
    assert [words[0] for words in poses] == ["sundae", "ns-train"]
    frames = json.loads((out / "capture" / "transforms.json").read_text())["frames"]
    assert [frame["file_path"] for frame in frames] == [f"images/frame_{number:05d}.png" for number in range(1, 5)]
    assert frames[1]["original"] == f"{NASTY}.png"
    assert sorted(path.name for path in out.iterdir()) == ["capture", "run.json", "training.lock"]
    assert not list(tmp_path.rglob("PWNED"))


def test_a_killed_command_takes_colmap_with_it_and_the_next_one_works(poses, tmp_path):
    (tmp_path / "photos").mkdir()
    for name in ("a.png", "b.png", "c.png", "d.png"):
        Image.new("RGB", (16, 12), "grey").save(tmp_path / "photos" / name)
    (tmp_path / "slow").touch()
    words = [Path(sys.executable).parent / "sundae", "run", "photos", "-o", "out"]
    pid = tmp_path / "pid"
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as first:
        wait(lambda: first.poll() is not None or (pid.exists() and pid.read_text().endswith("\n")))
        assert first.returncode is None
        second = subprocess.run(words, capture_output=True, text=True, check=False)
        assert second.returncode == 2
        assert second.stderr.startswith(f"sundae: process {first.pid} on ")
        assert len(second.stderr.splitlines()) == 1
        first.kill()
    colmap = Path("/proc", pid.read_text().strip())
    wait(lambda: not colmap.exists() or ") Z " in (colmap / "stat").read_text())
    (tmp_path / "slow").unlink()
    wait(lambda: not is_locked(tmp_path / "out"))
    run_poses("photos", "out")
    assert [words[0] for words in poses] == ["sundae", "ns-train"]


def is_locked(folder):
    try:
        reserve(folder)
    except StorageError:
        return True
    return False


def wait(condition):
    for _ in range(6000):
        if condition():
            return
        time.sleep(0.01)
    pytest.fail("it takes more than a minute")
