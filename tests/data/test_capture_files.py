"""The files of a capture: upright images at several sizes, and cameras that see what COLMAP sees."""

import json
import re
import sys
import zipfile
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from limits import refused
from photos import ORIENTATION, photo
from PIL import Image
from scipy.spatial.transform import Rotation

from sundae_ns.core.errors import DataError
from sundae_ns.data import capture_files
from sundae_ns.data.capture import check_transforms
from sundae_ns.data.capture_files import APPLIED, Placed, names_of, placed_in, write_demo_capture, write_images
from sundae_ns.data.images import check_image, reads_heif
from sundae_ns.data.photos import find_photos, photo_of
from sundae_ns.scene.cameras import cameras_of

PARAMETERS = [50.0, 60.0, 20.0, 15.0, 0.01, -0.02, 0.003, 0.004]


def model(cameras=1):
    """A reconstruction of four images, and one without a pose."""
    images = []
    for i, number in enumerate((5, 4, 3, 2, 9)):
        pose = np.column_stack([Rotation.random(random_state=i).as_matrix(), np.random.default_rng(i).normal(size=3)])
        pose_of, camera = lambda pose=pose: SimpleNamespace(matrix=lambda: pose), 1 + i % cameras
        known = {"name": f"c{camera}/frame_{number:05d}.jpg", "camera_id": camera, "has_pose": number != 9}
        images.append(SimpleNamespace(**known, cam_from_world=pose_of))
    stated = [SimpleNamespace(width=40 + i, height=30, params=np.array(PARAMETERS)) for i in range(cameras)]
    return SimpleNamespace(images=dict(enumerate(images)), cameras=dict(enumerate(stated, start=1)))


def transforms(made):
    sources = {image.name: f"IMG {image.name[-9:-4]}.HEIC" for image in made.images.values()}
    return capture_files.transforms_of(made, sources)


@pytest.mark.parametrize("cameras", [1, 2])
def test_our_cameras_see_what_colmap_sees(tmp_path, cameras):
    made = model(cameras)
    meta = transforms(made)
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    check_transforms(tmp_path / "transforms.json")
    assert ("fl_x" in meta, "fl_x" in meta["frames"][0]) == (cameras == 1, cameras == 2)
    points = np.random.default_rng(0).normal(size=(10, 3))
    moved = torch.from_numpy(points @ APPLIED[:, :3].T)
    posed = sorted((image for image in made.images.values() if image.has_pose), key=lambda image: image.name[3:])
    for camera, image in zip(cameras_of(tmp_path), posed, strict=True):
        pose, viewmat = image.cam_from_world().matrix(), camera.viewmat.double()
        seen = moved @ viewmat[:3, :3].T + viewmat[:3, 3]
        np.testing.assert_allclose(seen.numpy(), points @ pose[:, :3].T + pose[:, 3], atol=1e-5)
        assert (camera.width, camera.height) == (39 + image.camera_id, 30)
        assert (float(camera.K[0, 0]), float(camera.K[1, 2])) == (PARAMETERS[0], PARAMETERS[3])


