"""``sundae poses``: what it refuses, what it says, and how it ends."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import refusal, run
from PIL import Image
from run_commands import NASTY, PHOTOS, photo, write_video


def test_each_stage_and_the_result_are_one_line(colmap, capsys):
    colmap.models = [6, 3]
    assert run("poses", "photos", "-o", "capture") == 0
    lines = capsys.readouterr().out.splitlines()
    stages = ["images: 8 of 8", "features: 8 of 8", "matches of pairs: 28 of 28", "poses: 6 of 8", "capture: 6 of 6"]
    assert [line.rpartition(",")[0] for line in lines[:5]] == stages
    assert lines[5] == "capture: 6 of 8 photos have a pose, of 1 camera; mean reprojection error 0.50 px"
    again = "to add them, photograph the way from 5.JPG to 6.JPG again"
    assert lines[6] == "# this is the largest of 2 models that do not join; others have 3 photos"
    assert lines[7].startswith(f"# without a pose: 6.JPG, 7.JPG; {again}")
    assert len(json.loads(Path("capture/transforms.json").read_text())["frames"]) == 6


def test_masks_beside_the_photos_are_used(colmap, capsys):
    Path("photos/masks").mkdir()
    for index in range(PHOTOS):
        Image.new("L", (16, 12), 255).save(f"photos/masks/{index}.png")
    assert run("poses", "photos", "-o", "capture") == 0
    assert "0.50 px; masks are those of photos/masks\n" in capsys.readouterr().out
    Path("photos/masks/0.png").unlink()
    assert run("poses", "photos", "-o", "other") == 0
    said = capsys.readouterr().out
    assert said.startswith("# warning: photos/masks is left out: photos/0.JPG has no mask 0.png in photos/masks; add")
    assert "masks are those" not in said


def test_a_video(colmap, capsys):
    write_video(Path("walk.mp4"), 40)
    colmap.models = [9, 3]
    assert run("poses", "walk.mp4", "-o", "capture", "--frames", "9") == 0
    said = capsys.readouterr().out
    assert ("frames: 9 of 9" in said, "models" in said) == (True, False), "the largest model has all frames"


def test_names_are_no_options_and_nothing_of_a_shell(colmap, tmp_path):
    Path(NASTY).mkdir()
    names = ["--help.png", f"{NASTY}.png", "-b.PNG"]
    for name in names:
        photo(Path(NASTY, name), "png")
    assert run("poses", f"./{NASTY}", "-o", f"./out{NASTY}") == 0
    frames = json.loads(Path(f"out{NASTY}/transforms.json").read_text())["frames"]
    assert [frame["file_path"] for frame in frames] == [f"images/frame_{number:05d}.png" for number in (1, 2, 3)]
    assert [frame["original"] for frame in frames] == names
    assert not list(tmp_path.rglob("PWNED"))


def test_an_error_of_colmap_is_one_line(colmap, capsys):
    colmap.fails = "models"
    line = refusal(capsys, "poses", "photos", "-o", "capture")
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


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_ends_at_once_and_the_same_command_continues(colmap, tmp_path, sent):
    """In the middle of a function that does not return."""
    support = Path(__file__).parents[1] / "support"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(support), *sys.path])}
    words = [sys.executable, "-c", SLOW, "poses", "photos", "-o", "capture"]
    process = subprocess.Popen(words, text=True, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    while "waits" not in process.stdout.readline():
        assert process.poll() is None, process.communicate()
    process.send_signal(sent)
    _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (128 + sent, "sundae: interrupted; the same command continues here\n")
    assert run("poses", "photos", "-o", "capture") == 0
    assert colmap.calls["features"] == [], "these were found before"
    assert colmap.calls["models"] == ["OPENCV"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["capture", "photos", "scene"]
