"""Messages name what lies beside a path that cannot be used, and the command that reads it."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from colmap_models import write_model
from PIL import Image

from sundae_ns.data.advice import larger_model, models_in, no_model, no_transforms
from sundae_ns.data.beside import beside, unused_masks
from sundae_ns.data.layouts import posed_layout


def model(folder: Path, images: int = 3) -> None:
    write_model(folder, [f"{index}.png" for index in range(images)], (20, 16))


def _sub_models(data: Path) -> None:
    model(data / "sparse" / "0", 3)
    model(data / "sparse" / "1", 20)
    model(data / "sparse" / "10", 7)


def _text(data: Path) -> None:
    folder = data / "colmap" / "sparse" / "0"
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text("1 PINHOLE 20 16 18 18 10 8\n")
    (folder / "images.txt").write_text("1 1 0 0 0 0 0 3 1 a.png\n\n")


def _dense(data: Path) -> None:
    model(data / "dense" / "sparse")
    (data / "images").mkdir()
    (data / "dense" / "images").mkdir()
    for index in range(3):
        Image.new("RGB", (20, 16)).save(data / "dense" / "images" / f"{index}.png")


def _blender(data: Path) -> None:
    for split in ("train", "val", "test"):
        (data / f"transforms_{split}.json").write_text("{}")


def _inner(data: Path) -> None:
    (data / "room").mkdir()
    (data / "room" / "transforms.json").write_text("{}")


LAYOUTS: dict[str, tuple[Callable[[Path], None], str]] = {
    "several models": (
        _sub_models,
        "add `colmap --colmap-path sparse/1` to ns-train (the largest of 3 models, with 20",
    ),
    "a model in sparse": (lambda data: model(data / "sparse"), "add `colmap --colmap-path sparse` to ns-train"),
    "a text": (_text, "add `colmap --colmap-path colmap/sparse/0` to ns-train"),
    "a dense folder": (
        _dense,
        "add `colmap --colmap-path dense/sparse --images-path dense/images --downscale-factor 1` to ns-train",
    ),
    "Blender": (_blender, "it is in Blender's layout (transforms_train.json): add `blender-data` to ns-train"),
    "a folder further in": (_inner, "room has; give that folder"),
    "another name": (lambda data: (data / "Transforms.json").touch(), "(there is Transforms.json)"),
    "nothing": (lambda _: None, "make a capture of images with `sundae poses "),
}


@pytest.mark.parametrize("kind", LAYOUTS)
def test_advice_fits_what_a_folder_holds(tmp_path: Path, kind: str) -> None:
    make, advice = LAYOUTS[kind]
    make(tmp_path)
    said = str(no_transforms(tmp_path))
    assert advice in said
    assert "\n" not in said
    assert ("sundae poses" in said) == (kind in ("nothing", "another name"))


def test_the_advised_words_are_the_model_and_its_images(tmp_path: Path) -> None:
    data = tmp_path / "my scene"
    _dense(data)
    words = shlex.split(str(no_transforms(data)).split("`")[1])
    assert (data / words[words.index("--colmap-path") + 1] / "cameras.bin").is_file()
    assert (data / words[words.index("--images-path") + 1]).is_dir()
    layout = posed_layout(data)
    assert layout is not None
    assert words == layout.words, "the advice is what sundae train adds"


def test_a_damaged_model_counts_no_images(tmp_path: Path) -> None:
    model(tmp_path / "sparse" / "0")
    model(tmp_path / "sparse" / "1")
    (tmp_path / "sparse" / "1" / "images.bin").write_bytes(b"\0")
    assert models_in(tmp_path) == {"sparse/0": 3, "sparse/1": 0}


def test_a_larger_model_is_named(tmp_path: Path) -> None:
    _sub_models(tmp_path)
    remark = larger_model(tmp_path, Path("sparse/0"))
    assert remark == "sparse/0 has 3 images and sparse/1 has 20; to train on those, give --colmap-path sparse/1"
    assert larger_model(tmp_path, Path("sparse/1")) is None
    assert larger_model(tmp_path, Path("elsewhere")) is None


def test_a_model_in_another_place_is_named(tmp_path: Path) -> None:
    assert "(usually sparse/0)" in str(no_model(tmp_path, Path("colmap/sparse/0")))
    model(tmp_path / "sparse" / "0")
    said = str(no_model(tmp_path, Path("colmap/sparse/0")))
    assert "the model is in sparse/0: give `colmap --colmap-path sparse/0`" in said


@pytest.mark.parametrize(
    ("wanted", "present", "found"),
    [
        ("cameras.bin", ["Cameras.bin"], "Cameras.bin"),
        ("x.png", ["x.png.png"], "x.png.png"),
        ("x.jpg", ["x.JPG", "y.jpg"], "x.JPG"),
        ("x.jpg", ["x.png"], "x.png"),
        ("IMG_0001.JPG", ["img_0001.jpeg"], "img_0001.jpeg"),
        ("sparse_pc.ply", ["sparse_cp.ply"], "sparse_cp.ply"),
        ("frame_00001.png", ["frame_00002.png"], None),
        ("points3D.bin", ["points3D.txt"], None),
        ("x.png", [], None),
    ],
)
def test_the_file_beside_a_missing_one(tmp_path: Path, wanted: str, present: list[str], found: str | None) -> None:
    for name in present:
        (tmp_path / name).touch()
    assert beside(tmp_path / wanted) == ("" if found is None else f" (there is {found})")
    (tmp_path / wanted).touch()
    assert beside(tmp_path / wanted) == ""


def test_masks_that_are_not_used(tmp_path: Path) -> None:
    (tmp_path / "masks").mkdir()
    assert unused_masks(tmp_path) is None
    (tmp_path / "masks" / "0.jpg.png").touch()
    assert unused_masks(tmp_path) == "masks"
    shutil.rmtree(tmp_path / "masks")
    assert unused_masks(tmp_path) is None
