"""Frames that show renderings beside the truth, and the video that they become."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest
import torch
from PIL import Image

from sundae_ns.evaluation import ComparisonRow
from sundae_ns.evaluation.video import WIDEST, side_by_side, write_video

GREEN, BLUE, RED = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)


def row(height: int, width: int) -> ComparisonRow:
    base, compensated, truth = (torch.tensor(color).expand(height, width, 3) for color in (GREEN, BLUE, RED))
    return ComparisonRow(truth, base, compensated, title="a.png, test view")


def colors(frame: Image.Image | np.ndarray, columns: int, line: int) -> list[tuple[float, ...]]:
    """Colours in [0, 1] in the middle of each column of a frame, in a line of pixels."""
    pixels = np.asarray(frame)
    width = pixels.shape[1] // columns
    return [tuple((pixels[line, width * column + width // 2] / 255).tolist()) for column in range(columns)]


def test_base_compensated_truth() -> None:
    frame = side_by_side(row(300, 400), (400, 300), head=True)
    assert frame.width == 1200
    assert colors(frame, 3, 150) == [GREEN, BLUE, RED]
    assert np.asarray(frame)[300:].max() == 255, "the captions"


def test_a_field_without_a_head_shows_two_images() -> None:
    frame = side_by_side(row(300, 400), (400, 300), head=False)
    assert frame.width == 800
    assert colors(frame, 2, 150) == [GREEN, RED]


def test_a_view_of_another_shape_gets_borders() -> None:
    frame = side_by_side(row(400, 200), (400, 400), head=True)
    pixels = np.asarray(frame)
    assert colors(frame, 3, 200) == [GREEN, BLUE, RED]
    assert pixels[:400, :99].max() == 0
    assert pixels[:400, 301:499].max() == 0


@pytest.mark.parametrize(("size", "expected"), [((60, 48), 240), ((61, 47), 244), ((1061, 1893), WIDEST // 3)])
def test_sides_are_even_and_fit(size: tuple[int, int], expected: int) -> None:
    frame = side_by_side(row(size[1], size[0]), size, head=True)
    assert frame.width == 3 * expected
    assert frame.width <= WIDEST
    assert frame.height % 2 == 0


def test_the_video_has_the_frames_and_their_colours(tmp_path: Path) -> None:
    first, second = row(300, 400), row(300, 400)
    second = ComparisonRow(second.compensated, second.truth, second.base)
    frames = [side_by_side(each, (400, 300), head=True) for each in (first, first, second)]
    assert write_video(tmp_path / "video.partial", iter(frames)) == 3
    with av.open(str(tmp_path / "video.partial")) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.width, stream.height) == ("h264", *frames[0].size)
        read = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(read) == 3
    expected = ([GREEN, BLUE, RED], [GREEN, BLUE, RED], [RED, GREEN, BLUE])
    for found, wanted in zip(read, expected, strict=True):
        assert np.abs(np.array(colors(found, 3, 150)) - np.array(wanted)).max() < 0.03
