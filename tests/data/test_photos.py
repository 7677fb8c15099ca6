"""Folders of photos and their masks: judged by what files hold, in one line, and without waiting for a pipe."""

import errno
import os
import re
import struct
import zlib
from pathlib import Path
from unittest.mock import Mock

import pytest
from limits import refused
from photos import photo
from photos import photos as write_photos
from PIL import Image

from sundae_ns.cli.poses import PoseOptions, check_poses
from sundae_ns.core.errors import DataError
from sundae_ns.data import photos as module
from sundae_ns.data import reconstruct
from sundae_ns.data.photos import find_photos, left_out, masks_beside, masks_of, photo_of


def paths_of(folder):
    return [photo.path for photo in find_photos(folder)]


@pytest.fixture
def photos(tmp_path):
    write_photos(tmp_path / "photos")
    return tmp_path / "photos"


def test_photos_of_all_folders_in_the_order_of_their_paths(photos):
    photo(photos / "b" / "0.PNG")
    photo(photos / "a.png" / "-c.png")  # a folder is no photo, whatever its name
    for name in (".thumbnails/0.png", "._0.png", "masks/0.png"):
        photo(photos / name)
    (photos / "notes.txt").touch()
    (photos / "link.png").symlink_to(photos / "0.png")
    names = ["0.png", "1.png", "2.png", "a.png/-c.png", "b/0.PNG", "link.png"]
    assert paths_of(photos) == [photos / name for name in names]
    assert masks_beside(photos) == photos / "masks"
    said = []
    find_photos(photos, said.append)
    assert said[0].startswith(f"{photos}/link.png and {photos}/0.png seem to be one photo (1 pairs); remove one, or")
    (photos / "link.png").unlink()
    photo(photos / "1.jpg", size=(20, 16))  # beside 1.png, as exports of HEIC or of RAW files
    find_photos(photos, said.append)
    assert said[1].startswith(f"{photos}/1.png and {photos}/1.jpg seem to be one photo (1 pairs); remove one, or")


@pytest.mark.parametrize("kind", ["jpeg", "mpo", "png", "tiff", "webp", "bmp"])
def test_the_suffix_is_that_of_the_contents(tmp_path, kind):
    for index, name in enumerate(("JPG", "jpeg", "jfif", "png", "tif", "TIFF", "webp", "bmp")):
        photo(tmp_path / f"{index}.{name}", kind)
    expected = (".png" if kind == "png" else ".jpg", kind in ("jpeg", "mpo", "png"))
    assert {(photo.suffix, photo.as_it_is) for photo in find_photos(tmp_path)} == {expected}


def zipped_text(path):
    """A PNG whose text behind the pixels unpacks to 80 MB."""
    Image.new("RGB", (16, 12)).save(path)
    content, text = path.read_bytes(), b"zTXta\0\0" + zlib.compress(bytes(80 << 20), 9)
    chunk = struct.pack(">I", len(text) - 4) + text + struct.pack(">I", zlib.crc32(text))
    path.write_bytes(content[:-12] + chunk + content[-12:])


def scans(path):
    """A progressive JPEG whose last scan comes often: each is decoded over the whole image."""
    Image.new("RGB", (16, 12)).save(path, "JPEG", progressive=True)
    content = path.read_bytes()
    path.write_bytes(content[:-2] + 300 * content[content.rfind(b"\xff\xda") : -2])


SPHERE = b'<rdf:Description GPano:ProjectionType="equirectangular"/>'
CYLINDER = SPHERE.replace(b"equirectangular", b"cylindrical")
ODD = {
    "a pipe": (os.mkfifo, "it is a pipe or a device"),
    "a raw pipe": (lambda path: os.mkfifo(path.with_suffix(".cr2")), "it is a pipe or a device"),
    "a raw photo of text": (lambda path: path.with_suffix(".cr2").write_text("II*"), "is not a photo"),
    "a dangling link": (lambda path: path.symlink_to("gone.png"), "does not exist"),
    "text": (lambda path: path.write_text("not a photo"), "cannot identify image file"),
    "another format": (lambda path: photo(path, "ppm"), "is a PPM file by its contents"),
    "floats": (lambda path: photo(path, "tiff", "F"), "pixels of type F"),
    "a mask of RealityScan": (lambda path: photo(path.with_name("0.png.mask.x.png"), mode="L"), "is a mask or another"),
    "a depth map": (lambda path: photo(path.with_name("depth_0.x.png"), mode="I;16"), "is a mask or another"),
    "a bomb of text": (zipped_text, "Decompressed data too large"),
    "a panorama": (lambda path: Image.new("RGB", (32, 16)).save(path, "WEBP", xmp=SPHERE), "are panoramas: cut"),
    "a cylinder": (lambda path: Image.new("RGB", (32, 16)).save(path, "WEBP", xmp=CYLINDER), "a panorama: leave it"),
    "a panorama of an iPhone": (lambda path: photo(path, panorama=True), "a panorama: leave it"),
    "a scan 300 times": (scans, r"it has 3\d\d scans"),
    "a line": (lambda path: photo(path, size=(8000, 2)), "8000 x 2 px, too narrow for camera poses"),
}


@pytest.mark.parametrize(("make", "cause"), ODD.values(), ids=ODD)
def test_what_is_no_photo_is_left_out_in_one_line(photos, make, cause):
    make(photos / "x.png")
    said = []
    assert len(find_photos(photos, said.append)) == 3
    (line,) = said
    assert re.search(rf"^left out: .*x\.(png|cr2).*{cause}[^\n]*$", line)
    (photos / "0.png").unlink()
    refused(find_photos, photos, rf"{cause}.*; 1 of 3 photos cannot be used")


