"""Folders of photos: judged by what files hold, in one line, and without waiting for a pipe."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from sundae_ns.cli.poses import Poses
from sundae_ns.data.photos import find_photos, left_out
from sundae_ns.errors import DataError


def photo(path: Path, kind: str = "png") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (16, 12), "grey").save(path, format=kind)
    return path


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    for index in range(3):
        photo(folder / f"{index}.png")
    return folder


def test_photos_of_all_folders_in_the_order_of_their_paths(photos: Path) -> None:
    photo(photos / "b" / "0.PNG")
    photo(photos / "a.png" / "-c.png")  # a folder is no photo, whatever its name
    photo(photos / ".thumbnails" / "0.png")
    photo(photos / "._0.png")
    (photos / "notes.txt").touch()
    (photos / "link.png").symlink_to(photos / "0.png")
    names = ["0.png", "1.png", "2.png", "a.png/-c.png", "b/0.PNG", "link.png"]
    assert find_photos(photos) == ([photos / name for name in names], ".png")


@pytest.mark.parametrize(("kind", "suffix"), [("jpeg", ".jpg"), ("mpo", ".jpg"), ("png", ".png"), ("tiff", ".tif")])
def test_the_suffix_is_that_of_the_contents(tmp_path: Path, kind: str, suffix: str) -> None:
    for index, name in enumerate(("JPG", "jpeg", "png", "tif", "TIFF")):
        photo(tmp_path / f"{index}.{name}", kind)
    assert find_photos(tmp_path)[1] == suffix


def test_raw_photos(tmp_path: Path) -> None:
    for index in range(3):
        (tmp_path / f"{index}.CR2").write_bytes(b"II*\0\x10\0\0\0CR\2\0" + bytes(100))
    assert find_photos(tmp_path)[1] == ".cr2"
    (tmp_path / "3.cr2").write_bytes(b"II*\0" + bytes(100))
    with pytest.raises(DataError, match=r"3\.cr2 is not a raw photo"):
        find_photos(tmp_path)


ODD: dict[str, tuple[Callable[[Path], object], str]] = {
    "a pipe": (os.mkfifo, "it is a pipe or a device"),
    "a raw pipe": (lambda path: os.mkfifo(path.with_suffix(".cr2")), "it is a pipe or a device"),
    "a device": (lambda path: path.symlink_to("/dev/zero"), "it is a pipe or a device"),
    "a dangling link": (lambda path: path.symlink_to("gone.png"), "No such file or directory"),
    "a link to itself": (lambda path: path.symlink_to(path), "Too many levels of symbolic links"),
    "text": (lambda path: path.write_text("not a photo"), "it is not an image"),
    "nothing": (lambda path: path.touch(), "it is not an image"),
    "another format": (lambda path: photo(path, "bmp"), "is a BMP file by its contents"),
    "16 bits": (lambda path: Image.new("I;16", (16, 12)).save(path), "pixels of type I;16"),
    "two formats": (lambda path: photo(path, "jpeg"), r"x\.png a \.jpg by its contents"),
}


@pytest.mark.parametrize("kind", ODD)
def test_what_is_no_photo_is_named_in_one_line(photos: Path, kind: str) -> None:
    make, cause = ODD[kind]
    make(photos / "x.png")
    with pytest.raises(DataError, match=cause) as error:
        find_photos(photos)
    assert "\n" not in str(error.value)
    assert "x." in str(error.value)


def test_a_photo_that_may_not_be_read(photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path, *_: Any, **__: Any) -> Any:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    monkeypatch.setattr(Image, "open", refuse)  # the tests may run as root, who may read everything
    with pytest.raises(DataError, match=r"\d\.png cannot be read \(Permission denied\)"):
        find_photos(photos)


@pytest.mark.parametrize(("count", "cause"), [(0, "holds no photos"), (1, "holds 1 photo, "), (2, "holds 2 photos, ")])
def test_too_few_photos(photos: Path, count: int, cause: str) -> None:
    for path in sorted(photos.iterdir())[count:]:
        path.unlink()
    with pytest.raises(DataError, match=cause):
        find_photos(photos)


def test_a_folder_that_is_none(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for name, cause in (("pipe", "Not a directory"), ("gone", "No such file")):
        with pytest.raises(DataError, match=f"{name} cannot be read .{cause}"):
            find_photos(tmp_path / name)


def test_photos_of_other_formats_are_named(photos: Path) -> None:
    assert left_out(photos, find_photos(photos)[0]) == []
    for name in ("a.HEIC", "sub/b.heic", "c.webp", ".hidden.heic"):
        (photos / name).parent.mkdir(exist_ok=True)
        (photos / name).touch()
    (remark,) = left_out(photos, find_photos(photos)[0])
    assert remark.startswith("2 .heic files and 1 .webp file are left out")
    assert "convert them to JPEG" in remark
    for path in photos.glob("*.png"):
        path.unlink()
    with pytest.raises(
        DataError, match=r"only photos that cannot be read \(2 \.heic files and 1 \.webp file\); convert"
    ):
        find_photos(photos)


def test_a_run_says_which_photos_it_leaves_out(photos: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (photos / "a.heic").touch()
    Poses(photos, photos.parent / "capture", "exhaustive").check()
    assert capsys.readouterr().out.startswith("# warning: 1 .heic file is left out")


def test_photos_of_an_odd_size_are_named(photos: Path) -> None:
    Image.new("RGB", (12, 16)).save(photos / "upright.png")
    (remark,) = left_out(photos, find_photos(photos)[0])
    assert remark.startswith("1 of 4 photos (upright.png) are not 16 x 12 px as the others. COLMAP leaves them out")


def test_masks_are_no_photos(photos: Path) -> None:
    photo(photos / "masks" / "0.png")
    found, _ = find_photos(photos)
    assert [path.name for path in found] == ["0.png", "1.png", "2.png"]
    (remark,) = left_out(photos, found)
    assert f"{photos / 'masks'} is left out" in remark
    assert "mask_path" in remark


def test_photos_in_several_folders_only_are_counted_and_not_opened(tmp_path: Path) -> None:
    for name, count in (("a", 4), ("b/c", 2), ("masks", 3)):
        for index in range(count):
            (tmp_path / name).mkdir(parents=True, exist_ok=True)
            (tmp_path / name / f"{index}.png").touch()
    with pytest.raises(DataError, match=r"holds 6 photos in 2 folders \(a: 4, b/c: 2\); give the folder of one scene"):
        find_photos(tmp_path)


def test_photos_in_one_folder_further_in(tmp_path: Path) -> None:
    paths = [photo(tmp_path / "DCIM" / "100" / f"{index}.png") for index in range(3)]
    assert find_photos(tmp_path)[0] == paths
