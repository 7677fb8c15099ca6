"""What a folder holds: the words of ns-train that read it, or the advice that fits it."""

import json
import shlex
from contextlib import nullcontext
from pathlib import Path

import pytest
from colmap_models import write_model
from limits import refused
from photos import photo, photos
from small_captures import write_text_model

from sundae_ns.core.errors import DataError
from sundae_ns.data import layouts
from sundae_ns.data.capture import beside, read_json
from sundae_ns.data.colmap import check_colmap
from sundae_ns.data.layouts import is_posed, no_model, no_transforms, posed_layout, unused_masks
from sundae_ns.data.lenses import with_focal_lengths


def model(folder, images=3):
    write_model(folder, [f"{index}.png" for index in range(images)], (20, 16))


PLACES = """sparse/0 images|colmap/sparse/0 images|sparse images|dense/sparse dense/images|dense dense/images|\
dense/0/sparse dense/0/images|distorted/sparse/0 input|undistorted/sparse Images|text images|sparse/0 .|. images|. ."""


@pytest.mark.parametrize("places", PLACES.split("|"))
def test_a_model_and_its_images(tmp_path, places):
    place, images = places.split()
    words = [place] if images == "images" else [place, "--images-path", images]
    data = tmp_path / "my scene"
    write_model(data / place, photos(data / images), (20, 16))
    assert is_posed(data)
    layout = posed_layout(data)
    assert layout.words == ["colmap", "--colmap-path", *words, "--downscale-factor", "1"]
    assert posed_layout(data, data / images).words[-4:-2] == ["--masks-path", str((data / images).resolve())]
    assert shlex.split(str(no_transforms(data)).split("`")[1]) == layout.words, "the advice is what sundae train adds"


@pytest.mark.parametrize(("made", "factor"), [([], 1), ([4], 1), ([2], 2), ([2, 4, 8], 4)])
def test_smaller_images_are_taken_where_there_are_some(tmp_path, made, factor):
    names = [f"a\\{name}" for name in photos(tmp_path / "images" / "a", 3, (6000, 40))]  # as on Windows
    write_model(tmp_path / "sparse" / "0", names, (6000, 40))
    for one in made:
        photos(tmp_path / f"images_{one}" / "a", 3, (6000 // one, 40 // one))
    assert posed_layout(tmp_path).words[-1] == str(factor)
    refused(lambda data: posed_layout(data, data / "masks"), tmp_path, f"masks_{factor}/a/0.png".replace("_1/", "/"))
    (tmp_path / "images" / "a" / "0.png").unlink()
    assert len(posed_layout(tmp_path).words) == 5, "ns-train names the missing image"
    (tmp_path / "transforms.json").write_text("{}")
    assert posed_layout(tmp_path) is None, "a transforms.json comes first"


def blender(data, **changes):
    """Write a capture of three splits, as NeRF's synthetic scenes have it."""
    for split in ("train", "val", "test"):
        names = photos(data / split, 2)
        frames = [{"file_path": f"./{split}/{Path(name).stem}", "transform_matrix": []} for name in names]
        (data / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames, **changes}))
    return data


def test_a_capture_of_blender(tmp_path):
    data = blender(tmp_path / "lego")
    assert is_posed(data)
    assert with_focal_lengths(read_json(data / "transforms_train.json"), data)["w"] == 20
    layout = posed_layout(data)
    assert layout.description == "Blender layout: 2 training images, over white"
    assert (layout.words, layout.options[-1]) == (["blender-data"], "white")
    for missing in ("train/0.png", "transforms_val.json"):
        (data / missing).unlink()
        refused(posed_layout, data, missing)
    for number, frames in enumerate(([], 3, [{}], ["r_0"])):
        other = blender(tmp_path / str(number), frames=frames)
        refused(posed_layout, other, r"transforms_train\.json lists no frames with a file_path")
    refused(posed_layout, blender(tmp_path / "windows", frames=[{"file_path": "a\\b"}]), "has paths of Windows, .*; ")
    refused(posed_layout, blender(tmp_path / "b", frames=[{"file_path": "val/0.png"}]), "suffix, .*; give that file")
    assert posed_layout(blender(tmp_path / "noted", note="a\\b"))


