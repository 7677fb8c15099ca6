"""Images of captures: those that EXIF turns, those that a training does not use, and missing ones."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from colmap_models import write_model
from PIL import Image, ImageOps

from sundae_ns.core.errors import DataError

Load = Callable[..., Any]
Edit = Callable[..., None]


def said(capsys: Any) -> str:
    return " ".join(capsys.readouterr().out.split())


def names_of(data: Path) -> list[str]:
    return sorted(path.name for path in (data / "images").iterdir())


def test_masks_beside_the_images(capture: Path, load: Load, edit: Edit, capsys: Any) -> None:
    load(capture)
    assert "masks" not in said(capsys)
    (capture / "masks").mkdir()
    for name in names_of(capture):
        Image.new("L", (24, 24), 255).save(capture / "masks" / name)
    load(capture)
    assert "is not used; to leave out what its masks hide, give mask_path in each frame" in said(capsys)
    frames = json.loads((capture / "transforms.json").read_text())["frames"]
    edit(capture, frames=[{**frame, "mask_path": frame["file_path"].replace("images", "masks")} for frame in frames])
    assert "mask" in load(capture).cached_train[0]
    assert "is not used" not in said(capsys)


def test_masks_beside_a_colmap_model(capture: Path, load: Load, capsys: Any) -> None:
    write_model(capture / "sparse" / "0", names_of(capture), (24, 24))
    (capture / "masks").mkdir()
    for name in names_of(capture):
        Image.new("L", (24, 24), 255).save(capture / "masks" / name)
    load(capture, colmap="sparse/0")
    assert "give colmap --masks-path masks" in said(capsys)
    assert "mask" in load(capture, colmap="sparse/0", masks_path=Path("masks")).cached_train[0]
    assert "is not used" not in said(capsys)


def test_a_larger_model_beside_the_given_one(capture: Path, load: Load, capsys: Any) -> None:
    names = names_of(capture)
    write_model(capture / "sparse" / "0", names[:4], (24, 24))
    write_model(capture / "sparse" / "1", names, (24, 24))
    load(capture, colmap="sparse/0")
    assert f"sparse/0 has 4 images and sparse/1 has {len(names)}" in said(capsys)
    load(capture, colmap="sparse/1")
    assert "to train on those" not in said(capsys)
    advice = "give `colmap --colmap-path sparse/1 --downscale-factor 1`"
    with pytest.raises(DataError, match=advice):
        load(capture, colmap="colmap/sparse/0")


def test_a_missing_image_is_named_with_the_one_beside_it(capture: Path, load: Load, edit: Edit) -> None:
    frames = json.loads((capture / "transforms.json").read_text())["frames"]
    first, last = (capture / frames[index]["file_path"] for index in (0, -1))
    last.rename(last.with_name(last.name + ".png"))
    with pytest.raises(DataError, match=rf"{last.name} cannot be read .*there is {last.name}\.png"):
        load(capture).next_train(0)
    first.rename(first.with_suffix(".PNG"))
    with pytest.raises(DataError, match=rf"{first.name} does not exist \(there is {first.stem}\.PNG\)"):
        load(capture)
    write_model(capture / "sparse" / "0", [first.name], (24, 24))
    with pytest.raises(DataError, match=rf"{first.name} does not exist \(there is {first.stem}\.PNG\)"):
        load(capture, colmap="sparse/0")
    (capture / "sparse" / "0" / "cameras.bin").rename(capture / "sparse" / "0" / "Cameras.bin")
    with pytest.raises(DataError, match=r"nor cameras.txt \(there is Cameras\.bin\)"):
        load(capture, colmap="sparse/0")


def test_a_capture_that_has_gone(tmp_path: Path, load: Load) -> None:
    with pytest.raises(DataError, match="correct data in the run's config.yml"):
        load(tmp_path / "gone")


def as_photos(data: Path, edit: Edit, orientation: int, *, size: tuple[int, int] = (24, 16)) -> None:
    """Turn the images of a capture into JPEG files with an EXIF entry, of another shape than their cameras state."""
    frames = json.loads((data / "transforms.json").read_text())["frames"]
    for frame in frames:
        path = data / frame["file_path"]
        with Image.open(path) as image:
            entries = Image.Exif()
            entries[0x0112] = orientation
            image.convert("RGB").resize(size).save(path.with_suffix(".jpg"), exif=entries, quality=95)
        path.unlink()
        frame["file_path"] = str(Path(frame["file_path"]).with_suffix(".jpg"))
    gone: dict[str, Any] = dict.fromkeys(("train_filenames", "val_filenames", "test_filenames"))
    edit(data, frames=frames, **{**gone, "w": size[1], "h": size[0], "cx": size[1] / 2, "cy": size[0] / 2})


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_photos_are_turned_as_their_cameras_see_them(capture: Path, load: Load, edit: Edit, orientation: int) -> None:
    as_photos(capture, edit, orientation)
    made = load(capture)
    assert len(made.cached_train) > 5
    for path, batch in zip(made.train_dataset.image_filenames, made.cached_train, strict=True):
        with Image.open(path) as image:
            seen = np.array(ImageOps.exif_transpose(image))
        assert batch["image"].shape == (24, 16, 3)
        assert np.array_equal(batch["image"].numpy(), seen)


def test_photos_of_the_size_of_their_cameras_stay(capture: Path, load: Load, edit: Edit) -> None:
    """Also those of a program that has estimated the cameras of the pixels as they are stored."""
    as_photos(capture, edit, 6)
    edit(capture, w=24, h=16, cx=12.0, cy=8.0)
    made = load(capture)
    for path, batch in zip(made.train_dataset.image_filenames, made.cached_train, strict=True):
        with Image.open(path) as image:
            assert np.array_equal(batch["image"].numpy(), np.array(image))


@pytest.mark.parametrize(
    ("orientation", "advice"), [(6, "turned by its EXIF entry"), (1, "give each size its own camera")]
)
def test_photos_that_fit_neither_way(capture: Path, load: Load, edit: Edit, orientation: int, advice: str) -> None:
    as_photos(capture, edit, orientation)
    edit(capture, w=10, h=20)
    with pytest.raises(DataError, match=f"24 x 16 px but its camera says 10 x 20; .*{advice}"):
        load(capture).next_train(0)


def test_masks_of_turned_photos(capture: Path, load: Load, edit: Edit) -> None:
    as_photos(capture, edit, 6)
    frames = json.loads((capture / "transforms.json").read_text())["frames"]
    mask = Image.new("L", (16, 24), 255)
    mask.paste(0, (0, 0, 16, 4))
    mask.save(capture / "mask.png")
    edit(capture, frames=[{**frame, "mask_path": "mask.png"} for frame in frames])
    batch = load(capture).cached_train[0]
    assert batch["mask"].shape[:2] == batch["image"].shape[:2] == (24, 16)
    assert not batch["mask"][:4].any()
    assert batch["mask"][4:].all()


def test_a_size_that_was_rounded_the_other_way(capture: Path, load: Load, edit: Edit) -> None:
    edit(capture, w=23)
    with pytest.raises(DataError, match="--downscale-rounding-mode round"):
        load(capture).next_train(0)
