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
from sundae_ns.cli.forecast import Forecast, trained_size


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
    for place in (1, 2, 3, 4):
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
    assert commands.asked[0][1:] == (64, 48), "the forecast knows the size of its frames"


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
    assert commands.asked[0][1:] == (16, 12), "the forecast knows the size of its images"


def test_a_size_and_a_quality(commands: Commands) -> None:
    assert run("photos", "-o", "out", "--max-mb", "2", "--quality", "best") == 0
    usual = method_configs.sundae.config
    words = commands.ran[1]
    config = tyro.cli(type(usual), default=usual, args=words[2:])
    assert config.pipeline.model.pruning.max_bytes == 2_000_000
    assert config.pipeline.model.pruning.max_drop == 0.03
    config.pipeline.model.pruning.validate()
    assert commands.option("--target-bytes", 3) == "2000000"
    commands.ran.clear()
    assert run("photos", "-o", "draft", "--quality", "draft") == 0
    assert commands.option("--max-num-iterations", 1) == "3000"
    assert "--target-bytes" not in commands.ran[3]


def test_a_gpu_packs_with_a_fine_tune(commands: Commands, capsys: pytest.CaptureFixture[str]) -> None:
    commands.gpu = True
    assert run("photos", "-o", "out", "--max-mb", "2") == 0
    assert commands.option("--finetune", 3) == commands.option("--finetune-steps", 1) == "1500"
    assert commands.option("--target-bytes", 3) == "2000000"
    # Trials count the bytes of a pack without one.
    assert commands.option("--pipeline.model.pruning.max-bytes", 1) == "3333333"
    assert shlex.join(commands.ran[3]) in capsys.readouterr().out
    commands.ran.clear()
    assert run("photos", "-o", "draft", "--quality", "draft") == 0
    commands.gpu = False
    assert run("photos", "-o", "cpu") == 0
    assert not any("--finetune" in words for words in commands.ran)


def test_a_fine_tune_that_fails_is_left_out(commands: Commands, capsys: pytest.CaptureFixture[str]) -> None:
    """For example because the GPU's memory is full; a scene that is larger is better than none."""
    commands.gpu = commands.out_of_memory = True
    assert run("photos", "-o", "out") == 0
    assert commands.names == [*STEPS[:4], *STEPS[3:]]
    assert commands.ran[4] == commands.ran[3][:-2]
    assert f"after the fine-tune ended with 2:\n{shlex.join(commands.ran[4])}\n" in capsys.readouterr().out


@pytest.mark.parametrize("code", [3, 130])
def test_a_pack_that_fails_or_stops_with_a_fine_tune_ends(commands: Commands, code: int) -> None:
    commands.gpu = True
    commands.codes["sundae pack"] = code
    assert run("photos", "-o", "out") == code
    assert commands.names[3:] == ["sundae pack"] * (1 if code == 130 else 2)


def test_a_training_of_hours_on_a_cpu_is_foretold_before_it_starts(
    commands: Commands, capsys: pytest.CaptureFixture[str]
) -> None:
    commands.forecast = Forecast(2.0, 30000, "cpu")
    commands.codes["ns-train"] = 130
    assert run("photos", "-o", "out") == 130
    said, rest = capsys.readouterr().out.split("\n", 1)
    assert said.startswith(
        "# warning: 30,000 training steps take at least 16 h 40 min on this CPU, 2000 ms each at 16 x 12"
    )
    assert "--quality draft (1 h 40 min), --method sundae-tiny" in said
    assert "# step 1 of 6" in rest
    assert run("photos", "-o", "out") == 130
    assert len(commands.asked) == 1, "a resumed training has a forecast of its own"
    commands.forecast = Forecast(0.004, 30000, "cuda")
    commands.codes.clear()
    assert run("photos", "-o", "other") == 0
    assert "# forecast: 30,000 training steps take about 2 min 0 s on this GPU" in capsys.readouterr().out


def test_the_size_of_training_images(tmp_path: Path) -> None:
    assert trained_size(tmp_path) is None
    for index in range(3):
        Image.new("RGB", (4000, 30), "grey").save(tmp_path / f"{index}.png")
    assert trained_size(tmp_path) == (1000, 7)
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [{"file_path": "1.png"}]}))
    assert trained_size(tmp_path) == (1000, 7)
    (tmp_path / "transforms.json").unlink()
    write_model(tmp_path / "sparse" / "0", ["0.png"], (4000, 30))
    assert trained_size(tmp_path) == (4000, 30), "there are no smaller images"
