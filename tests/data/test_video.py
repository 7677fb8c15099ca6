"""Frames of videos: the sharpest of each stretch, in the colours that the file states, or one line on why not."""

import os
import struct
from fractions import Fraction
from unittest.mock import Mock

import av
import numpy as np
import pytest
from icc_profiles import judged
from limits import refused
from PIL import Image
from run_commands import write_video

from sundae_ns.data.video import _facts, check_video, image_of, is_video, write_frames

PATCHES = [(200, 30, 40), (30, 190, 60), (20, 40, 220), (240, 240, 240), (128, 128, 128), (250, 220, 20)]


def patches(width=192, height=64):
    """Six fields of colour ``[H, W, 3]``, the upper half darker."""
    image = np.repeat(np.array(PATCHES, np.uint8)[None], height, axis=0).repeat(width // 6, axis=1)
    image[: height // 2] //= 2
    return image


def write_colours(path, images, matrix=2, full=False, *, pixels="yuv420p", codec="libx264", turn=None, **marks):
    """Write a video of images, which are converted and marked by a matrix, a range and a transfer."""
    with av.open(str(path), "w", options=marks.get("options", {})) as container:
        container.metadata["title"] = marks.get("title", "")
        video = container.add_stream(codec, rate=10)
        video.height, video.width = images[0].shape[:2]
        video.pix_fmt = pixels
        video.options = {"crf": "1", "x265-params": "log-level=0:crf=1", "x264-params": marks.get("x264", "")}
        coder = video.codec_context
        coder.colorspace, coder.color_range, coder.color_trc = matrix, 1 + full, marks.get("transfer", 2)
        coder.color_primaries = marks.get("primaries", 2)
        coder.flags |= marks.get("flags", 0)
        coder.sample_aspect_ratio = marks.get("aspect", 1)
        coder.codec_tag = marks.get("tag") or coder.codec_tag
        if turn is not None:
            video.set_display_rotation(turn[0], hflip=turn[1])
        options = {"dst_colorspace": matrix if matrix in (1, 5, 9) else 5, "dst_color_range": 1 + full}
        for index, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format="rgb48le" if image.dtype == np.uint16 else "rgb24")
            frame = frame.reformat(format=pixels, **options)
            frame.pts = index
            container.mux(video.encode(frame))
        container.mux(video.encode())


def frames_from(video, count=99, advance=lambda _: None):
    """The frames that are written of a video, each ``[H, W, 3]``."""
    check_video(video)
    write_frames(video, video.with_suffix(""), count, advance)
    return [np.asarray(Image.open(path), float) for path in sorted(video.with_suffix("").iterdir())]


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize(
    ("matrix", "pixels"), [(1, "yuv420p"), (5, "yuv422p"), (6, "yuv420p"), (9, "yuv420p10le"), (9, "yuv444p")]
)
def test_colours_are_those_of_the_matrix_and_the_range(tmp_path, matrix, pixels, full):
    path = tmp_path / "a.mkv"
    write_colours(path, 5 * [patches()], matrix, full, pixels=pixels)
    with av.open(str(path)) as container:
        frame = next(container.decode(video=0))
        judge = frame.reformat(format="rgb24", src_colorspace=matrix, src_color_range=1 + full).to_ndarray()
    assert np.abs(np.asarray(image_of(frame, path), float) - judge).max() <= 1
    inner = np.abs(np.arange(192) % 32 - 15.5) < 8  # away from edges, where 4:2:0 and JPEG make colours of their own
    for written in frames_from(path):
        for original in (judge, patches()):
            assert np.abs(written - original)[8:24, inner].max() <= (3 if original is judge else 4)


@pytest.mark.parametrize(("size", "matrix"), [((192, 64), 5), ((1280, 64), 1), ((96, 578), 1), ((96, 576), 5)])
def test_an_unstated_matrix_goes_by_the_size(tmp_path, size, matrix):
    image = np.full((size[1], size[0], 3), (200, 30, 40), np.uint8)
    frame = av.VideoFrame.from_ndarray(image, format="rgb24")
    frame = frame.reformat(format="yuv444p", dst_colorspace=matrix, dst_color_range=1)
    frame.colorspace = 2
    assert np.abs(np.asarray(image_of(frame, tmp_path), int) - image).max() <= 2


GREY = np.array([0, 0.1, 0.2, 0.38, 0.5, 0.75, 0.9, 1])


@pytest.mark.parametrize(
    ("transfer", "expected"), [(18, [0, 16, 46, 101, 137, 231, 254, 255]), (16, [0, 5, 29, 101, 180, 254, 255, 255])]
)
def test_a_high_dynamic_range_is_rolled_off(tmp_path, transfer, expected):
    """Greys up to 93 cd/m2 are those of sRGB with 203 cd/m2 as white; BT.2020's red is out of sRGB."""
    image = np.zeros((64, 160, 3), np.uint16)
    image[:, :128] = np.repeat(np.round(65535 * GREY), 16)[None, :, None]
    image[:, 128:] = 65535 * np.array([0.5, 0.2, 0.2])
    write_colours(tmp_path / "a.mp4", 5 * [image], 9, pixels="yuv444p10le", codec="libx265", transfer=transfer)
    (frame, *_) = frames_from(tmp_path / "a.mp4")
    assert np.abs(frame[32, 8:128:16] - np.array(expected)[:, None]).max() <= 3
    red = frame[32, 144]
    assert max(red[1:]) < expected[2] + 8 < expected[4] < red[0]


@pytest.mark.parametrize(("primaries", "space"), [(11, "DCI"), (12, "P3")])
def test_the_gamut_of_p3_is_converted(tmp_path, primaries, space):
    write_colours(tmp_path / "a.mkv", 5 * [patches()], 1, pixels="yuv444p", primaries=primaries)
    (frame, *_) = frames_from(tmp_path / "a.mkv")
    # The curve of the profile is not sRGB's: off by up to 9. Without a conversion it is 36.
    assert np.abs(frame - judged(Image.fromarray(patches()), space))[40:56, 8::16].max() <= 12


@pytest.mark.parametrize(("degrees", "flip"), [(d, f) for d in (0, 90, 180, -90) for f in (False, True)])
def test_frames_are_upright(tmp_path, degrees, flip):
    write_colours(tmp_path / "a.mp4", 5 * [patches()], 1, pixels="yuv444p", turn=(degrees, flip))
    stored = Image.fromarray(patches()).rotate(degrees, expand=True)
    upright = stored.transpose(Image.Transpose.FLIP_LEFT_RIGHT) if flip else stored
    (frame, *_) = frames_from(tmp_path / "a.mp4")
    assert frame.shape == np.asarray(upright).shape
    assert np.median(np.abs(frame - np.asarray(upright))) <= 3


@pytest.mark.parametrize(("aspect", "size"), [("4/3", (256, 64)), ("1/2", (192, 128)), ("9", (192, 64))])
def test_pixels_become_square(tmp_path, aspect, size):
    write_colours(tmp_path / "a.mkv", 5 * [patches()], 5, aspect=Fraction(aspect))
    (frame, *_) = frames_from(tmp_path / "a.mkv")
    assert frame.shape[1::-1] == size
    assert np.abs(frame[3 * size[1] // 4, size[0] // 12 :: size[0] // 6] - PATCHES).max() <= 4


def test_interlaced_frames_have_no_comb(tmp_path):
    """Fields of 1/20 s apart: a bar moves by 24 pixels between the lines of one and of the other."""
    path, images = tmp_path / "a.mkv", [np.full((64, 288, 3), 40, np.uint8) for _ in range(5)]
    for index, image in enumerate(images):
        for field in (0, 1):
            image[field::2, 48 * index + 24 * field :][:, :24] = 220
    write_colours(path, images, 5, flags=1 << 18 | 1 << 29)
    frames = frames_from(path)
    assert len(frames) == 5
    for frame, image in zip(frames[1:-1], images[1:-1]):
        comb, left = (np.abs(np.diff(each[8:-8, :, 1].astype(float), axis=0)).mean() for each in (image, frame))
        assert left < 0.1 * comb


def test_the_sharpest_frame_of_each_stretch(tmp_path):
    write_video(tmp_path / "A WALK.MP4", 60)
    (tmp_path / "folder.mp4").mkdir()
    assert [is_video(tmp_path / name) for name in ("A WALK.MP4", "folder.mp4")] == [True, False]
    done = []
    found = frames_from(tmp_path / "A WALK.MP4", 20, done.append)
    assert len(found) == sum(done) == 20
    # Every third frame is sharp, and a stretch has three. The square moves by three pixels from one to the next.
    left = [int((frame[20, :, 1] > 120).argmax()) for frame in found]
    assert left[:13] == [1 + 3 * number for number in range(13)]


@pytest.mark.parametrize("name", ["a.mkv", "a.mts", "a.ts", "a.flv", "\udcff.mp4", "parts.mp4", "cut.mp4"])
def test_frames_are_counted_where_no_length_is_stated_or_that_of_a_part(tmp_path, name):
    parts = {"movflags": "frag_keyframe+default_base_moof"} if name == "parts.mp4" else {}
    write_colours(tmp_path / name, 5 * [patches()], 1, options=parts, x264="keyint=2")
    if name == "cut.mp4":  # by an edit list, as phones cut: 0.5 s of 0.9 s, where a frame takes 1,024 units
        write_colours(tmp_path / name, 9 * [patches()], 1, x264="bframes=0")
        content = bytearray((tmp_path / name).read_bytes())
        struct.pack_into(">Ii", content, content.index(b"elst") + 12, 500, 4 * 1024)
        (tmp_path / name).write_bytes(content)
    assert _facts(tmp_path / name) == (5, 1, 1)
    assert len(frames_from(tmp_path / name)) == 5


def test_the_largest_of_several_videos_is_read(tmp_path):
    path, heard = tmp_path / "a.mkv", []
    with av.open(str(path), "w") as container:
        for codec, pixels, side in (("mjpeg", "yuvj420p", 256), ("h264", "yuv420p", 32), ("h264", "yuv420p", 128)):
            video = container.add_stream(codec, rate=10)
            video.pix_fmt, video.width, video.height = pixels, side, side
        for pts in range(5):
            for video in container.streams.video:
                grey = np.full((video.height, video.width, 3), 100 + video.index * 50, np.uint8)
                frame = av.VideoFrame.from_ndarray(grey, format="rgb24").reformat(format=video.pix_fmt)
                frame.pts = pts
                container.mux(video.encode(frame))
        for video in container.streams.video:
            container.mux(video.encode())
    check_video(path, heard.append)
    assert heard == [f"{path} has 3 video tracks; that of 128 x 128 px is read"]
    assert all(frame.shape == (128, 128, 3) and abs(frame.mean() - 200) < 3 for frame in frames_from(path))


def test_frames_with_missing_parts_are_left_out(tmp_path):
    path = tmp_path / "a.avi"
    noise = np.random.default_rng(0).integers(0, 256, (64, 192, 3), np.uint8)
    write_colours(path, [np.roll(noise, 9 * i, axis=1) for i in range(12)], codec="mpeg4")
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2] + bytes(60) + content[len(content) // 2 + 60 :])
    with av.open(str(path)) as container:
        whole = [not frame.is_corrupt for frame in container.decode(video=0)]
    assert len(frames_from(path)) == sum(whole) < len(whole)


def test_all_frames_of_a_short_video_are_there_only_once_they_are_whole(tmp_path):
    write_video(tmp_path / "a.mp4", 7)
    with pytest.raises(KeyboardInterrupt):
        frames_from(tmp_path / "a.mp4", 150, Mock(side_effect=KeyboardInterrupt))
    assert not (tmp_path / "a").exists()
    frames_from(tmp_path / "a.mp4", 150)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "a.mp4"]
    assert [path.name for path in sorted((tmp_path / "a").iterdir())] == [f"{i:05d}.jpg" for i in range(1, 8)]


def sound(path):
    with av.open(str(path), "w") as container:
        track = container.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 44100
        container.mux(track.encode(frame))
        container.mux(track.encode())


def replaced(old, new, **options):
    """Other bytes in a video whose title is ``a title``."""

    def make(path):
        write_colours(path, 5 * [patches()], 1, pixels="yuv444p", title="a title", **options)
        content = path.read_bytes()
        assert content.count(old)
        path.write_bytes(content.replace(old, new))

    return make


TURN, NONE = (struct.pack(">5i", -65536, 0, 0, 0, last) for last in (-65536, 0))
DAMAGED = {f"a title in Latin-1{suffix}": replaced(b"a title", b"\xe4 title") for suffix in (".mp4", ".mkv", ".avi")}
DAMAGED |= {"a turn of nothing.mp4": replaced(TURN, NONE, turn=(180, False))}


@pytest.mark.parametrize("name", DAMAGED)
def test_damage_beside_the_frames_costs_none(tmp_path, name):
    DAMAGED[name](tmp_path / name)
    assert len(frames_from(tmp_path / name)) == 5


def playlist(text):
    """A text that names a video beside it."""

    def make(path):
        write_video(path.with_name("other.mp4"), 9)
        path.write_text(text.format(path.with_name("other.mp4")))

    return make


def panorama(path):
    """An .mp4 whose track states a sphere, as cameras of 360 degrees write it (Google's Spherical Video V1)."""
    write_colours(path, 5 * [patches()], 1)
    content, stated = bytearray(path.read_bytes()), {"SphericalVideo": "", "Spherical": "true", "Stitched": "true"}
    stated |= {"StitchingSoftware": "x", "ProjectionType": "equirectangular"}
    text = "".join(f"<GSpherical:{name}>{word}</GSpherical:{name}>" for name, word in stated.items()).encode()
    box = struct.pack(">I4s", 24 + len(text), b"uuid") + bytes.fromhex("ffcc8263f8554a938814587a02521fdd") + text
    for name in (b"moov", b"trak"):
        start = content.index(name) - 4
        end = start + struct.unpack_from(">I", content, start)[0]
        struct.pack_into(">I", content, start, end - start + len(box))
    path.write_bytes(content[:end] + box + content[end:])


UNREADABLE = "is not a video that FFmpeg decodes .*; convert it to .mp4"
REFUSED = {
    "text": (lambda path: path.write_text("not a video"), UNREADABLE),
    "a pipe": (os.mkfifo, "it is a pipe or a device"),
    "sound": (sound, "has no images"),
    "an unknown codec": (replaced(b"avc1", b"zzzz"), "has no images that can be decoded; convert it"),
    "two frames": (lambda path: write_video(path, 2), "has 2 frames, and camera poses need 3 or more"),
    "narrow": (lambda path: write_video(path, 5, (4000, 16)), "is 4000 x 16 px, too narrow for camera poses"),
    "HLS": (playlist("#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nfile://{}\n#EXT-X-ENDLIST\n"), UNREADABLE),
    "a panorama": (panorama, "is a panorama; export flat views"),
    "two eyes": (lambda path: write_colours(path, 5 * [patches()], x264="frame-packing=3"), "has two eyes in each"),
    "linear light": (lambda path: write_colours(path, 5 * [patches()], 1, transfer=8), "has linear light"),
    "Dolby Vision 5": (
        lambda path: write_colours(path, 5 * [patches()], pixels="yuv420p10le", codec="libx265", tag="dvh1"),
        "has colours of Dolby Vision alone, .*to BT.709",
    ),
    "YCgCo": (lambda path: write_colours(path, 5 * [patches()], 8), "has a colour matrix of number 8, .*to BT.709"),
}


@pytest.mark.parametrize(("make", "cause"), REFUSED.values(), ids=REFUSED)
def test_what_is_no_video(tmp_path, make, cause):
    make(tmp_path / "x.mp4")
    refused(check_video, tmp_path / "x.mp4", cause)
