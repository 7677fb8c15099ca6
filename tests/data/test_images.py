"""Images decoded to sRGB, against Pillow's ImageCms: profiles, types of pixels, colours that are stated otherwise."""

import struct
import zlib
from functools import partial

import cv2
import numpy as np
import pillow_heif
import pytest
import tifffile
from icc_profiles import SPACES, judged, profile
from limits import verdict
from photos import photo
from PIL import Image, ImageCms

from sundae_ns.data.images import (
    check_image,
    decoded,
    decoded_mask,
    exif_orientation,
    opened,
    reads_heif,
    to_srgb,
    to_srgb_values,
)
from sundae_ns.data.photos import photo_of, upright


def patches(width=192, height=128):
    """64 fields of colour."""
    levels = np.array([20, 90, 160, 235], np.uint8)
    fields = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1).reshape(8, 8, 3)
    return Image.fromarray(fields.repeat(height // 8, axis=0).repeat(width // 8, axis=1))


def off(image, expected):
    """The largest difference in the middle of the fields; JPEG and HEIC change what lies at their edges."""
    middles = np.abs(np.arange(192) % 24 - 11.5) < 4, np.abs(np.arange(128) % 16 - 7.5) < 4
    return int(np.abs(np.asarray(image.convert("RGB"), int) - expected)[middles[1]][:, middles[0]].max())


KINDS = {
    "a.png": {},
    "a.tif": {},
    "a.webp": {"lossless": True},
    "a.jpg": {"quality": 100, "subsampling": 0},
    "a.heic": {"quality": 100, "chroma": 444},
}


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("name", KINDS)
def test_a_profile_is_converted_as_imagecms_does(tmp_path, name, space):
    assert reads_heif()
    patches().save(tmp_path / name, icc_profile=profile(space), **KINDS[name])
    photo = photo_of(tmp_path / name)
    assert not photo.as_it_is
    with opened(photo.path) as stored:
        expected = judged(stored.convert("RGB"), space)
    assert off(patches(), expected) > 10
    assert off(Image.fromarray(expected.astype(np.uint8)), judged(patches(), space)) <= 8  # JPEG, HEIC
    for image in (decoded(photo.path), upright(photo)[0]):
        assert off(image, expected) <= 1


def test_ten_bits_of_heic(tmp_path):
    assert reads_heif()
    deep = (np.asarray(patches(), np.uint16) * 257).tobytes()
    file = pillow_heif.from_bytes(mode="RGB;16", size=(192, 128), data=deep)
    file.save(tmp_path / "a.heic", quality=100, chroma=444, icc_profile=profile("P3"))
    with opened(tmp_path / "a.heic") as image:
        assert image.info["bit_depth"] == 10
    assert off(decoded(tmp_path / "a.heic"), judged(patches(), "P3")) <= 3


@pytest.mark.parametrize(("transfer", "primaries", "changed"), [(13, 12, True), (16, 9, True), (13, 1, False)])
def test_colours_of_heic_without_a_profile(tmp_path, transfer, primaries, changed):
    image = patches()
    image.format = "HEIF"
    image.info["nclx_profile"] = {"transfer_characteristics": transfer, "color_primaries": primaries}
    converted = to_srgb(image)
    assert (off(converted, np.asarray(image, int)) > 10) == changed
    if (transfer, primaries) == (13, 12):  # sRGB's own curve, of which that of the profile is off by 8
        assert off(converted, judged(patches(), "P3")) <= 10


SAME = np.asarray(patches(), int)
DEEP = np.round(65535 * ((SAME / 255 + 0.055) / 1.055) ** 2.4).astype(np.uint16)  # in linear light
P3, ADOBE = (68000, 32000, 26500, 69000, 15000, 6000), (64000, 33000, 21000, 71000, 15000, 6000)
WIDE = {"gAMA": [100000], "cHRM": [31270, 32900, *P3]}
CODES, NARROW = SAME / 255, (SAME - 16.0).clip(0, 219) * 255 / 219
LINEAR = 255 * np.where(CODES <= 0.0031308, 12.92 * CODES, 1.055 * CODES ** (1 / 2.4) - 0.055)
ICC = {"iCCP": b"a\0\0" + zlib.compress(profile("Adobe RGB"))}
HDR = to_srgb_values(np.asarray(patches()), 16, 9).astype(int)
CHUNKS = {
    "P3": ({"cICP": bytes((12, 13, 0, 1))}, "P3", 10),  # sRGB's own curve, of which that of the profile is off by 8
    "cICP first": ({"cICP": bytes((1, 13, 0, 1)), **ICC, **WIDE}, None, 0),
    "a profile before gAMA": (ICC | WIDE, "Adobe RGB", 3),
    "sRGB before gAMA": ({"sRGB": b"\0", **WIDE}, None, 0),
    "gAMA and cHRM": ({"gAMA": [45470], "cHRM": [31270, 32900, *ADOBE]}, "Adobe RGB", 3),
    "gAMA and cHRM of P3": (WIDE | {"gAMA": [45455]}, "P3", 3),
    "those of sRGB": ({"gAMA": [45455], "cHRM": [31270, 32900, 64000, 33000, 30000, 60000, 15000, 6000]}, None, 0),
    "linear": ({"gAMA": [100000]}, LINEAR, 1),
    "linear of 16 bits": ({"gAMA": [100000]}, SAME, 0),
    "linear by cICP": ({"cICP": bytes((1, 8, 0, 1))}, LINEAR, 1),
    "PQ": ({"cICP": bytes((9, 16, 0, 1))}, HDR, 0),
    "no primaries": ({"cHRM": [0] * 8}, None, 0),
    "no gamma": ({"gAMA": [2_000_000_000]}, None, 0),
    "a short cICP": ({"cICP": b"\14"}, None, 0),
    "limited range": ({"cICP": bytes((1, 13, 0, 0))}, NARROW, 1),
}


@pytest.mark.parametrize(("chunks", "expected", "most"), CHUNKS.values(), ids=CHUNKS)
def test_colours_of_a_png_by_its_chunks(tmp_path, chunks, expected, most):
    patches().save(tmp_path / "a.png")
    assert expected is not SAME or cv2.imwrite(str(tmp_path / "a.png"), DEEP[..., ::-1])
    content, head = (tmp_path / "a.png").read_bytes(), b""
    for name, data in chunks.items():
        data = data if isinstance(data, bytes) else struct.pack(f">{len(data)}I", *data)
        body = name.encode() + data
        head += struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))
    (tmp_path / "a.png").write_bytes(content[:33] + head + content[33:])
    expected = judged(patches(), expected) if isinstance(expected, str) else expected
    assert photo_of(tmp_path / "a.png").as_it_is == (expected is None)
    assert off(decoded(tmp_path / "a.png"), SAME if expected is None else expected) <= most


