"""Captures in COLMAP's layout: the largest model with its images, as words of ns-train."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from colmap_models import write_model
from PIL import Image

from sundae_ns.data.layouts import is_posed, posed_layout
from sundae_ns.errors import DataError


def photos(folder: Path, count: int = 3, size: tuple[int, int] = (20, 16)) -> list[str]:
    folder.mkdir(parents=True)
    names = [f"{index}.png" for index in range(count)]
    for name in names:
        Image.new("RGB", size, "grey").save(folder / name)
    return names


@pytest.mark.parametrize(
    ("model", "images", "words"),
    [
        ("sparse/0", "images", ["sparse/0"]),
        ("colmap/sparse/0", "images", ["colmap/sparse/0"]),
        ("sparse", "images", ["sparse"]),
        ("dense/sparse", "dense/images", ["dense/sparse", "--images-path", "dense/images"]),
        ("dense", "dense/images", ["dense", "--images-path", "dense/images"]),
        ("dense/sparse/0", "images", ["dense/sparse/0"]),
        ("distorted/sparse/0", "input", ["distorted/sparse/0", "--images-path", "input"]),
        ("sparse/0", ".", ["sparse/0", "--images-path", "."]),
    ],
)
def test_a_model_and_its_images(tmp_path: Path, model: str, images: str, words: list[str]) -> None:
    data = tmp_path / "my scene"
    write_model(data / model, photos(data / images), (20, 16))
    assert is_posed(data)
    layout = posed_layout(data)
    assert layout is not None
    assert layout.words == ["colmap", "--colmap-path", *words, "--downscale-factor", "1"]


def test_the_largest_of_several_models(tmp_path: Path) -> None:
    names = photos(tmp_path / "images", 20)
    for number, count in ((0, 3), (1, 20), (10, 7)):
        write_model(tmp_path / "sparse" / str(number), names[:count], (20, 16))
    layout = posed_layout(tmp_path)
    assert str(layout) == "20 images in images, poses of sparse/1, the largest of 3 models"


@pytest.mark.parametrize(("made", "factor"), [([], 1), ([4], 1), ([2], 2), ([2, 4, 8], 4)])
def test_smaller_images_are_taken_where_there_are_some(tmp_path: Path, made: list[int], factor: int) -> None:
    names = photos(tmp_path / "images", 3, (6000, 40))
    write_model(tmp_path / "sparse" / "0", names, (6000, 40))
    for one in made:
        photos(tmp_path / f"images_{one}", 3, (6000 // one, 40 // one))
    layout = posed_layout(tmp_path)
    assert layout is not None
    assert layout.downscale == factor


def test_a_transforms_json_comes_first(tmp_path: Path) -> None:
    write_model(tmp_path / "sparse" / "0", photos(tmp_path / "images"), (20, 16))
    (tmp_path / "transforms.json").write_text("{}")
    assert is_posed(tmp_path)
    assert posed_layout(tmp_path) is None


def blender(data: Path, **changes: object) -> Path:
    """Write a capture of three splits, as NeRF's synthetic scenes have it."""
    for split in ("train", "val", "test"):
        names = photos(data / split, 2)
        frames = [{"file_path": f"./{split}/{Path(name).stem}", "transform_matrix": []} for name in names]
        (data / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames, **changes}))
    return data


def test_a_capture_of_blender(tmp_path: Path) -> None:
    data = blender(tmp_path / "lego")
    assert is_posed(data)
    layout = posed_layout(data)
    assert layout is not None
    assert (layout.size, layout.downscale, str(layout)) == ((20, 16), 1, "2 training images, over white")
    (data / "transforms.json").write_text("{}")
    assert posed_layout(data) is None


@pytest.mark.parametrize("missing", ["transforms_val.json", "transforms_test.json", "train/0.png"])
def test_what_a_capture_of_blender_lacks_is_named(tmp_path: Path, missing: str) -> None:
    data = blender(tmp_path / "lego")
    (data / missing).unlink()
    with pytest.raises(DataError, match=missing):
        posed_layout(data)


@pytest.mark.parametrize("frames", [[], 3, [{}], ["r_0"]])
def test_a_capture_of_blender_without_frames_is_refused(tmp_path: Path, frames: object) -> None:
    with pytest.raises(DataError, match=r"transforms_train\.json lists no frames with a file_path"):
        posed_layout(blender(tmp_path / "lego", frames=frames))


def test_a_folder_of_photos_has_no_poses(tmp_path: Path) -> None:
    photos(tmp_path / "images")
    assert not is_posed(tmp_path)
    assert posed_layout(tmp_path) is None


def test_what_cannot_be_read_is_named(tmp_path: Path) -> None:
    write_model(tmp_path / "sparse" / "0", ["gone.png"], (20, 16))
    with pytest.raises(DataError, match=r"no image gone\.png, which its model sparse/0 states, in images, input"):
        posed_layout(tmp_path)
    (tmp_path / "sparse" / "0" / "images.bin").write_bytes(b"\0")
    with pytest.raises(DataError, match=r"sparse/0: images\.bin ends early"):
        posed_layout(tmp_path)
