"""``sundae run``: its steps and what they get; integration/test_run.py trains."""

from __future__ import annotations

import json
import shlex
import shutil
from pathlib import Path

import pytest
import tyro
from colmap_models import write_model
from PIL import Image
from run_commands import PHOTOS, STEPS, Commands, refusal, run, write_video

from sundae_ns import method_configs


def test_photos_become_a_scene_and_a_report(commands: Commands, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("photos", "-o", "out", "--keep", "0.2", "--steps", "100") == 0
    assert commands.names == STEPS
    # Each command is printed before it runs.
    printed = [shlex.split(line) for line in capsys.readouterr().out.splitlines() if not line.startswith("#")]
    assert printed[:-1] == commands.ran
    assert printed[-1] == ["sundae", "view", "out/scene.sundae"]
    assert commands.ran[0] == ["sundae", "poses", "photos", "-o", "out/capture"]
    assert commands.option("--pipeline.model.pruning.keep-ratio", 1) == "0.2"
    assert commands.option("--max-num-iterations", 1) == "100"
    for place in (1, 2, 3):
        assert commands.option("--data", place) == "out/capture"


def test_the_options_of_poses_are_passed_on(commands: Commands, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree("photos", "masks")
    for path in Path("masks").iterdir():
        Image.new("L", (16, 12), 255).save(path.with_suffix(".png"))
        path.unlink()
    assert run("photos", "-o", "out", "--masks", "masks", "--matching", "similar", "--frames", "99") == 0
    assert commands.ran[0][5:] == ["--matching", "similar", "--frames", "99", "--masks", "masks"]
    again = ["photos", "-o", "out", "--matching", "similar", "--frames", "99"]
    assert "not left out; repeat the first command" in refusal(capsys, *again)


def test_a_video_is_taken(commands: Commands, tmp_path: Path) -> None:
    write_video(tmp_path / "my walk.mp4", 12)
    assert run("my walk.mp4", "-o", "out") == 0
    assert commands.ran[0] == ["sundae", "poses", "my walk.mp4", "-o", "out/capture"]
    assert commands.option("--experiment-name", 1) == "my walk"


def test_a_capture_needs_no_poses(commands: Commands) -> None:
    assert run("photos", "-o", "out") == 0
    commands.ran.clear()
    assert run("out/capture", "-o", "again") == 0
    assert commands.names == STEPS[1:]
    assert commands.option("--data", 0) == "out/capture"
    assert not Path("again/capture").exists()


def test_a_capture_in_colmap_layout_needs_no_poses(
    commands: Commands, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree("photos", "scene/dense/images")
    write_model(tmp_path / "scene" / "dense" / "sparse", [f"{index}.JPG" for index in range(PHOTOS)], (16, 12))
    assert run("scene", "-o", "my scene") == 0
    assert commands.names == STEPS[1:]
    said = "# capture in COLMAP layout: 8 images in dense/images, poses of dense/sparse\n"
    assert capsys.readouterr().out.startswith(said)
    parser = ["colmap", "--colmap-path", "dense/sparse", "--images-path", "dense/images", "--downscale-factor", "1"]
    assert commands.ran[0][-len(parser) :] == parser
    assert commands.option("--output-dir", 0) == "my scene/runs"
    commands.ran.clear()
    shutil.rmtree("my scene/runs")
    commands.codes["ns-train"] = 130
    assert run("scene", "-o", "my scene") == 130
    commands.codes.clear()
    assert run("scene", "-o", "my scene") == 0
    assert commands.ran[1][-len(parser) :] == parser, "a resumed training reads the same"
    assert "--load-dir" in commands.ran[1]


def test_a_capture_of_blender_needs_no_poses(commands: Commands, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree("photos", "lego/train")
    for path in Path("lego/train").iterdir():
        path.rename(path.with_suffix(".png"))
    for split in ("train", "val", "test"):
        frames = [{"file_path": f"./train/{index}"} for index in range(PHOTOS)]
        Path(f"lego/transforms_{split}.json").write_text(json.dumps({"frames": frames}))
    assert run("lego", "-o", "out") == 0
    assert commands.names == STEPS[1:]
    assert capsys.readouterr().out.startswith("# capture in Blender layout: 8 training images, over white\n")
    assert commands.ran[0][-1] == "blender-data"


def test_a_size_and_a_quality(commands: Commands) -> None:
    assert run("photos", "-o", "out", "--max-mb", "2", "--quality", "best") == 0
    usual = method_configs.sundae.config
    words = commands.ran[1]
    config = tyro.cli(type(usual), default=usual, args=words[2:])
    assert config.pipeline.model.pruning.max_bytes == 2_000_000
    assert config.pipeline.model.pruning.max_drop == 0.03
    config.pipeline.model.pruning.validate()
    assert commands.option("--target-bytes", 2) == "2000000"
    commands.ran.clear()
    assert run("photos", "-o", "draft", "--quality", "draft") == 0
    assert commands.option("--max-num-iterations", 1) == "3000"
    assert "--target-bytes" not in commands.ran[2]


def test_a_gpu_packs_with_a_fine_tune(commands: Commands, capsys: pytest.CaptureFixture[str]) -> None:
    commands.gpu = True
    assert run("photos", "-o", "out", "--max-mb", "2") == 0
    assert commands.option("--finetune", 2) == commands.option("--finetune-steps", 1) == "1500"
    assert commands.option("--target-bytes", 2) == "2000000"
    # Trials count the bytes of a pack without one.
    assert commands.option("--pipeline.model.pruning.max-bytes", 1) == "3333333"
    assert shlex.join(commands.ran[2]) in capsys.readouterr().out
    commands.ran.clear()
    assert run("photos", "-o", "draft", "--quality", "draft") == 0
    commands.gpu = False
    assert run("photos", "-o", "cpu") == 0
    assert not any("--finetune" in words for words in commands.ran)


def test_a_fine_tune_that_fails_is_left_out(commands: Commands, capsys: pytest.CaptureFixture[str]) -> None:
    """For example because the GPU's memory is full; a scene that is larger is better than none."""
    commands.gpu = commands.out_of_memory = True
    assert run("photos", "-o", "out") == 0
    assert commands.names == [*STEPS[:3], *STEPS[2:]]
    assert commands.ran[3] == commands.ran[2][:-2]
    said = f"# the fine-tune ended with 2; packing without it:\n{shlex.join(commands.ran[3])}\n"
    assert said in capsys.readouterr().out


@pytest.mark.parametrize("code", [3, 130])
def test_a_pack_that_fails_or_stops_with_a_fine_tune_ends(commands: Commands, code: int) -> None:
    commands.gpu = True
    commands.codes["sundae pack"] = code
    assert run("photos", "-o", "out") == code
    assert commands.names[2:] == ["sundae pack"] * (1 if code == 130 else 2)
