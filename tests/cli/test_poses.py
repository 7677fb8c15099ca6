"""``sundae poses``: what it refuses, what it says, and how it ends."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import command_line
import pytest
from fake_colmap import FakeColmap
from PIL import Image
from run_commands import photo, write_video

from sundae_ns.io import run_folder

PHOTOS = 6


@pytest.fixture
def colmap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeColmap:
    """pycolmap, in a folder with photos."""
    made = FakeColmap()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "pycolmap", made)  # type: ignore[arg-type]
    monkeypatch.setattr(run_folder, "_held", {})
    Path("photos").mkdir()
    for index in range(PHOTOS):
        photo(Path("photos", f"{index}.JPG"))
    return made


def poses(*words: str) -> int:
    return command_line.run("poses", *words)


def refusal(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    return command_line.refusal(capsys, "poses", *words)


def test_each_stage_and_the_result_are_one_line(colmap: FakeColmap, capsys: pytest.CaptureFixture[str]) -> None:
    colmap.models = [4]
    assert poses("photos", "-o", "capture") == 0
    lines = capsys.readouterr().out.splitlines()
    stages = ["images: 6 of 6", "features: 6 of 6", "matches of pairs: 15 of 15", "poses: 6 of 6", "capture: 4 of 4"]
    assert [line.rpartition(",")[0] for line in lines[:5]] == stages
    assert lines[5] == "capture: 4 of 6 photos have a pose, of 1 camera; mean reprojection error 0.50 px"
    again = "to add them, photograph the way from 3.JPG to 4.JPG again"
    assert lines[6].startswith(f"# without a pose: 4.JPG, 5.JPG; {again}")
    assert len(json.loads(Path("capture/transforms.json").read_text())["frames"]) == 4


def test_masks_beside_the_photos_are_used(colmap: FakeColmap, capsys: pytest.CaptureFixture[str]) -> None:
    Path("photos/masks").mkdir()
    for index in range(PHOTOS):
        Image.new("L", (16, 12), 255).save(f"photos/masks/{index}.png")
    assert poses("photos", "-o", "capture") == 0
    said = capsys.readouterr().out
    assert "# masks: 6 of 6\n" in said
    assert "left out" not in said
    Path("photos/masks/0.png").unlink()
    assert poses("photos", "-o", "other") == 0
    said = capsys.readouterr().out
    assert said.startswith(
        "# warning: photos/masks is left out: photos/0.JPG has no mask 0.png in photos/masks; add it"
    )
    assert "masks: " not in said


def test_a_video(colmap: FakeColmap, capsys: pytest.CaptureFixture[str]) -> None:
    write_video(Path("walk.mp4"), 40)
    assert poses("walk.mp4", "-o", "capture", "--frames", "9") == 0
    assert "frames: 9 of 9" in capsys.readouterr().out


def test_an_error_of_colmap_is_one_line(colmap: FakeColmap, capsys: pytest.CaptureFixture[str]) -> None:
    colmap.fails = "models"
    line = refusal(capsys, "photos", "-o", "capture")
    assert "COLMAP failed (models ended early); remove capture.partial and start again, or report it" in line


SLOW = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
from fake_colmap import FakeColmap
made = FakeColmap()
def wait(*_, **__):
    print("waits", flush=True)
    time.sleep(600)
made.incremental_mapping = wait
sys.modules["pycolmap"] = made
from sundae_ns.cli import main
main()
"""


def started(photos: Path) -> subprocess.Popen[str]:
    """The command, in the middle of a function that does not return."""
    support = Path(__file__).parents[1] / "support"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(support), *sys.path])}
    words = [sys.executable, "-c", SLOW, "poses", str(photos), "-o", "capture"]
    pipe = subprocess.PIPE
    process = subprocess.Popen(words, stdout=pipe, stderr=pipe, text=True, env=environment, cwd=photos.parent)
    assert process.stdout is not None
    while "waits" not in process.stdout.readline():
        assert process.poll() is None, process.communicate()
    return process


def interrupt(process: subprocess.Popen[str]) -> None:
    process.send_signal(signal.SIGINT)


def kill(process: subprocess.Popen[str]) -> None:
    process.kill()


@pytest.mark.parametrize(
    ("end", "code", "says"),
    [(interrupt, 130, "sundae: interrupted; the same command continues here\n"), (kill, -signal.SIGKILL, "")],
)
def test_an_interrupt_ends_at_once_and_the_same_command_continues(
    colmap: FakeColmap, tmp_path: Path, end: Callable[[subprocess.Popen[str]], None], code: int, says: str
) -> None:
    process = started(tmp_path / "photos")
    end(process)
    _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (code, says)
    assert poses("photos", "-o", "capture") == 0
    assert colmap.calls["features"] == [], "these were found before"
    assert colmap.calls["models"] == ["OPENCV"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["capture", "photos"]
