"""Frames of a video as upright images in sRGB: the sharpest of each stretch."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import chain, groupby
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from PIL import Image

from sundae_ns.core.errors import DataError, reading, regular, writing
from sundae_ns.data.images import HIGH_RANGE, JPEG, PRIMARIES, to_srgb_values
from sundae_ns.data.photos import LEAST_PHOTOS, Warn, check_shape

SUFFIXES = tuple(".mp4 .mov .m4v .avi .mkv .webm .mpg .mpeg .mts .m2ts .ts .3gp .wmv .flv .ogv".split())
# Formats that open no other file: a playlist would take frames of other videos of this machine.
_FORMATS = "mov,matroska,avi,mpeg,mpegvideo,mpegts,h264,hevc,flv,asf,ogg"
_OPTIONS = {"format_whitelist": _FORMATS, "protocol_whitelist": "file"}
_CONVERT = "convert it to .mp4 (H.264)"
# Numbers of ITU-T H.273: matrices of BT.709, FCC, BT.601 (twice), 240M, BT.2020; of RGB or unknown; transfers refused.
_MATRICES, _UNSTATED = (1, 4, 5, 6, 7, 9), (0, 2, 3)
_NOT_SHOWN = {8: "linear", 9: "logarithmic", 10: "logarithmic", 17: "cinema (SMPTE 428)"}
_NO_VIEWS = dict.fromkeys([f"SPHERICAL {n}" for n in (0, 1, 2, 3, 5)], "is a panorama; export flat views of it")
_NO_VIEWS |= dict.fromkeys([f"STEREO3D {n}" for n in (1, 2, 4, 5, 6, 7)], "has two eyes in each frame; export one eye")
_DOLBY = ("dvh1", "dvhe", "dva1", "dvav")  # Without a stated transfer (profile 5) their colours are of no standard


def is_video(path: Path) -> bool:
    """Whether a path is a file with the suffix of a video."""
    return path.is_file() and path.suffix.lower() in SUFFIXES


def check_video(path: Path, warn: Warn = str) -> None:
    """Raise ``DataError`` if a video cannot be decoded, has too few frames, or colours that cannot be converted."""
    length, aspect, tracks = _facts(path)
    if (first := next(_frames(path), None)) is None:
        raise DataError(f"{path} has no frame that can be decoded; {_CONVERT}")
    if length < LEAST_PHOTOS:
        raise DataError(f"{path} has {length} frames, and camera poses need {LEAST_PHOTOS} or more; give a longer one")
    if tracks > 1:
        warn(f"{path} has {tracks} video tracks; that of {first.width} x {first.height} px is read")
    check_shape(path, image_of(first, path, aspect).size)


def write_frames(path: Path, folder: Path, count: int, advance: Callable[[int], None]) -> None:
    """Write the sharpest frame of each of ``count`` stretches of a video to a folder, which appears at the end."""
    length, aspect, _ = _facts(path)
    partial, written = folder.with_name(f"{folder.name}.partial"), 0
    with writing(f"cannot write {folder}"):
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        for written, frame in enumerate(_sharpest(path, count, max(length, 1)), start=1):
            image_of(frame, path, aspect).save(partial / f"{written:05d}.jpg", **JPEG)
            advance(1)
        if written < LEAST_PHOTOS:
            raise DataError(f"{path} ends after {written} frames that can be decoded; {_CONVERT}")
        partial.replace(folder)


def image_of(frame: Any, path: Path, aspect: float = 1.0) -> Image.Image:
    """A frame (``av.VideoFrame``) as an upright image in sRGB; ``DataError`` if it states colours not known here.

    Its own matrix and range count; without a matrix BT.709 from 1280 x 577 on and BT.601 below, as in players. A high
    dynamic range is rolled off, and the gamuts of BT.2020 and P3 are converted; what else is stated counts as BT.709.
    Pixels ``aspect`` times as wide as high become square.
    """
    matrix, transfer, primaries = int(frame.colorspace), int(frame.color_trc), int(frame.color_primaries)
    if matrix in _UNSTATED:
        matrix = 1 if frame.width >= 1280 or frame.height > 576 else 5
    if matrix not in _MATRICES or transfer in _NOT_SHOWN:
        what = f"{_NOT_SHOWN[transfer]} light" if transfer in _NOT_SHOWN else f"a colour matrix of number {matrix}"
        raise DataError(f"{path} has {what}, which is not read; convert it to BT.709, for example with HandBrake")
    is_wide = transfer in HIGH_RANGE or primaries in PRIMARIES
    size = round(frame.width * max(aspect, 1.0)), round(frame.height / min(aspect, 1.0))
    options = {"src_colorspace": matrix, "src_color_range": int(frame.color_range), "threads": 1}  # more may fail
    pixels = frame.reformat(*size, "rgb48le" if is_wide else "rgb24", **options).to_ndarray()
    pixels = to_srgb_values(pixels, transfer, primaries) if is_wide else pixels
    for data in frame.side_data:
        if (shape := f"{data.type.name} {next(iter(bytes(data)), '')}") in _NO_VIEWS:
            raise DataError(f"{path} {_NO_VIEWS[shape]}")
        if data.type.name == "DISPLAYMATRIX":  # of points (x, y) as rows, in 65536ths
            a, b, _, c, d = np.sign(np.round(np.frombuffer(bytes(data), np.int32)[:5] / 65536)).astype(int)
            if (a == 0) != (b == 0) and abs(a + c) == abs(b + d) == 1:  # a right angle
                pixels = (pixels.swapaxes(0, 1) if a == 0 else pixels)[:: b + d, :: a + c]
    return Image.fromarray(np.ascontiguousarray(pixels))


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, list[Any]]]:
    """The container and its videos, the one to read first."""
    with reading(path, "a video that FFmpeg decodes", remedy=_CONVERT, missing=_CONVERT):
        # Titles of old files are not in UTF-8.
        with av.open(str(regular(path).absolute()), options=_OPTIONS, metadata_errors="replace") as container:
            # Beside a video there may be a cover (disposition 1024) or a preview, often as JPEG.
            videos: Any = [v for v in container.streams.video if v.codec_context and v.disposition.value != 1024]
            videos.sort(key=lambda v: (v.name != "mjpeg", v.width * v.height), reverse=True)
            if not videos:
                raise DataError(f"{path} has no images that can be decoded; {_CONVERT}")
            if (coder := videos[0].codec_context).codec_tag in _DOLBY and coder.color_trc in _UNSTATED:
                raise DataError(f"{path} has colours of Dolby Vision alone, which are not read; convert it to BT.709")
            coder.thread_type = "AUTO"
            coder.options = {"max_pixels": str(1 << 27)}
            yield container, videos


def _frames(path: Path) -> Iterator[Any]:
    """The frames that can be decoded, deinterlaced."""
    graph: Any = None

    def filtered(frame: Any) -> Iterator[Any]:
        graph.push(frame)
        with suppress(BlockingIOError, EOFError):
            while True:
                yield graph.pull()

    with _opened(path) as (container, (video, *_)):
        for packet in container.demux(video):
            frames = []
            with suppress(av.error.InvalidDataError):  # the packet is damaged
                frames = [frame for frame in packet.decode() if not frame.is_corrupt]
            for frame in frames:
                if graph is None and frame.interlaced_frame:
                    graph = av.filter.Graph()
                    steps = graph.add_buffer(template=video), graph.add("bwdif", "send_frame:auto:interlaced")
                    graph.link_nodes(*steps, graph.add("buffersink")).configure()
                yield from [frame] if graph is None else filtered(frame)
        if graph is not None:
            yield from filtered(None)


def _facts(path: Path) -> tuple[int, float, int]:
    """Number of frames, which files state wrongly; width of a pixel as a share of its height; number of tracks."""
    with _opened(path) as (container, (video, *others)):
        aspect = float(video.sample_aspect_ratio or 1)
        length = sum(packet.size > 0 and not packet.is_discard for packet in container.demux(video))
    return length, aspect if 0.5 <= aspect <= 2 else 1.0, 1 + len(others)  # no format of videos uses other aspects


def _sharpest(path: Path, count: int, length: int) -> Iterator[Any]:
    """The sharpest of 12 frames of each of ``count`` equal stretches of a video of some length."""
    count = min(count, length)
    every = max(1, length // (count * 12))
    # A file may hold more frames than it states; they belong to the last stretch.
    stretches = groupby(enumerate(_frames(path)), lambda item: min(item[0] * count // length, count - 1))
    for _, frames in stretches:
        yield max(chain([next(frames)[1]], (frame for number, frame in frames if number % every == 0)), key=sharpness)


def sharpness(frame: Any) -> float:
    """Variance of the Laplacian of a frame's grey values, at a width of at most 960 pixels."""
    width = min(frame.width, 960)
    grey = frame.reformat(width, frame.height * width // frame.width or 1, "gray", interpolation="AREA", threads=1)
    return float(cv2.Laplacian(grey.to_ndarray(), cv2.CV_64F).var())