def test_what_cannot_be_read_is_named(tmp_path):
    model(tmp_path / "sparse" / "0", 1)
    refused(posed_layout, tmp_path, r"no image 0\.png, which its model sparse/0 states, in images, .*; put it there")
    photo(tmp_path / "photos" / "0.PNG")
    refused(posed_layout, tmp_path, r"no image 0\.png \(there is 0\.PNG\), which .*; rename it")
    images = tmp_path / "sparse" / "0" / "images.bin"
    assert str(no_transforms(images)) == f"{images} is a file, not a capture; sundae poses makes a capture of a video"
    images.write_bytes(b"\0")
    refused(posed_layout, tmp_path, r"sparse/0/images\.bin is not a complete images\.bin")


def _several(data):
    for number, count in ((0, 3), (1, 20), (10, 7)):
        model(data / "sparse" / str(number), count)


def _text(data):
    write_text_model(data / "colmap" / "sparse" / "0", ["a.png"])


ADVICE = {
    "several models": (_several, "add `colmap --colmap-path sparse/1` (the largest of 3 models, with 20 images)"),
    "a model in sparse": (lambda data: model(data / "sparse"), "add `colmap --colmap-path sparse` to ns-train"),
    "a text": (_text, "add `colmap --colmap-path colmap/sparse/0` to ns-train"),
    "a model alone": (lambda data: model(data / "0"), "is a COLMAP model without its images"),
    "Blender": (blender, "it is in Blender's layout (transforms_train.json): add `blender-data` to ns-train"),
    "a folder further in": (lambda data: model(data / "room/sparse"), "room is; give that folder"),
    "another name": (lambda data: (data / "Transforms.json").touch(), "(there is Transforms.json); make a capture of"),
    "nothing": (lambda _: None, "make a capture of images with `sundae poses "),
}


@pytest.mark.parametrize(("make", "advice"), ADVICE.values(), ids=ADVICE)
def test_advice_fits_what_a_folder_holds(tmp_path, make, advice):
    make(tmp_path)
    assert advice in str(no_transforms(tmp_path))
    assert "\n" not in str(no_transforms(tmp_path))


def test_a_larger_model_is_named(tmp_path):
    assert "(usually sparse/0)" in str(no_model(tmp_path, Path("colmap/sparse/0")))
    _several(tmp_path)
    (tmp_path / "sparse" / "10" / "images.bin").write_bytes(b"\0")
    assert layouts.models_in(tmp_path) == {"sparse/0": 3, "sparse/1": 20, "sparse/10": 0}
    remark = layouts.larger_model(tmp_path, Path("sparse/0"))
    assert remark == "sparse/0 has 3 images and sparse/1 has 20; for those give --colmap-path sparse/1"
    assert layouts.larger_model(tmp_path, Path("sparse/1")) is None
    assert layouts.larger_model(tmp_path, Path("elsewhere")) is None
    assert "give `colmap --colmap-path sparse/1`" in str(no_model(tmp_path, Path("colmap/sparse/0")))


@pytest.mark.parametrize(
    ("wanted", "present", "named"),
    [
        ("cameras.bin", ["Cameras.bin"], "Cameras.bin"),
        ("x.png", ["x.png.png"], "x.png.png"),
        ("x.jpg", ["x.JPG", "y.jpg"], "x.JPG"),
        ("\xe9.jpg", ["e\u0301.jpg"], r"'e\u0301.jpg'"),
        ("IMG_0001.JPG", ["img_0001.jpeg"], "img_0001.jpeg"),
        ("frame_00001.png", ["frame_00002.png"], None),
        ("x.png", ["x.png", "X.png"], None),
    ],
)
def test_the_file_beside_a_missing_one(tmp_path, wanted, present, named):
    for name in present:
        (tmp_path / name).touch()
    assert beside(tmp_path / wanted) == ("" if named is None else f" (there is {named})")
    (tmp_path / "masks").mkdir()
    assert unused_masks(tmp_path) is None
    (tmp_path / "masks" / wanted).touch()
    assert unused_masks(tmp_path) == ("masks" if wanted.lower().endswith("g") else None)


@pytest.mark.parametrize(("name", "fits"), [("my photos (2)", True), ("-a;b&c", True), ("a$(touch P)", False)])
def test_no_path_ends_a_word_of_a_shell(tmp_path, name, fits):
    images = tmp_path / name / "images"
    write_model(tmp_path / name / "sparse" / "0", photos(images, 2), (48, 48))
    check_colmap(images.parent / "sparse" / "0", None)  # a viewer reads no image
    with nullcontext() if fits else pytest.raises(DataError, match="has quotes, .* in its name; rename it"):
        check_colmap(images.parent / "sparse" / "0", images)
