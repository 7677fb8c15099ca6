"""The shipped capture, copied without touching other files."""

import json
import zipfile

import pytest

from sundae_ns.core.errors import DataError
from sundae_ns.data.capture import check_transforms
from sundae_ns.data.capture_files import ARCHIVE, write_demo_capture
from sundae_ns.data.images import check_image

TRAIN, TEST, SIDE = 48, 8, 128


def test_a_copy_is_a_sound_capture_and_is_replaced(tmp_path):
    copy = write_demo_capture(tmp_path / "new" / "folder")
    check_transforms(copy / "transforms.json", splits=("train", "test"))
    meta = json.loads((copy / "transforms.json").read_text())
    assert (len(meta["train_filenames"]), len(meta["test_filenames"])) == (TRAIN, TEST)
    assert {check_image(copy / frame["file_path"]) for frame in meta["frames"]} == {(SIDE, SIDE)}
    assert ARCHIVE.stat().st_size < 1_400_000
    for name in ("notes.txt", "images/frame_00001.png"):
        (copy / name).write_text("mine")
    write_demo_capture(copy)
    assert (copy / "notes.txt").read_text() == "mine"
    assert check_image(copy / "images" / "frame_00001.png") == (SIDE, SIDE)
    (tmp_path / "transforms.json").write_text("{}")
    for out, cause in ((tmp_path, "other files than the demo's capture"), (tmp_path / "transforms.json", "is a file")):
        with pytest.raises(DataError, match=cause):
            write_demo_capture(out)
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
