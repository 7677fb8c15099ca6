"""Photos as images of a capture: upright, grouped by camera, at several sizes."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from sundae_ns.data.photos import find_photos, reads_heif, upright
from sundae_ns.errors import DataError
from sundae_ns.poses.images import names_of, write_images, write_smaller

ORIENTATION, MODEL, FOCAL, EXIF = 0x0112, 0x0110, 0x920A, 0x8769


def gradient(width: int = 40, height: int = 24) -> Image.Image:
    """Red grows to the right and green downwards."""
    x, y = np.meshgrid(np.linspace(0, 255, width), np.linspace(0, 255, height))
    return Image.fromarray(np.stack([x, y, np.zeros_like(x)], axis=2).astype(np.uint8))


def save(path: Path, image: Image.Image | None = None, **entries: object) -> None:
    exif = Image.Exif()
    for name, value in entries.items():
        if name == "focal":
            exif.get_ifd(EXIF)[FOCAL] = value
        else:
            exif[{"orientation": ORIENTATION, "model": MODEL}[name]] = value
    (image or gradient()).save(path, exif=exif)


def test_photos_of_one_camera_share_a_folder(tmp_path: Path) -> None:
    save(tmp_path / "a.jpg", model="Phone", focal=4.2)
    save(tmp_path / "b.jpg", model="Phone", focal=4.2)
    save(tmp_path / "c.jpg", model="Phone", focal=9.0)
    save(tmp_path / "d.jpg", gradient(24, 40), model="Phone", focal=4.2)
    save(tmp_path / "e.jpg", gradient(24, 40), model="Phone", focal=4.2, orientation=6)
    save(tmp_path / "f.png", model="Other")
    names = names_of(find_photos(tmp_path))
    assert names == [
        "c1/frame_00001.jpg",
        "c1/frame_00002.jpg",
        "c2/frame_00003.jpg",
        "c3/frame_00004.jpg",
        "c1/frame_00005.jpg",  # turned, it has the size of the first ones
        "c4/frame_00006.png",
    ]


@pytest.mark.parametrize("orientation", range(1, 9))
def test_photos_become_upright(tmp_path: Path, orientation: int) -> None:
    turns = {
        1: [],
        2: [Image.Transpose.FLIP_LEFT_RIGHT],
        3: [Image.Transpose.ROTATE_180],
        4: [Image.Transpose.FLIP_TOP_BOTTOM],
        5: [Image.Transpose.TRANSPOSE],
        6: [Image.Transpose.ROTATE_90],
        7: [Image.Transpose.TRANSVERSE],
        8: [Image.Transpose.ROTATE_270],
    }
    stored = gradient()
    for turn in turns[orientation]:
        stored = stored.transpose(turn)
    for name in ("a", "b", "c"):
        save(tmp_path / f"{name}.jpg", stored, orientation=orientation)
    photos = find_photos(tmp_path)
    assert photos[0].size == (40, 24)
    write_images(photos, tmp_path / "images", lambda _: None)
    with Image.open(tmp_path / "images" / "c1" / "frame_00001.jpg") as image:
        assert image.getexif().get(ORIENTATION, 1) == 1
        assert image.size == (40, 24)
        assert np.abs(np.asarray(image, float) - np.asarray(gradient(), float)).mean() < 6
    assert photos[0].as_it_is == (orientation == 1)


def test_files_that_can_stay_are_copied_and_others_saved(tmp_path: Path) -> None:
    save(tmp_path / "a.jpg")
    save(tmp_path / "b.png")
    gradient().save(tmp_path / "c.tif")
    clear = gradient().convert("RGBA")
    clear.putalpha(100)
    clear.save(tmp_path / "d.webp", lossless=True)
    gradient().convert("L").save(tmp_path / "e.bmp")
    photos = find_photos(tmp_path)
    done: list[int] = []
    write_images(photos, tmp_path / "images", done.append)
    paths = [tmp_path / "images" / name for name in names_of(photos)]
    assert [path.suffix for path in paths] == [".jpg", ".png", ".jpg", ".png", ".jpg"]
    assert sum(done) == 5
    for photo, path in zip(photos[:2], paths):
        assert path.read_bytes() == photo.path.read_bytes()
    modes = []
    for path in paths:
        with Image.open(path) as image:
            modes.append(image.mode)
            assert image.format == {".jpg": "JPEG", ".png": "PNG"}[path.suffix]
    assert modes == ["RGB", "RGB", "RGB", "RGBA", "L"]


def test_images_that_are_there_stay(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        save(tmp_path / f"{name}.jpg")
    photos = find_photos(tmp_path)
    write_images(photos, tmp_path / "images", lambda _: None)
    first, second = (tmp_path / "images" / name for name in names_of(photos)[:2])
    before = first.stat().st_mtime_ns
    second.unlink()
    write_images(photos, tmp_path / "images", lambda _: None)
    assert first.stat().st_mtime_ns == before
    assert second.exists()


def test_heic(tmp_path: Path) -> None:
    if not reads_heif():
        pytest.skip("pillow-heif is not installed")
    for name in ("a", "b", "c"):
        exif = Image.Exif()
        exif[ORIENTATION] = 6
        gradient().save(tmp_path / f"{name}.HEIC", exif=exif.tobytes())
    photos = find_photos(tmp_path)
    assert {(photo.size, photo.suffix) for photo in photos} == {((24, 40), ".jpg")}
    write_images(photos, tmp_path / "images", lambda _: None)
    with Image.open(tmp_path / "images" / "c1" / "frame_00001.jpg") as image:
        assert image.size == (24, 40)
        assert image.getexif().get(ORIENTATION, 1) == 1
        left, right = image.getpixel((2, 20)), image.getpixel((21, 20))
    assert left[1] > right[1] + 100, "the bottom of the stored image is at the left"


@pytest.mark.parametrize("kind", ["jpg", "png", "webp"])
def test_pixels_that_cannot_be_decoded(tmp_path: Path, kind: str) -> None:
    for name in ("a", "b", "c"):
        Image.effect_noise((90, 60), 80).convert("RGB").save(tmp_path / f"{name}.{kind}")
    path = tmp_path / f"b.{kind}"
    photos = find_photos(tmp_path)
    path.write_bytes(path.read_bytes()[:1500])
    with pytest.raises(DataError, match=rf"b\.{kind} cannot be decoded"):
        upright(photos[1])
    with pytest.raises(DataError, match=rf"b\.{kind} cannot be decoded"):
        write_images(photos, tmp_path / "images", lambda _: None)


@pytest.mark.parametrize(("width", "factors"), [(43, [2, 4, 8]), (12800, [2, 4, 8]), (12803, [2, 4, 8, 16])])
def test_smaller_images(tmp_path: Path, width: int, factors: list[int]) -> None:
    (tmp_path / "images").mkdir()
    gradient(width, 19).save(tmp_path / "images" / "a.jpg")
    done: list[int] = []
    write_smaller(tmp_path / "images", done.append)
    assert done == [1]
    names = {"images", *(f"images_{one}" for one in factors)}
    assert {path.name for path in tmp_path.iterdir()} == names
    for factor in factors:
        with Image.open(tmp_path / f"images_{factor}" / "a.jpg") as image:
            assert image.size == (width // factor, 19 // factor)
            assert image.getpixel((0, 0))[0] < 60 < 200 < image.getpixel((width // factor - 1, 0))[0]


class Raw:
    """A raw photo, as rawpy opens one."""

    def __init__(self, path: str) -> None:
        self.size = (16, 12) if Path(path).stem != "odd" else (12, 16)

    def __enter__(self) -> Raw:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def postprocess(self) -> np.ndarray:
        return np.asarray(gradient(*self.size))


def test_raw_photos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rawpy", SimpleNamespace(imread=Raw))  # type: ignore[arg-type]
    for name in ("a", "b", "c"):
        (tmp_path / f"{name}.CR2").write_bytes(b"II*\0\x10\0\0\0CR\2\0" + bytes(100))
    photos = find_photos(tmp_path)
    write_images(photos, tmp_path / "images", lambda _: None)
    with Image.open(tmp_path / "images" / "c1" / "frame_00003.jpg") as image:
        assert (image.format, image.size) == ("JPEG", (16, 12))
    (tmp_path / "c.CR2").rename(tmp_path / "odd.CR2")
    with pytest.raises(DataError, match=r"raw photos of several sizes \(.*odd\.CR2 differs\); save them as JPEG"):
        write_images(find_photos(tmp_path), tmp_path / "others", lambda _: None)