def test_a_png_is_read_in_little_memory_whatever_its_chunks_state(tmp_path):
    patches().save(path := tmp_path / "a.png")
    content = path.read_bytes()
    path.write_bytes(content.replace(content[33:37], b"\x7f\xff\xff\xff", 1))  # of the pixels
    assert verdict(lambda: decoded(path), len(content)) is None


@pytest.mark.parametrize("stated", [{0xA001: 0xFFFF, 0xA005: {1: "R03"}}, {0xA001: 2}], ids=["R03", "2"])
def test_adobe_rgb_by_exif(tmp_path, stated):
    """Cameras state Adobe RGB by DCF's R03 or a number alone; the photo that is saved states it no more."""
    exif = Image.Exif()
    exif[0x8769] = stated
    patches().save(tmp_path / "a.jpg", exif=exif, quality=100, subsampling=0)
    photo = photo_of(tmp_path / "a.jpg")
    with Image.open(photo.path) as image:
        expected = judged(image, "Adobe RGB")
    pixels, stated = upright(photo)
    assert off(pixels, expected) <= 2
    pixels.save(tmp_path / "again.jpg", exif=stated, quality=100, subsampling=0)
    assert off(decoded(tmp_path / "again.jpg"), expected) <= 3


def grey12(path):
    """A TIFF, which Pillow does not write."""
    bits = np.round(GREY[..., :1] / 255 * 4095).astype(int) >> np.arange(11, -1, -1) & 1
    pixels = np.packbits(bits.astype(np.uint8)).tobytes()
    tags = {256: 192, 257: 128, 258: 12, 259: 1, 262: 1, 273: 110, 277: 1, 279: len(pixels)}
    table = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items())
    path.write_bytes(struct.pack("<2sHIH", b"II", 42, 8, len(tags)) + table.ljust(100, b"\0") + pixels)