def test_half_of_the_photos_must_be_readable(photos, monkeypatch):
    for name in "abc":
        (photos / f"{name}.png").touch()
    assert len(find_photos(photos)) == 3
    (photos / "d.png").touch()
    refused(find_photos, photos, "; 4 of 7 photos cannot be used")
    denied = PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    monkeypatch.setattr(Image, "open", Mock(side_effect=denied))  # the tests may run as root, who may read everything
    refused(find_photos, photos, r"\w\.png cannot be read \(Permission denied\)")


def test_too_few_photos_and_folders_that_are_none(photos):
    for name, cause in (("1.png", "holds 2 photos, "), ("2.png", "holds 1 photo, "), ("0.png", "holds no photos")):
        (photos / name).unlink()
        refused(find_photos, photos, cause)
    os.mkfifo(photos / "pipe")
    for name, cause in (("pipe", "Not a directory"), ("gone", "No such file")):
        refused(find_photos, photos / name, f"{name} cannot be read .{cause}")


@pytest.mark.parametrize(
    ("names", "heif", "remark"),
    [
        (("a.AVIF", "sub/b.avif", "c.dng", ".d.avif"), True, "2 .avif, 1 .dng left out; convert them"),
        (("a.HEIC", "b.heic"), False, "2 .heic left out; install pillow-heif with pip install"),
    ],
)
def test_photos_that_are_not_read_are_named(photos, monkeypatch, capsys, names, heif, remark):
    monkeypatch.setattr(module.images, "reads_heif", lambda: heif)
    monkeypatch.setattr(reconstruct, "pycolmap", lambda: None)
    assert left_out(photos) is None
    for name in names:
        (photos / name).parent.mkdir(exist_ok=True)
        (photos / name).touch()
    assert len(find_photos(photos)) == 3
    check_poses(photos, PoseOptions())
    assert capsys.readouterr().out.startswith(f"# warning: {remark}")
    for path in photos.glob("*.png"):
        path.unlink()
    refused(find_photos, photos, f"holds no photos, and camera poses need 3 or more; {remark}")


def test_photos_in_several_folders_only_are_counted_and_not_opened(tmp_path):
    for name, count in (("a", 4), ("b/c", 2), ("masks", 3)):
        for index in range(count):
            (tmp_path / name).mkdir(parents=True, exist_ok=True)
            (tmp_path / name / f"{index}.png").touch()
    refused(find_photos, tmp_path, r"holds 6 photos in 2 folders \(a: 4, b/c: 2\); give the folder of one scene")
    paths = [photo(tmp_path / "DCIM" / "100" / f"{index}.png") for index in range(3)]
    assert paths_of(tmp_path / "DCIM") == paths


@pytest.mark.parametrize("name", ["a.jpg", "a.jpg.png", "a.png", "a.jpg.mask.png", "a_mask.png"])
@pytest.mark.parametrize(("orientation", "size"), [(1, (16, 12)), (6, (12, 16)), (8, (12, 16))])
def test_the_mask_of_a_photo_has_its_upright_size(tmp_path, name, orientation, size):
    path = photo(tmp_path / "photos" / "a.jpg", "jpeg", orientation=orientation)
    mask = photo(tmp_path / "masks" / name, mode="L", size=size)
    assert masks_of([photo_of(path)], mask.parent) == [mask]
    photo(mask, mode="L", size=size, orientation=3)
    with pytest.raises(DataError, match="or its mask is turned by its EXIF entry"):
        masks_of([photo_of(path)], mask.parent)


def test_masks_lie_in_folders_as_their_photos_do(tmp_path):
    found = [photo_of(photo(tmp_path / "photos" / folder / "0.jpg")) for folder in "ab"]
    photo(tmp_path / "masks" / "0.png", mode="L")
    with pytest.raises(DataError, match=r"b/0\.jpg and another photo have one mask, .*/masks/0\.png; put masks"):
        masks_of(found, tmp_path / "masks")
    for beside in (tmp_path / "photos" / "{}" / "masks", tmp_path / "masks" / "{}"):
        masks = [photo(Path(str(beside).format(folder), "0.png"), mode="L") for folder in "ab"]
        assert masks_of(found, tmp_path / "masks") == masks


MASKS = {
    "none": ((16, 12), 1, None, r"a\.jpg has no mask a\.png in"),
    "another size": ((16, 12), 1, ("L", (8, 6)), "has 8 x 6 px and its photo 16 x 12; scale it"),
    "colours": ((16, 12), 1, ("RGB", (16, 12)), "save it with one channel of 8 bits"),
    "upside down": ((16, 12), 3, ("L", (16, 12)), "is turned by its EXIF entry"),
    "lying": ((16, 12), 6, ("L", (16, 12)), "is turned by its EXIF entry"),
    "a square": ((12, 12), 6, ("L", (12, 12)), "is turned by its EXIF entry"),
}


@pytest.mark.parametrize(("size", "orientation", "mask", "cause"), MASKS.values(), ids=MASKS)
def test_a_mask_that_does_not_fit_is_refused(tmp_path, size, orientation, mask, cause):
    path = photo(tmp_path / "a.jpg", "jpeg", size=size, orientation=orientation)
    if mask is not None:
        photo(tmp_path / "masks" / "a.png", "png", *mask)
    with pytest.raises(DataError, match=cause):
        masks_of([photo_of(path)], tmp_path / "masks")
