"""From photos to a capture: each stage continues where a killed process has left it."""

import json
import os
import shutil
import signal
import sys
from contextlib import contextmanager

import numpy as np
import pytest
from fake_colmap import FakeColmap
from PIL import Image
from scipy.spatial.transform import Rotation

from sundae_ns.core.errors import ConfigError, DataError, StorageError
from sundae_ns.data import reconstruct
from sundae_ns.data.capture import check_transforms
from sundae_ns.data.capture_files import write_demo_capture
from sundae_ns.data.reconstruct import Request, find_poses, pycolmap, threads
from sundae_ns.io import run_folder
from sundae_ns.io.ply import read_point_cloud

PHOTOS = 8


@pytest.fixture
def colmap(monkeypatch):
    """A pycolmap with two threads."""
    made = FakeColmap()
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    monkeypatch.setattr(reconstruct, "pycolmap", lambda: made)
    monkeypatch.setattr(run_folder, "_held", {})
    return made


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "-my \udcff$(photos)"
    folder.mkdir()
    for index in range(PHOTOS):
        Image.new("RGB", (16, 12), (20 * index, 90, 90)).save(folder / f"{index}.JPG")
    return folder


def find(photos, warn=str, **changes):
    """What is placed, and for each stage the number of its parts and how many were done."""
    stages = {}

    @contextmanager
    def report(stage, total):
        stages[stage] = [total, 0]

        def advance(count):
            stages[stage][1] += count

        yield advance

    out = photos.parent / "capture"
    options = {"capture": out, "matching": "auto", "frames": 20, "masks": None, **changes}
    return find_poses(Request(photos, **options), report, warn), stages


def test_photos_become_a_capture(colmap, photos):
    found, stages = find(photos)
    assert len(found.placed) == PHOTOS
    assert (found.cameras, found.error, found.models) == (1, 0.5, (PHOTOS,))
    capture = photos.parent / "capture"
    meta = check_transforms(capture / "transforms.json")
    assert [frame["original"] for frame in meta["frames"]] == [f"{i}.JPG" for i in range(PHOTOS)]
    assert len(list((capture / "images").iterdir())) == PHOTOS
    assert read_point_cloud(capture / "sparse_pc.ply")[0].tolist() == [[1.0, 3.0, -2.0]]
    assert (capture / "colmap" / "sparse" / "0" / "images.json").is_file()
    assert sorted(path.name for path in photos.parent.iterdir()) == [photos.name, "capture"]
    for stage, parts in (("images", 8), ("features", 8), ("matches of pairs", 28), ("capture", 8)):
        assert stages[stage] == [parts, parts]
    assert colmap.calls["models"] == ["OPENCV"]


@pytest.mark.parametrize("stage", ["import", "features", "pairs", "models"])
def test_a_stage_continues(colmap, photos, stage, monkeypatch):
    monkeypatch.setattr(reconstruct, "_PAIRS_AT_ONCE", 5)
    colmap.fails = stage
    with pytest.raises(RuntimeError, match="ended early"):
        find(photos)
    assert not (photos.parent / "capture").exists()
    run_folder._held.clear()  # the process has ended
    found, stages = find(photos)
    assert (len(found.placed), stages["features"]) == (PHOTOS, [PHOTOS, PHOTOS])
    for name, times in (("import", PHOTOS * (1 + (stage == "import"))), ("features", PHOTOS), ("pairs", 28)):
        assert len(colmap.calls[name]) == times, "nothing is done twice"
    assert len(colmap.calls["models"]) == 1 + (stage == "models")


@pytest.mark.parametrize("change", ["a photo more", "another photo", "another way"])
def test_other_photos_or_options_start_anew(colmap, photos, change):
    colmap.fails = "models"
    with pytest.raises(RuntimeError):
        find(photos)
    run_folder._held.clear()
    if change == "a photo more":
        shutil.copy(photos / "0.JPG", photos / "9.JPG")
    elif change == "another photo":
        Image.new("RGB", (16, 12), "red").save(photos / "0.JPG")
    find(photos, matching="similar" if change == "another way" else "auto")
    assert colmap.calls["features"].count("c1/frame_00001.jpg") == 2


