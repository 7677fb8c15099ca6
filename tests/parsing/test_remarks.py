"""What a capture holds and a training does not use is named; a missing file is named with the one beside it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from colmap_models import write_model
from PIL import Image

from sundae_ns.errors import DataError

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
    advice = "the model is in sparse/1: give `colmap --colmap-path sparse/1 --downscale-factor 1`"
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