def test_frames_name_their_photos_in_order(tmp_path):
    meta = transforms(model())
    assert [frame["file_path"] for frame in meta["frames"]] == [f"images/frame_{i:05d}.jpg" for i in (2, 3, 4, 5)]
    assert meta["frames"][0]["original"] == "IMG 00002.HEIC"
    assert meta["left_out"] == ["IMG 00009.HEIC"]
    made = model()
    made.cameras[1].params = np.array([50.0, 20.0, 15.0, 0.01])  # a simple camera is a special case
    meta = transforms(made)
    assert [meta[name] for name in ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1")] == [50, 50, 20, 15, 0.01, 0, 0]
    path = tmp_path / "transforms.json"
    path.write_text('{"frames": [{"file_path": "a", "original": "b"}, {"file_path": "c"}], "left_out": ["a"]}')
    assert placed_in(tmp_path) == Placed({"a": "b", "c": "c"}, ("a",))
    for text in ('{"frames": 3}', '{"frames": [], "left_out": 2}', '{"frames": [{}, {}', "[]"):
        path.write_text(text)
        refused(placed_in, tmp_path)


@pytest.mark.parametrize(
    ("placed", "left_out", "enough", "again"),
    [
        ("abcdef", "", True, "add sharp photos"),
        ("abcf", "de", True, "the way from c to d again"),
        ("efgh", "abcd", True, "the way from e to d again"),
        ("ab", "cde", False, "the way from b to c again"),
        ("ab", "", False, "add sharp photos"),
        ("abc", "defgh", False, "the way from c to d again"),
    ],
)
def test_what_to_photograph_again(placed, left_out, enough, again):
    photos = Placed(dict(enumerate(placed)), tuple(left_out))
    assert (photos.total, photos.enough) == (len(placed + left_out), enough)
    assert again in photos.again


def gradient(width=40, height=24):
    """Red grows to the right and green downwards."""
    x, y = np.meshgrid(np.linspace(0, 255, width), np.linspace(0, 255, height))
    return Image.fromarray(np.stack([x, y, np.zeros_like(x)], axis=2).astype(np.uint8))


def written(out, *paths):
    """Paths of the images that are written of photos."""
    photos, done = [photo_of(path) for path in paths], []
    assert [*write_images(photos, out, str, done.append)] == names_of(photos)
    assert sum(done) == len(photos)
    return [out / name for name in names_of(photos)]


def test_photos_of_one_camera_share_a_folder(tmp_path):
    tall = gradient(24, 40)
    photo(tmp_path / "a.jpg", image=gradient(), model="Phone", focal=4.2)
    photo(tmp_path / "b.jpg", image=gradient(), model="Phone", focal=9.0)
    photo(tmp_path / "c.jpg", image=tall, model="Phone", focal=4.2)
    photo(tmp_path / "d.jpg", image=tall, model="Phone", focal=4.2, orientation=6)  # turned, it is as the first
    photo(tmp_path / "e.png", image=gradient(), model="Other")
    names = [f"c{camera}/frame_{number:05d}" for number, camera in enumerate((1, 2, 3, 1, 4), start=1)]
    assert names_of(find_photos(tmp_path)) == [*(f"{name}.jpg" for name in names[:4]), f"{names[4]}.png"]


TURNS = [None, "FLIP_LEFT_RIGHT", "ROTATE_180", "FLIP_TOP_BOTTOM", "TRANSPOSE", "ROTATE_90", "TRANSVERSE", "ROTATE_270"]


@pytest.mark.parametrize(("orientation", "turn"), enumerate(TURNS, start=1))
def test_photos_become_upright(tmp_path, orientation, turn):
    stored = gradient() if turn is None else gradient().transpose(Image.Transpose[turn])
    path = photo(tmp_path / "a.jpg", image=stored, orientation=orientation)
    assert photo_of(path).as_it_is == (orientation == 1)
    with Image.open(*written(tmp_path / "out", path)) as image:
        assert image.getexif().get(ORIENTATION, 1) == 1
        assert image.size == (40, 24)
        assert np.abs(np.asarray(image, float) - np.asarray(gradient(), float)).mean() < 6


def test_files_that_can_stay_are_copied_and_others_saved(tmp_path):
    clear = gradient().convert("RGBA")
    clear.putalpha(100)
    for name in ("a.jpg", "b.png"):
        photo(tmp_path / name, image=gradient())
    gradient().save(tmp_path / "c.tif")
    clear.save(tmp_path / "d.webp", lossless=True)
    gradient().convert("L").save(tmp_path / "e.bmp")
    sources = sorted(tmp_path.iterdir())
    paths = written(tmp_path / "out", *sources)
    kinds = [("JPEG", "RGB"), ("PNG", "RGB"), ("JPEG", "RGB"), ("PNG", "RGBA"), ("JPEG", "L")]
    for path, (kind, mode) in zip(paths, kinds, strict=True):
        with Image.open(path) as image:
            assert (path.suffix, image.format, image.mode) == ({"JPEG": ".jpg"}.get(kind, ".png"), kind, mode)
    for source, path in zip(sources[:2], paths):
        assert path.read_bytes() == source.read_bytes()
    before = paths[0].stat().st_mtime_ns
    paths[1].unlink()
    written(tmp_path / "out", *sources)
    assert (paths[0].stat().st_mtime_ns, paths[1].exists()) == (before, True), "what is there stays"


def test_heic_is_turned_as_its_box_says(tmp_path):
    assert reads_heif()
    path = photo(tmp_path / "a.HEIC", image=gradient(), orientation=6)
    with Image.open(*written(tmp_path / "out", path)) as image:
        assert (image.size, image.getexif().get(ORIENTATION, 1)) == ((24, 40), 1)
        assert image.getpixel((2, 20))[1] > image.getpixel((21, 20))[1] + 100  # the bottom is at the left


@pytest.mark.parametrize("kind", ["jpg", "png", "webp"])
def test_pixels_that_cannot_be_decoded(tmp_path, kind):
    for name in "abcd":
        Image.effect_noise((90, 60), 80).convert("RGB").save(tmp_path / f"{name}.{kind}")
    photos, said = find_photos(tmp_path), []
    cause = rf"\.{kind} (is not a photo that can be decoded|cannot be read)"
    (tmp_path / f"b.{kind}").write_bytes((tmp_path / f"b.{kind}").read_bytes()[:1500])
    usable = write_images(photos, tmp_path / "out", said.append, str)
    assert [photo.path.stem for photo in usable.values()] == ["a", "c", "d"]
    assert re.match(f"left out: .*b{cause}", said[0])
    (tmp_path / f"c.{kind}").write_bytes(b"")
    with pytest.raises(DataError, match=rf"c{cause}.*; 2 of 4 photos cannot be used"):
        write_images(photos, tmp_path / "others", str, str)


@pytest.mark.parametrize(("width", "factors"), [(43, [2, 4, 8]), (12800, [2, 4, 8]), (12803, [2, 4, 8, 16])])
def test_smaller_images(tmp_path, width, factors):
    (tmp_path / "images").mkdir()
    gradient(width, 19).save(tmp_path / "images" / "a.jpg")
    capture_files.write_smaller(tmp_path / "images", lambda _: None)
    assert {path.name for path in tmp_path.iterdir()} == {"images", *(f"images_{factor}" for factor in factors)}
    for factor in factors:
        with Image.open(tmp_path / f"images_{factor}" / "a.jpg") as image:
            assert image.size == (width // factor, 19 // factor)
            assert image.getpixel((0, 0))[0] < 60 < 200 < image.getpixel((width // factor - 1, 0))[0]


class Raw(nullcontext[Any]):
    """A raw photo, as rawpy opens one; one named odd is stored lying."""

    def __init__(self, path):
        super().__init__(self)
        self.size, flip = ((12, 16), 5) if Path(path).stem == "odd" else ((16, 12), 0)
        self.sizes = SimpleNamespace(iwidth=16, iheight=12, flip=flip)

    def postprocess(self):
        return np.asarray(gradient(*self.size))


def test_raw_photos(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rawpy", SimpleNamespace(imread=Raw))
    paths = [tmp_path / f"{name}.CR2" for name in ("a", "b", "odd")]
    for path in paths:
        path.write_bytes(b"II*\0\x10\0\0\0CR\2\0" + bytes(100))
    assert [photo.size for photo in find_photos(tmp_path)] == [(16, 12), (16, 12), (12, 16)]
    images = written(tmp_path / "out", *paths)
    assert [path.parent.name for path in images] == ["c1", "c1", "c2"]
    with Image.open(images[0]) as image:
        assert (image.format, image.size) == ("JPEG", (16, 12))


TRAIN, TEST, SIDE = 48, 8, 128  # of the demo's capture


def test_a_copy_is_a_sound_capture_and_is_replaced(tmp_path):
    copy = write_demo_capture(tmp_path / "new" / "folder")
    check_transforms(copy / "transforms.json", splits=("train", "test"))
    meta = json.loads((copy / "transforms.json").read_text())
    assert (len(meta["train_filenames"]), len(meta["test_filenames"])) == (TRAIN, TEST)
    assert {check_image(copy / frame["file_path"]) for frame in meta["frames"]} == {(SIDE, SIDE)}
    assert capture_files.ARCHIVE.stat().st_size < 1_400_000
    for name in ("notes.txt", "images/frame_00001.png"):
        (copy / name).write_text("mine")
    write_demo_capture(copy)
    assert (copy / "notes.txt").read_text() == "mine"
    assert check_image(copy / "images" / "frame_00001.png") == (SIDE, SIDE)
    (tmp_path / "transforms.json").write_text("{}")
    refused(write_demo_capture, tmp_path, "other files than the demo's capture")
    assert (tmp_path / "transforms.json").read_text() == "{}"


@pytest.mark.parametrize("left", [0, 1, TRAIN + TEST + 1])
def test_an_interrupted_copy_has_no_transforms_and_is_made_again(tmp_path, monkeypatch, left):
    read, done = zipfile.ZipFile.read, []

    def until_the_end(self, name):
        done.append(name)
        if len(done) > left:
            raise KeyboardInterrupt
        return read(self, name)

    write_demo_capture(tmp_path)
    with monkeypatch.context() as patched:
        patched.setattr(zipfile.ZipFile, "read", until_the_end)
        with pytest.raises(KeyboardInterrupt):
            write_demo_capture(tmp_path)
    assert not (tmp_path / "transforms.json").exists()
    check_transforms(write_demo_capture(tmp_path) / "transforms.json")
