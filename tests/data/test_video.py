"""Frames of videos: the sharpest of each stretch, or one line that says why there are none."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from run_commands import write_video

from sundae_ns.core.errors import DataError
from sundae_ns.data import video
from sundae_ns.data.video import check_video, is_video, sharpness, write_frames


def frames_of(folder: Path) -> list[np.ndarray]:
    return [cv2.imread(str(path)) for path in sorted(folder.iterdir())]


def test_the_sharpest_frame_of_each_stretch(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", 60)
    done: list[int] = []
    write_frames(tmp_path / "a.mp4", tmp_path / "frames", 20, done.append)
    found = frames_of(tmp_path / "frames")
    assert len(found) == sum(done) == 20
    # Every third frame is sharp, and a stretch has three. The square moves by three pixels from one to the next.
    assert min(map(sharpness, found)) > 3 * sharpness(cv2.GaussianBlur(found[0], (9, 9), 4))
    left = [int((frame[20, :, 1] > 120).argmax()) for frame in found]
    assert left[:13] == [1 + 3 * number for number in range(13)]


def test_a_short_video_gives_all_its_frames(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", 7)
    write_frames(tmp_path / "a.mp4", tmp_path / "frames", 150, lambda _: None)
    assert [path.name for path in sorted((tmp_path / "frames").iterdir())] == [f"{i:05d}.jpg" for i in range(1, 8)]


def test_a_video_that_states_no_length(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_video(tmp_path / "a.mp4", 30)
    monkeypatch.setattr(cv2, "CAP_PROP_FRAME_COUNT", 9999)  # a property that nobody has: 0
    write_frames(tmp_path / "a.mp4", tmp_path / "frames", 10, lambda _: None)
    assert len(frames_of(tmp_path / "frames")) == 10


def test_frames_are_there_only_once_they_are_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_video(tmp_path / "a.mp4", 30)

    def stop(count: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_frames(tmp_path / "a.mp4", tmp_path / "frames", 10, stop)
    assert not (tmp_path / "frames").exists()
    write_frames(tmp_path / "a.mp4", tmp_path / "frames", 10, lambda _: None)
    assert len(frames_of(tmp_path / "frames")) == 10
    assert not (tmp_path / "frames.partial").exists()


def test_a_video_by_its_suffix(tmp_path: Path) -> None:
    write_video(tmp_path / "A WALK.MP4", 5)
    assert is_video(tmp_path / "A WALK.MP4")
    check_video(tmp_path / "A WALK.MP4")
    (tmp_path / "folder.mp4").mkdir()
    assert not is_video(tmp_path / "folder.mp4")


def half(path: Path) -> None:
    write_video(path, 40)
    path.write_bytes(path.read_bytes()[:400])


@pytest.mark.parametrize(
    ("make", "cause"),
    [
        (lambda path: path.write_text("not a video"), "is not a video that OpenCV decodes; convert it to .mp4"),
        (lambda path: path.touch(), "is not a video that OpenCV decodes"),
        (half, "is not a video that OpenCV decodes"),
        (os.mkfifo, "it is a pipe or a device"),
        (lambda path: write_video(path, 2), "has 2 frames, and camera poses need 3 or more"),
    ],
)
def test_what_is_no_video(tmp_path: Path, make: object, cause: str, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "x.mp4"
    make(path)  # type: ignore[operator]
    with pytest.raises(DataError, match=cause) as error:
        check_video(path)
    assert "\n" not in str(error.value)


def test_every_suffix_is_lower_case() -> None:
    assert all(suffix == suffix.lower() and suffix.startswith(".") for suffix in video.SUFFIXES)