@pytest.mark.parametrize(
    ("models", "simple", "placed", "tried"),
    [
        ([3, 8, 4, 2], None, (8, 4, 3), 1),
        ([5], [PHOTOS], (PHOTOS,), 2),
        ([5], [6, 2], (6,), 2),
        ([5], [5], (5,), 2),
        ([5], [], (5,), 2),
        ([], [], (), 2),
    ],
)
def test_the_largest_model_is_taken_and_simple_cameras_are_tried_while_photos_are_left_out(
    colmap, photos, models, simple, placed, tried
):
    colmap.models, colmap.simple = models, simple
    if placed:
        found, _ = find(photos)
        assert found.models == placed
        assert found.left_out == tuple(f"{index}.JPG" for index in range(placed[0], PHOTOS))
        assert len(list((photos.parent / "capture" / "images").iterdir())) == placed[0]
    else:
        with pytest.raises(DataError, match="no photos could be placed"):
            find(photos)
    assert colmap.calls["models"] == ["OPENCV", "SIMPLE_RADIAL"][:tried]


def test_images_that_see_hardly_a_point_have_no_pose(colmap, photos):
    colmap.blind = ("c1/frame_00002.jpg",)
    assert find(photos)[0].left_out == ("1.JPG",)
    capture = photos.parent / "capture"
    assert not (capture / "images" / "frame_00002.jpg").exists()
    assert "frame_00002" not in (capture / "colmap" / "sparse" / "0" / "images.json").read_text()


def test_masks_reach_the_capture_beside_a_broken_photo(colmap, photos, tmp_path):
    (tmp_path / "masks").mkdir()
    for index in range(PHOTOS):
        mask = Image.new("L", (16, 12), 255)
        mask.putpixel((index, 0), 0)
        mask.save(tmp_path / "masks" / f"{index}.png")
    content = (photos / "1.JPG").read_bytes()
    (photos / "1.JPG").write_bytes(content[: content.index(b"\xff\xda") + 14])
    colmap.models, said = [6], []
    found, _ = find(photos, said.append, masks=tmp_path / "masks")
    assert found.left_out == ("7.JPG",)
    assert "1.JPG is not a photo that can be decoded" in said[0]
    frames = check_transforms(tmp_path / "capture" / "transforms.json")["frames"]
    assert frames[1]["mask_path"] == "masks/frame_00003.png"
    with Image.open(tmp_path / "capture" / "masks" / "frame_00003.png") as stored:
        assert (stored.getpixel((2, 0)), stored.getpixel((3, 0))) == (0, 255)
    assert len([*(tmp_path / "capture").glob("masks_[248]/*.png")]) == 18


def test_one_process_works_on_a_capture(colmap, photos, monkeypatch):
    run_folder.reserve(photos.parent / "capture.partial")
    held = dict(run_folder._held)
    monkeypatch.setattr(run_folder, "_held", {})
    with pytest.raises(StorageError, match="works in .*partial; wait for it, or choose another folder"):
        find(photos)
    del held


