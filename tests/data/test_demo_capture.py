"""The shipped capture: what the ray tracer makes, copied without touching other files."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData
from ray_tracing.capture import held_out_indices, still_life_views
from ray_tracing.still_life import still_life
from ray_tracing.tracer import first_hits, render

from sundae_ns.data import check_image, check_transforms, write_demo_capture
from sundae_ns.data.demo_capture import ARCHIVE
from sundae_ns.errors import DataError

TRAIN, TEST, SIDE, POINTS = 48, 8, 128, 5000


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_demo_capture(tmp_path_factory.mktemp("demo") / "new" / "folder")


def test_a_copy_is_a_sound_capture(copy: Path) -> None:
    check_transforms(copy / "transforms.json", splits=("train", "test"))
    meta = json.loads((copy / "transforms.json").read_text())
    assert (len(meta["train_filenames"]), len(meta["test_filenames"])) == (TRAIN, TEST)
    assert {check_image(copy / frame["file_path"]) for frame in meta["frames"]} == {(SIDE, SIDE)}
    files = json.loads((copy / ".sundae_scene.json").read_text())["files"]
    assert {path.relative_to(copy).as_posix() for path in copy.rglob("*") if path.is_file()} == {
        *files,
        ".sundae_scene.json",
    }


@pytest.mark.parametrize("index", [0, 3, 29, 55])
def test_images_are_those_of_the_ray_tracer(copy: Path, index: int) -> None:
    camera = still_life_views(0, TRAIN + TEST, width=SIDE, height=SIDE)[index]
    frame = json.loads((copy / "transforms.json").read_text())["frames"][index]
    np.testing.assert_allclose(frame["transform_matrix"], camera.camera_to_world, atol=1e-12)
    with Image.open(copy / frame["file_path"]) as image:
        shipped = np.asarray(image, np.float64)
    error = np.abs(shipped - 255 * render(still_life(0), camera))
    # Another machine may round differently, and a ray at an edge may hit the other side.
    assert (error > 0.51).mean() < 1e-3


def test_split_and_points_are_those_of_the_ray_tracer(copy: Path) -> None:
    meta = json.loads((copy / "transforms.json").read_text())
    names = [frame["file_path"] for frame in meta["frames"]]
    assert meta["test_filenames"] == [names[i] for i in held_out_indices(TRAIN, TEST)]
    vertex = PlyData.read(copy / "sparse_pc.ply")["vertex"]
    points = np.stack([vertex[name] for name in "xyz"], axis=1)
    assert len(points) == POINTS
    # Seen from the middle of the orbit, most points lie on the first surface: above all on the landscape far away.
    far = points[np.linalg.norm(points, axis=1) > 15]
    origin = np.array([0.0, 0.0, 3.0])
    length = np.linalg.norm(far - origin, axis=1)
    reach, _ = first_hits(still_life(0), np.broadcast_to(origin, far.shape), (far - origin) / length[:, None])
    clear = reach > 0.9 * length
    assert clear.sum() > 500
    assert np.median(np.abs(reach[clear] / length[clear] - 1)) < 0.005


def test_an_earlier_copy_is_replaced_and_other_files_stay(tmp_path: Path) -> None:
    write_demo_capture(tmp_path)
    marker = tmp_path / ".sundae_scene.json"
    marker.write_text(
        json.dumps({"files": [*json.loads(marker.read_text())["files"], "images/of_another_version.png"]})
    )
    for name in ("notes.txt", "images/of_another_version.png", "images/frame_00001.png"):
        (tmp_path / name).write_text("mine")
    write_demo_capture(tmp_path)
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert len(list((tmp_path / "images").iterdir())) == TRAIN + TEST
    assert check_image(tmp_path / "images" / "frame_00001.png") == (SIDE, SIDE)


def test_other_folders_are_refused_and_unchanged(tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_text("{}")
    with pytest.raises(DataError, match="other files than the demo's capture"):
        write_demo_capture(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["transforms.json"]
    with pytest.raises(DataError, match="is a file"):
        write_demo_capture(tmp_path / "transforms.json")
    (tmp_path / ".sundae_scene.json").write_text("[]")
    with pytest.raises(DataError, match="is damaged"):
        write_demo_capture(tmp_path)
    assert (tmp_path / "transforms.json").read_text() == "{}"


def test_the_marker_deletes_nothing_outside(tmp_path: Path) -> None:
    outside, out = tmp_path / "outside", tmp_path / "out"
    outside.write_text("mine")
    out.mkdir()
    (out / ".sundae_scene.json").write_text(json.dumps({"files": ["../outside", str(outside)]}))
    write_demo_capture(out)
    assert outside.read_text() == "mine"


def test_an_interrupted_copy_has_no_transforms(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read, left = zipfile.ZipFile.read, [TRAIN + TEST + 1]

    def until_the_end(self: zipfile.ZipFile, name: str) -> bytes:
        left[0] -= 1
        if left[0] < 0:
            raise KeyboardInterrupt
        return read(self, name)

    monkeypatch.setattr(zipfile.ZipFile, "read", until_the_end)
    with pytest.raises(KeyboardInterrupt):
        write_demo_capture(tmp_path)
    assert (tmp_path / "images" / "frame_00056.png").exists()
    assert not (tmp_path / "transforms.json").exists()


def test_the_archive_is_small() -> None:
    assert ARCHIVE.stat().st_size < 1_400_000


def test_an_interrupted_copy_is_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write, left = Path.write_bytes, 0

    def full(path: Path, content: bytes) -> int:
        nonlocal left
        left -= 1
        if left == 0:
            write(path, content[: len(content) // 2])
            raise OSError(28, "No space left on device")
        return write(path, content)

    (tmp_path / ".sundae_scene.json.partial").write_text("killed here")
    monkeypatch.setattr(Path, "write_bytes", full)
    for number in (1, 2, TRAIN + TEST + 3):  # the marker, an image, transforms.json
        left = number
        with pytest.raises(OSError, match="No space"):
            write_demo_capture(tmp_path)
        assert not (tmp_path / "transforms.json").exists()
        assert not list(tmp_path.rglob("*.partial"))
    write_demo_capture(tmp_path)
    check_transforms(tmp_path / "transforms.json")
