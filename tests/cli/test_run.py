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
from run_commands import PHOTOS, STEPS, Commands, photo, refusal, run

from sundae_ns import method_configs
from sundae_ns.cli.forecast import Forecast, trained_size


def test_photos_become_a_scene_and_a_report(commands: Commands, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("photos", "-o", "out", "--keep", "0.2", "--steps", "100") == 0
    assert commands.names == STEPS
    # Each command is printed before it runs.
    printed = [shlex.split(line) for line in capsys.readouterr().out.splitlines() if not line.startswith("#")]
    assert printed[0] == ["cd", "out/capture.partial", "&&", *commands.ran[0]]
    assert printed[1:-1] == commands.ran[1:]
    assert printed[-1] == ["sundae", "view", "out/scene.sundae"]
    assert commands.option("--matching-method", 0) == "exhaustive"
    assert commands.option("--pipeline.model.pruning.keep-ratio", 1) == "0.2"
    assert commands.option("--max-num-iterations", 1) == "100"
    for place in (1, 2, 3, 4):
        assert commands.option("--data", place) == "out/capture"


def test_the_largest_model_of_colmap_is_trained(commands: Commands) -> None:
    commands.models, commands.placed = [5, PHOTOS - 1, 2], 5
    assert run("photos", "-o", "out") == 0
    assert commands.names == [STEPS[0], *STEPS]
    assert commands.option("--colmap-model-path", 1) == "colmap/sparse/1"
    assert "--skip-image-processing" in commands.ran[1]
    commands.ran.clear()
    # Frames that a user removes stay removed.
    Path("out/capture/transforms.json").write_text(json.dumps({"frames": [{}] * 4}))
    assert run("photos", "-o", "out") == 0
    assert commands.ran == []


def test_one_model_of_colmap_is_left_as_it_is(commands: Commands) -> None:
    commands.models = [PHOTOS]
    assert run("photos", "-o", "out") == 0
    assert commands.names == STEPS


def test_a_capture_needs_no_poses_and_no_colmap(commands: Commands, tmp_path: Path) -> None:
    assert run("photos", "-o", "out") == 0
    shutil.rmtree(tmp_path / "bin")
    commands.ran.clear()
    assert run("out/capture", "-o", "again") == 0
    assert commands.names == STEPS[1:]
    assert commands.option("--data", 0) == "out/capture"
    assert not Path("again/capture").exists()


def test_a_capture_in_colmap_layout_needs_no_poses(
    commands: Commands, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.rmtree(tmp_path / "bin")
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
    assert "# step 1 of 7" in rest
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


def test_masks_reach_the_capture(commands: Commands, capsys: pytest.CaptureFixture[str]) -> None:
    Path("photos/masks").mkdir()
    for index in range(PHOTOS):
        mask = Image.new("L", (16, 12), 255)
        mask.putpixel((index, 0), 0)
        mask.save(f"photos/masks/{index}.png")
    commands.framed = True
    assert run("photos", "-o", "out", "--masks", "photos/masks") == 0
    said = capsys.readouterr().out
    assert f"# masks: {PHOTOS} of {PHOTOS}\n" in said
    assert "is left out" not in said
    frames = json.loads(Path("out/capture/transforms.json").read_text())["frames"]
    assert frames[2]["mask_path"] == "masks/frame_00003.png"
    with Image.open("out/capture/masks/frame_00003.png") as stored:
        assert (stored.getpixel((2, 0)), stored.getpixel((3, 0))) == (0, 255)
    with Image.open("out/capture/masks_2/frame_00003.png") as stored:
        assert (stored.size, stored.mode) == ((8, 6), "L")
    assert "not left out; repeat the first command" in refusal(capsys, "photos", "-o", "out")


def test_photos_keep_their_order_under_plain_names(commands: Commands) -> None:
    for name in ("-x.jpeg", "$(touch PWNED).JPG"):
        photo(Path("photos", name))
    seen: list[str] = []
    write = commands.write

    def watch(name: str, words: list[str], code: int) -> None:
        if name == "ns-process-data":
            folder = Path("out/capture.partial/photos")
            seen.extend(f"{path.name} {path.resolve().name}" for path in sorted(folder.iterdir()))
        write(name, words, code)

    commands.write = watch  # type: ignore[method-assign]
    assert run("photos", "-o", "out") == 0
    assert seen[:3] == ["00001.jpg $(touch PWNED).JPG", "00002.jpg -x.jpeg", "00003.jpg 0.JPG"]