def after_a_thumbnail(path):
    """A TIFF of two pages, as scanners and cameras write them."""
    tifffile.imwrite(path, SAME[::4, ::4].astype(np.uint8), photometric="rgb", subfiletype=1)
    tifffile.imwrite(path, SAME.astype(np.uint8), photometric="rgb", append=True)


def with_profile(mode, space):
    icc = space if isinstance(space, bytes) else profile(space)
    return lambda path: patches().convert(mode).save(path, icc_profile=icc)


def bitmap(path):
    """A BMP of version 5 with a profile behind its pixels, which Pillow does not write."""
    pixels, icc = SAME[::-1, :, ::-1].astype(np.uint8).tobytes(), profile("P3")
    head = struct.pack("<I2i2H6I4I", 124, 192, 128, 1, 24, 0, len(pixels), 0, 0, 0, 0, 255 << 16, 255 << 8, 255, 0)
    head += b"DEBM".ljust(52, b"\0") + struct.pack("<4I", 4, 124 + len(pixels), len(icc), 0)
    path.write_bytes(struct.pack("<2s3I", b"BM", 138 + len(pixels) + len(icc), 0, 138) + head + pixels + icc)


GREY = np.asarray(patches().convert("L").convert("RGB"), int)
PLANES, RED = 257 * SAME.transpose(2, 0, 1).astype(np.uint16), SAME[..., :1].repeat(3, axis=-1)
TYPES = {
    "16 bits": (lambda path: Image.fromarray(257 * GREY[..., 0].astype(np.uint16)).save(path), "L", GREY),
    "12 bits": (grey12, "L", GREY),
    "16 bits in planes": (partial(tifffile.imwrite, data=PLANES, planarconfig="separate"), "RGB", SAME),
    "white is 0": (partial(tifffile.imwrite, data=65535 - PLANES[0], photometric="miniswhite"), "L", RED),
    "a thumbnail first": (after_a_thumbnail, "RGB", SAME),
    "a palette": (lambda path: patches().quantize(64).save(path), "RGB", SAME),
    "grey and alpha": (lambda path: patches().convert("LA").save(path), "RGBA", GREY),
    "CMYK": (lambda path: patches().convert("CMYK").save(path, format="TIFF"), "RGB", SAME),
    "a grey profile": (with_profile("L", "grey"), "RGB", judged(patches().convert("L"), "grey")),
    "grey in P3": (with_profile("L", "ProPhoto"), "RGB", judged(Image.fromarray(GREY.astype(np.uint8)), "ProPhoto")),
    "alpha and a profile": (with_profile("RGBA", "P3"), "RGBA", judged(patches(), "P3")),
    "a profile of another kind": (with_profile("RGB", "grey"), "RGB", SAME),
    "a profile of BMP": (bitmap, "RGB", judged(patches(), "P3")),
    "a damaged profile": (with_profile("RGB", b"none"), "RGB", SAME),
}


@pytest.mark.parametrize(("make", "mode", "expected"), TYPES.values(), ids=TYPES)
def test_types_of_pixels(tmp_path, make, mode, expected):
    make(tmp_path / "a.png")
    image = decoded(tmp_path / "a.png")
    assert image.mode == mode
    assert off(image, expected) <= 1


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("name", ["a.png", "a.tif"])
def test_pixels_and_sizes_are_those_that_are_stored(tmp_path, name, orientation):
    """Pillow turns those of TIFF alone."""
    photo(tmp_path / name, image=patches(), orientation=orientation)
    assert (check_image(tmp_path / name), exif_orientation(tmp_path / name)) == ((192, 128), orientation)
    assert np.array_equal(decoded(tmp_path / name), SAME)
    found = photo_of(tmp_path / name)
    assert upright(found)[0].size == found.size == ((128, 192) if orientation > 4 else (192, 128))


@pytest.mark.parametrize(("name", "white"), [("a.jpg", 255), ("a.png", 1), ("a.png", 255)])
def test_masks_are_black_and_white(tmp_path, name, white):
    mask = np.zeros((40, 60), np.uint8)
    mask[9:27, 13:49] = white
    Image.fromarray(mask).save(tmp_path / name, quality=80)
    assert np.array_equal(decoded_mask(tmp_path / name), mask.astype(bool) * 255)


def test_srgb_stays_as_it_is(tmp_path):
    patches().save(tmp_path / "a.jpg", icc_profile=ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    assert photo_of(tmp_path / "a.jpg").as_it_is
