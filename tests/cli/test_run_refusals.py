"""``sundae run``: what it refuses, in one line and before anything is written."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from colmap_models import write_model
from run_commands import PHOTOS, Commands, refusal, run


@pytest.mark.parametrize(("placed", "enough"), [(2, False), (3, False), (4, True)])
def test_too_few_placed_photos(
    commands: Commands, capsys: pytest.CaptureFixture[str], placed: int, enough: bool
) -> None:
    commands.placed = placed
    if enough:
        assert run("photos", "-o", "out") == 0
        return
    for _ in range(2):  # the repeated command too, which finds the poses
        line = refusal(capsys, "photos", "-o", "out")
        assert f"COLMAP placed {placed} of {PHOTOS} photos; photograph the way from {placed - 1}.JPG to" in line
        assert "sundae run out/capture -o OTHER" in line
    assert commands.names == ["sundae poses"]
    assert run("out/capture", "-o", "other") == 0


def test_a_command_that_writes_nothing(commands: Commands, capsys: pytest.CaptureFixture[str]) -> None:
    commands.silent = True
    assert "camera poses ended without its result" in refusal(capsys, "photos", "-o", "out")


@pytest.mark.parametrize(
    ("words", "cause"),
    [
        (["gone", "-o", "out"], "gone does not exist"),
        (["empty", "-o", "out"], "holds no photos"),
        (["video.mp4", "-o", "out"], "video.mp4 is not a video that OpenCV decodes"),
        (["photos/0.JPG", "-o", "out"], "photos/0.JPG is neither a folder of photos nor a video"),
        (["photos", "-o", "out", "--frames", "2"], "frames is 2; give at least 3"),
        (["model", "-o", "out"], "cameras.bin is not a complete cameras.bin of COLMAP"),
        (["model/sparse/0", "-o", "out"], "is a COLMAP model without its images"),
        (["undistorted", "-o", "out"], "undistorted has no image 0.png, which its model dense/sparse states"),
        (["blender", "-o", "out"], "blender/transforms_train.json is not JSON"),
        (["photos", "-o", "photos/out"], "lies in photos"),
        (["photos", "-o", "."], "holds what the command reads"),
        (["photos", "-o", "used"], "holds files"),
        (["photos", "-o", "out", "--keep", "2"], "keep is 2.0"),
        (["photos", "-o", "out", "--steps", "0"], "steps is 0"),
        (["photos", "-o", "out", "--max-mb", "0"], "max-mb is 0; give at least 0.01"),
        (["photos", "-o", "out", "--max-mb", "2", "--keep", "0.1"], "--max-mb needs a method that decides"),
        (["photos", "-o", "out", "--quality", "best", "--method", "sundae-fast"], "--quality best needs a method that"),
        (["photos", "-o", "out", "--quality", "draft", "--steps", "9"], "a draft has 3,000 steps"),
        (["photos", "-o", "out", "--masks", "gone"], "gone is no folder of masks"),
        (["photos", "-o", "out", "--masks", "empty"], "photos/0.JPG has no mask 0.png in empty"),
    ],
)
def test_refusals_come_before_anything_is_written(
    commands: Commands, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], cause: str
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "video.mp4").touch()
    (tmp_path / "model" / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "model" / "sparse" / "0" / "cameras.bin").touch()
    write_model(tmp_path / "undistorted" / "dense" / "sparse", ["0.png"], (20, 16))
    (tmp_path / "blender").mkdir()
    (tmp_path / "blender" / "transforms_train.json").touch()
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "thesis.txt").touch()
    before = sorted(tmp_path.rglob("*"))
    assert cause in refusal(capsys, *words)
    assert sorted(tmp_path.rglob("*")) == before
    assert commands.ran == []


@pytest.mark.parametrize(
    ("more", "cause"),
    [
        (["--steps", "200"], "steps left out, not 200"),
        (["--keep", "0.5"], "keep left out, not 0.5"),
        (["--method", "sundae-tiny"], "method sundae, not sundae-tiny"),
    ],
)
def test_other_settings_are_refused(
    commands: Commands, capsys: pytest.CaptureFixture[str], more: list[str], cause: str
) -> None:
    assert run("photos", "-o", "out") == 0
    assert cause in refusal(capsys, "photos", "-o", "out", *more)


def test_damaged_settings(commands: Commands, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("photos", "-o", "out") == 0
    for text in ("[]", "{"):
        Path("out/run.json").write_text(text)
        assert "out/run.json is damaged" in refusal(capsys, "photos", "-o", "out")


HOLDER = """
import sys
from pathlib import Path
from sundae_ns.io.run_folder import reserve
reserve(Path("out"))
print(flush=True)
sys.stdin.read()
"""


def test_without_pycolmap_nothing_starts(
    commands: Commands, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    line = refusal(capsys, "photos", "-o", "out")
    assert line == 'sundae: camera poses need pycolmap; install it with pip install "sundae_ns[photos]"'
    assert not Path("out").exists()
    monkeypatch.delitem(sys.modules, "pycolmap")
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    assert refusal(capsys, "photos", "-o", "out") == line


def test_photos_are_judged_before_anything_starts(commands: Commands, capsys: pytest.CaptureFixture[str]) -> None:
    os.mkfifo("photos/x.png")
    assert "photos/x.png cannot be read (it is a pipe" in refusal(capsys, "photos", "-o", "out")
    assert commands.ran == []
    assert not Path("out").exists()
    Path("photos/x.png").unlink()
    assert run("photos", "-o", "out") == 0
    # Photos are of no more use once there are poses.
    shutil.rmtree("photos")
    Path("photos").mkdir()
    assert run("photos", "-o", "out") == 0


def test_names_with_a_dash_are_no_options(commands: Commands) -> None:
    shutil.copytree("photos", "-photos")
    assert run("./-photos", "-o", "./-out") == 0
    for words in commands.ran[1:]:
        paths = [one for one in words if "photos" in one or "out" in one.replace("--out", "")]
        assert paths
        assert all(one.startswith(("./-", "--experiment-name=")) for one in paths), words
    commands.ran.clear()
    assert run("./-out/capture", "-o", "./-again", "--keep", "0.5") == 0
    assert commands.option("--data", 0) == "./-out/capture"


def test_one_command_works_in_a_folder(commands: Commands, capsys: pytest.CaptureFixture[str]) -> None:
    other = subprocess.Popen([sys.executable, "-c", HOLDER], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    with other:
        assert other.stdout is not None
        other.stdout.readline()
        line = refusal(capsys, "photos", "-o", "out")
        assert f"process {other.pid} on " in line
        assert line.endswith(f"works in {Path('out').resolve()}; wait for it, or choose another folder")
        assert commands.ran == []
        other.kill()
    # The other was killed before it wrote its settings.
    assert os.listdir("out") == ["training.lock"]
    assert run("photos", "-o", "out") == 0
