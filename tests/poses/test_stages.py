"""Stages from photos to a capture: each continues where a killed process has left it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from fake_colmap import FakeColmap
from PIL import Image
from ray_tracing import write_still_life
from run_commands import write_video

from sundae_ns.data.capture import check_transforms
from sundae_ns.errors import DataError, StorageError
from sundae_ns.poses import Request, find_poses, reconstruction
from sundae_ns.storage import run_folder
from sundae_ns.storage.ply import read_point_cloud

PHOTOS = 8


@pytest.fixture
def colmap(monkeypatch: pytest.MonkeyPatch) -> FakeColmap:
    """A pycolmap with two threads."""
    made = FakeColmap()
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    monkeypatch.setattr(reconstruction, "pycolmap", lambda: made)
    monkeypatch.setattr(run_folder, "_held", {})
    return made


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "-my $(photos)"
    folder.mkdir()
    for index in range(PHOTOS):
        Image.new("RGB", (16, 12), (20 * index, 90, 90)).save(folder / f"{index}.JPG")
    return folder


class Log:
    """Stages with their progress."""

    def __init__(self) -> None:
        self.stages: dict[str, list[int]] = {}

    @contextmanager
    def __call__(self, stage: str, total: int) -> Iterator[Callable[[int], None]]:
        self.stages[stage] = [total, 0]

        def advance(count: int) -> None:
            self.stages[stage][1] += count

        yield advance


def request(photos: Path, **changes: object) -> Request:
    out = photos.parent / "capture"
    return Request(**{"photos": photos, "capture": out, "matching": "auto", "frames": 20, "masks": None, **changes})  # type: ignore[arg-type]


def test_photos_become_a_capture(colmap: FakeColmap, photos: Path) -> None:
    log = Log()
    found = find_poses(request(photos), log)
    assert len(found.photos.placed) == PHOTOS
    assert (found.cameras, found.error, found.models, found.masks) == (1, 0.5, (PHOTOS,), None)
    capture = photos.parent / "capture"
    meta = check_transforms(capture / "transforms.json")
    assert [frame["original"] for frame in meta["frames"]] == [f"{i}.JPG" for i in range(PHOTOS)]
    assert len(list((capture / "images").iterdir())) == PHOTOS
    assert read_point_cloud(capture / "sparse_pc.ply")[0].tolist() == [[1.0, 3.0, -2.0]]
    assert (capture / "colmap" / "sparse" / "0" / "images.json").is_file()
    assert sorted(path.name for path in photos.parent.iterdir()) == ["-my $(photos)", "capture"]
    for stage, pairs in (("images", 8), ("features", 8), ("matches of pairs", 28), ("capture", 8)):
        assert log.stages[stage] == [pairs, pairs]
    assert colmap.calls["models"] == ["OPENCV"]


@pytest.mark.parametrize("stage", ["import", "features", "pairs", "models"])
def test_a_stage_continues(colmap: FakeColmap, photos: Path, stage: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reconstruction, "_PAIRS_AT_ONCE", 5)
    colmap.fails = stage
    with pytest.raises(RuntimeError, match="ended early"):
        find_poses(request(photos), Log())
    assert not (photos.parent / "capture").exists()
    run_folder._held.clear()  # the process has ended
    log = Log()
    assert len(find_poses(request(photos), log).photos.placed) == PHOTOS
    assert log.stages["features"] == [PHOTOS, PHOTOS]
    for name, times in (("import", PHOTOS * (1 + (stage == "import"))), ("features", PHOTOS), ("pairs", 28)):
        assert len(colmap.calls[name]) == times, "nothing is done twice"
    assert len(colmap.calls["models"]) == 1 + (stage == "models")


@pytest.mark.parametrize("change", ["a photo more", "another photo", "another way"])
def test_other_photos_or_options_start_anew(colmap: FakeColmap, photos: Path, change: str) -> None:
    colmap.fails = "models"
    with pytest.raises(RuntimeError):
        find_poses(request(photos), Log())
    run_folder._held.clear()
    if change == "a photo more":
        shutil.copy(photos / "0.JPG", photos / "9.JPG")
    elif change == "another photo":
        Image.new("RGB", (16, 12), "red").save(photos / "0.JPG")
    find_poses(request(photos, matching="similar" if change == "another way" else "auto"), Log())
    assert colmap.calls["features"].count("c1/frame_00001.jpg") == 2


def test_the_largest_model_is_taken(colmap: FakeColmap, photos: Path) -> None:
    colmap.models = [3, 6, 4, 2]
    found = find_poses(request(photos), Log())
    assert found.models == (6, 4, 3)
    assert found.photos.left_out == ("6.JPG", "7.JPG")
    assert len(list((photos.parent / "capture" / "images").iterdir())) == 6


@pytest.mark.parametrize(("simple", "count"), [([PHOTOS], PHOTOS), ([6, 2], 6), ([5], 5), ([], 5)])
def test_simple_cameras_are_tried_while_photos_are_left_out(
    colmap: FakeColmap, photos: Path, simple: list[int], count: int
) -> None:
    colmap.models, colmap.simple = [5], simple
    assert len(find_poses(request(photos), Log()).photos.placed) == count
    assert colmap.calls["models"] == ["OPENCV", "SIMPLE_RADIAL"]


def test_images_that_see_hardly_a_point_have_no_pose(colmap: FakeColmap, photos: Path) -> None:
    colmap.blind = ("c1/frame_00002.jpg",)
    found = find_poses(request(photos), Log())
    assert found.photos.left_out == ("1.JPG",)
    capture = photos.parent / "capture"
    assert not (capture / "images" / "frame_00002.jpg").exists()
    assert "frame_00002" not in (capture / "colmap" / "sparse" / "0" / "images.json").read_text()


def test_no_model(colmap: FakeColmap, photos: Path) -> None:
    colmap.models = []
    with pytest.raises(DataError, match="no photos could be placed"):
        find_poses(request(photos), Log())


def test_frames_of_a_video_are_compared_with_their_neighbours(colmap: FakeColmap, tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", 90)
    log = Log()
    found = find_poses(request(tmp_path / "a.mp4", frames=40), log)
    assert log.stages["frames"] == [40, 40]
    assert found.photos.total == 40
    assert "c1/frame_00001.jpg c1/frame_00011.jpg" in colmap.calls["pairs"]
    assert 300 < len(colmap.calls["pairs"]) < 40 * 39 // 2


def test_masks_reach_the_capture(colmap: FakeColmap, photos: Path, tmp_path: Path) -> None:
    (tmp_path / "masks").mkdir()
    for index in range(PHOTOS):
        mask = Image.new("L", (16, 12), 255)
        mask.putpixel((index, 0), 0)
        mask.save(tmp_path / "masks" / f"{index}.png")
    colmap.models = [6]
    assert find_poses(request(photos, masks=tmp_path / "masks"), Log()).masks == "6 of 6"
    frames = check_transforms(tmp_path / "capture" / "transforms.json")["frames"]
    assert frames[2]["mask_path"] == "masks/frame_00003.png"
    with Image.open(tmp_path / "capture" / "masks" / "frame_00003.png") as stored:
        assert (stored.getpixel((2, 0)), stored.getpixel((3, 0))) == (0, 255)


def test_one_process_works_on_a_capture(colmap: FakeColmap, photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_folder.reserve(photos.parent / "capture.partial")
    held = dict(run_folder._held)
    monkeypatch.setattr(run_folder, "_held", {})
    with pytest.raises(StorageError, match="works in .*partial; wait for it, or choose another folder"):
        find_poses(request(photos), Log())
    del held


def test_poses_of_a_still_life(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The real COLMAP: where the cameras stand and what they see agree with the scene's own, after a similarity."""
    pytest.importorskip("pycolmap")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setattr(run_folder, "_held", {})
    scene = write_still_life(
        tmp_path / "scene", train_views=29, test_views=1, width=240, height=180, points=10, samples=1
    )
    found = find_poses(request(scene / "images"), Log())
    assert len(found.photos.placed) >= 20
    assert found.error < 1
    truth = {frame["file_path"]: frame for frame in json.loads((scene / "transforms.json").read_text())["frames"]}
    meta = check_transforms(tmp_path / "scene" / "capture" / "transforms.json")
    ours = np.array([frame["transform_matrix"] for frame in meta["frames"]])
    theirs = np.array([truth[f"images/{frame['original']}"]["transform_matrix"] for frame in meta["frames"]])
    a, b = ours[:, :3, 3], theirs[:, :3, 3]
    centred, target = a - a.mean(axis=0), b - b.mean(axis=0)
    u, values, v = np.linalg.svd(target.T @ centred)
    signs = np.diag([1, 1, np.sign(np.linalg.det(u @ v))])
    rotation = u @ signs @ v
    scale = (values * np.diag(signs)).sum() / (centred**2).sum()
    away = np.linalg.norm(target - scale * centred @ rotation.T, axis=1)
    assert away.max() < 0.05 * np.linalg.norm(target, axis=1).max()  # measured: 0.022
    turned = np.einsum("ij,njk,nlk->nil", rotation, ours[:, :3, :3], theirs[:, :3, :3])
    angles = np.degrees(np.arccos(np.clip((np.trace(turned, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert angles.max() < 3