def test_pairs_of_a_walk(tmp_path, monkeypatch):
    """In a circle: each of 60 images shares features with its neighbours."""
    module = pytest.importorskip("pycolmap")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    rng, names = np.random.default_rng(0), [f"frame_{number:05d}.jpg" for number in range(60)]
    ring = rng.integers(0, 256, (60, 12, 128), dtype=np.uint8)
    with module.Database.open(tmp_path / "database.db") as database:
        database.write_camera(module.Camera.create_from_model_name(1, "OPENCV", 50.0, 64, 48))
        for number, name in enumerate(names):
            image = database.write_image(module.Image(name=name, camera_id=1))
            seen = np.concatenate([ring[(number + step) % 60] for step in range(-4, 5)])
            database.write_keypoints(image, rng.uniform(0, 48, (len(seen), 2)).astype(np.float32))
            kind = module.FeatureExtractorType.SIFT
            database.write_descriptors(image, module.FeatureDescriptors(type=kind, data=seen))

    def found(video=False):
        pairs = reconstruct._pairs(tmp_path, names, "auto", video)
        assert len(pairs) == len(set(pairs))
        return {(names.index(a), names.index(b)) for a, b in pairs}

    every, along = found(), found(video=True)
    assert every == {(a, b) for b in range(60) for a in range(b)}
    assert {(10, 10 + step) for step in (1, 2, 5, 10, 16, 32)} <= along
    assert {(0, 59), (1, 58)} <= along, "the walk ends where it began"
    assert len(along) < 60 * 20
    monkeypatch.setattr(reconstruct, "_ALIKE", 12)
    monkeypatch.setattr(reconstruct, "_MOST_EXHAUSTIVE", 59)
    similar = found()
    assert {(a, b) for a, b in every if min(b - a, 60 - b + a) <= 3} <= similar
    assert len(similar) < 60 * 13


BROKEN = "raise ImportError('libgomp.so.1: cannot open shared object file')"
RUDE = """
import signal
from types import SimpleNamespace as Names
signal.signal(signal.SIGTERM, lambda *_: print("a stack of thirty lines"))
logging = Names(minloglevel=0, Level=Names(FATAL=Names(value=3)))
"""


def test_a_package_that_is_missing_broken_or_takes_over_a_signal(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(ConfigError, match=r"need pycolmap \(.*; install it with pip install \"sundae_ns\[photos\]\""):
        pycolmap()
    for name, text in (("broken", BROKEN), ("rude", RUDE)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "pycolmap.py").write_text(text)
        monkeypatch.syspath_prepend(tmp_path / name)
        monkeypatch.delitem(sys.modules, "pycolmap", raising=False)
        if name == "broken":
            with pytest.raises(ConfigError, match=r"need pycolmap \(libgomp.*; install it with"):
                pycolmap()
    before = signal.getsignal(signal.SIGTERM)
    assert pycolmap().logging.minloglevel == 3, "its log is silent"
    assert signal.getsignal(signal.SIGTERM) is before


def test_threads(monkeypatch):
    for stated, count in (("3", 3), *((other, os.cpu_count()) for other in ("0", "", "many"))):
        monkeypatch.setenv("OMP_NUM_THREADS", stated)
        assert threads() == count


def test_poses_of_the_demo(tmp_path, monkeypatch):
    """The real COLMAP: where the cameras stand and what they see agree with the scene's own, after a similarity."""
    pytest.importorskip("pycolmap")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setattr(run_folder, "_held", {})
    scene = write_demo_capture(tmp_path / "scene")
    for path in sorted((scene / "images").iterdir())[28:]:
        path.unlink()
    found, _ = find(scene / "images")
    assert len(found.placed) >= 24
    assert found.error < 1
    truth = {frame["file_path"]: frame for frame in json.loads((scene / "transforms.json").read_text())["frames"]}
    frames = check_transforms(tmp_path / "scene" / "capture" / "transforms.json")["frames"]
    ours = np.array([frame["transform_matrix"] for frame in frames])
    theirs = np.array([truth[f"images/{frame['original']}"]["transform_matrix"] for frame in frames])
    centred, target = (poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0) for poses in (ours, theirs))
    turn, _ = Rotation.align_vectors(target, centred)
    moved = turn.apply(centred)
    away = np.linalg.norm(target - (moved * target).sum() / (moved**2).sum() * moved, axis=1)
    assert away.max() < 0.05 * np.linalg.norm(target, axis=1).max()  # measured: 0.011
    between = turn * Rotation.from_matrix(ours[:, :3, :3]) * Rotation.from_matrix(theirs[:, :3, :3]).inv()
    assert np.degrees(between.magnitude()).max() < 3
