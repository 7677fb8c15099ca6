"""Bad files of transforms.json, loaded by the datamanager of training."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import pytest
from small_captures import bytes_of, load, meta_of

from sundae_ns.errors import DataError


@pytest.mark.seeds(60)
def test_corrupted_transforms(capture: Path, corrupted: Any, verdict: Any, seed: int) -> None:
    path = capture / "transforms.json"
    path.write_bytes(corrupted(path.read_bytes(), seed))
    verdict(lambda: load(capture), bytes_of(capture))


VALUES: tuple[Any, ...] = (
    *(None, True, "", "word", "0", [], {}, [[]], 0, -1, 0.5, 1e-300, 1e30, 1e308, float("nan"), float("inf")),
    *(10**400, [float("nan")] * 4, [[0.0] * 4] * 4, "../../x.png", "\0", "ünï cöde.png", [[1, 2], [3]]),
)


def places(value: Any) -> list[tuple[Any, Any]]:
    """Every container of a parsed file, paired with each of its keys."""
    keys: Any = value.keys() if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    found = [(value, key) for key in keys]
    for key in keys:
        found += places(value[key])
    return found


@pytest.mark.seeds(90)
def test_strange_values_in_transforms(capture: Path, verdict: Any, seed: int) -> None:
    rng = Random(seed)
    meta = meta_of(capture)
    holder, key = rng.choice([place for place in places(meta) if not isinstance(place[1], int) or rng.random() < 0.2])
    if rng.random() < 0.25:
        del holder[key]
    else:
        holder[key] = VALUES[seed % len(VALUES)]
    (capture / "transforms.json").write_text(json.dumps(meta))
    verdict(lambda: load(capture), bytes_of(capture))


def _frame(**changes: Any) -> Callable[[dict[str, Any]], None]:
    return lambda meta: meta["frames"][1].update(changes)


def _top(**changes: Any) -> Callable[[dict[str, Any]], None]:
    return lambda meta: meta.update(changes)


def _pose(row: int, column: int, value: float) -> Callable[[dict[str, Any]], None]:
    return lambda meta: meta["frames"][1]["transform_matrix"][row].__setitem__(column, value)


REFUSED: dict[str, tuple[Callable[[dict[str, Any]], None], str]] = {
    "NaN in a pose": (_pose(0, 3, float("nan")), r"frame 1 .*transform_matrix is nan; it must be finite"),
    "infinity in a pose": (_pose(2, 1, float("inf")), "frame 1 .*finite"),
    "a pose of zeros": (_frame(transform_matrix=[[0.0] * 4] * 4), "frame 1 .*singular"),
    "a pose of 3 rows": (_frame(transform_matrix=[[1.0, 0, 0, 0]] * 3), "4 rows of 4"),
    "no pose": (lambda meta: meta["frames"][1].pop("transform_matrix"), "4 rows of 4"),
    "zero focal length": (_top(fl_x=0.0), "fl_x is 0.0; it must be positive"),
    "negative focal length": (_top(fl_y=-3), "fl_y is -3; it must be positive"),
    "focal length NaN": (_top(fl_x=float("nan")), "fl_x is nan"),
    "no focal length": (lambda meta: meta.pop("fl_x"), "fl_x missing"),
    "zero width": (_top(w=0), "w is 0; .*whole number of pixels"),
    "a huge width": (_top(w=10**9), "w is 1000000000"),
    "half a pixel": (_top(h=16.5), "h is 16.5"),
    "no frames": (_top(frames=[]), "no frames"),
    "frames that are numbers": (_top(frames=[1, 2]), "frame 0"),
    "an unknown camera": (_top(camera_model="BRAIN"), "camera_model is 'BRAIN'; use one of SIMPLE_PINHOLE"),
    "a round lens without a radius": (
        _top(camera_model="FISHEYE624"),
        "fisheye_crop_radius is None; .*a positive number",
    ),
    "a round lens of a whole number": (_top(camera_model="FISHEYE624", fisheye_crop_radius=7), "with a decimal point"),
    "a round lens and masks": (
        lambda meta: (
            meta.update(camera_model="FISHEYE624", fisheye_crop_radius=7.0),
            [frame.update(mask_path="images/frame_00001.png") for frame in meta["frames"]],
        ),
        "remove mask_path",
    ),
    "distortion NaN": (_top(k1=float("nan")), "k1 is nan"),
    "distortion of 3 numbers": (_top(distortion_params=[0, 0, 0]), "4, 6 or 12"),
    "a split of other images": (_frame(file_path="images/none.png"), "which no frame has as its file_path"),
    "a missing split": (_top(train_filenames=["images/a.png"], val_filenames=None), "train_filenames|val_filenames"),
    "no list of test images": (lambda meta: [meta.pop(f"{s}_filenames", 0) for s in ("val", "test")], "none for val"),
    "a mask for one": (_frame(mask_path="images/frame_00001.png"), "1 of .* frames have a mask_path"),
    "a scale of zero": (_top(applied_scale=0), "applied_scale"),
    "a frame of NaN": (_top(applied_transform=[[float("nan")] * 4] * 3), "applied_transform"),
    "an unknown orientation": (_top(orientation_override="sideways"), "orientation_override"),
    "a cloud that is a number": (_top(ply_file_path=3), "ply_file_path"),
    "a missing cloud": (_top(ply_file_path="none.ply"), r"none\.ply does not exist"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_transforms_are_refused_by_name(capture: Path, verdict: Any, kind: str) -> None:
    change, cause = REFUSED[kind]
    meta = meta_of(capture)
    change(meta)
    (capture / "transforms.json").write_text(json.dumps(meta))
    error = verdict(lambda: load(capture), bytes_of(capture))
    assert error is not None
    assert isinstance(error, DataError)
    assert re.search(cause, str(error)), error


TEXTS = {
    "empty": "",
    "a list": "[1, 2]",
    "endless nesting": "[" * 200_000,
    "endless digits": '{"frames": ' + "9" * 5000 + "}",
    "half": '{"frames": [',
    "invalid UTF-8": "\udcff",
}


@pytest.mark.parametrize("kind", TEXTS)
def test_other_contents_of_transforms_are_refused(capture: Path, verdict: Any, kind: str) -> None:
    (capture / "transforms.json").write_text(TEXTS[kind], errors="surrogateescape")
    assert verdict(lambda: load(capture), bytes_of(capture)) is not None


def test_a_folder_without_a_capture_is_refused(verdict: Any, tmp_path: Path) -> None:
    assert verdict(lambda: load(tmp_path / "none"), 0) is not None
    assert verdict(lambda: load(tmp_path), 0) is not None
    assert verdict(lambda: load(tmp_path, colmap=True), 0) is not None
