"""Image files: judged by their headers, decoded to sRGB with 8 bits a channel, and turned upright.

Colours of a high dynamic range (Rec. ITU-R BT.2100) or a wide gamut go by the numbers of ITU-T H.273.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache, lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageChops, ImageCms, ImageOps, TiffImagePlugin

from sundae_ns.core.errors import DataError, reading, regular
from sundae_ns.data.capture import beside

HEIF = (".heic", ".heif", ".hif")  # for which Pillow needs the package pillow-heif
TURNED = (5, 6, 7, 8)  # EXIF orientations that swap width and height
JPEG: dict[str, Any] = {"quality": 97, "subsampling": 0}
REPAIR = "repair it, save it as JPEG or PNG of 8 bits, or remove it"
_TURN = "orientation of a TIFF"
# Pillow's types of pixels that are read, and those in which their colours are converted.
_MODES = {"CMYK": "CMYK", **dict.fromkeys(("1", "L", "LA", "I;16", "I;16B", "I;16L"), "L")}
_MODES |= dict.fromkeys(("P", "PA", "RGB", "RGBA", "YCbCr"), "RGB")
HIGH_RANGE = PQ, HLG = 16, 18  # transfers
# Chromaticities of red, green and blue beside a white of D65, to which Bradford's matrix adapts that of DCI-P3 (11).
_SRGB = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06)
PRIMARIES = {9: (0.708, 0.292, 0.170, 0.797, 0.131, 0.046), 12: (0.680, 0.320, 0.265, 0.690, 0.150, 0.060)}
PRIMARIES[11] = (0.6807, 0.3189, 0.2812, 0.6742, 0.1488, 0.0577)
_ADOBE = 563 / 256, (0.64, 0.33, 0.21, 0.71, 0.15, 0.06)  # Adobe RGB (1998), an exponent and primaries
_WHITE = 203.0  # cd/m2, of a white sheet (Report ITU-R BT.2408); HLG is for a display of 1,000
_KNEE = 0.46  # share of white from which a high range is rolled off
TiffImagePlugin.READ_LIBTIFF = True  # else Pillow takes planes of 16 bits without compression for 8 bits


def check_image(path: Path, *, mask: bool = False) -> tuple[int, int]:
    """Width and height in pixels of an image or a mask, by its header; ``DataError`` if training cannot use it."""
    if not path.exists():
        raise DataError(f"{path} does not exist{beside(path)}; correct the path or remove the view")
    with reading(path, "a complete image", remedy=REPAIR, missing=REPAIR), opened(path) as image:
        size, mode = image.size, "EPS" if image.format == "EPS" else image.mode  # Pillow would run Ghostscript on it
    if mode not in (("1", "L") if mask else _MODES):
        wanted = "one channel of 8 bits" if mask else "RGB, RGBA or grey with 8 bits per channel"
        raise DataError(f"{path} has pixels of type {mode}; save it with {wanted}")
    # No format stores 4,096 pixels in a byte, even of one flat colour.
    if size[0] * size[1] > max(4096 * (length := path.stat().st_size), 1 << 20):
        raise DataError(f"{path} claims {size[0]} x {size[1]} px in {length:,} bytes; it is incomplete, save it again")
    return size


def opened(path: Path) -> Image.Image:
    """An image whose header is read; that of a PNG with ``info["cicp"]``, which Pillow passes over."""
    if path.suffix.lower() in HEIF:
        reads_heif()
    image: Any = Image.open(regular(path))
    if image.format == "PNG":
        image.close()
        content = path.read_bytes()  # of a file, Pillow asks for as many bytes as a chunk states
        image = Image.open(BytesIO(content))
        if content[24] == 16:  # the bit depth, which Pillow reduces to 8
            image.info["deep"] = content
        if (at := content.find(b"\0\0\0\4cICP", 0, max(content.find(b"IDAT"), 0))) >= 0:
            image.info["cicp"] = content[at + 8 : at + 12]
    elif "progressive" in image.info and (scans := path.read_bytes().count(b"\xff\xda")) > 200:  # each takes its time
        raise ValueError(f"it has {scans:,} scans")
    elif image.format == "TIFF":
        with suppress(EOFError):
            while image.tag_v2.get(254, 0) & 1 and image.tell() < 8:  # a thumbnail in front of the photo
                image.seek(image.tell() + 1)
        image.info[_TURN] = image.getexif().pop(ExifTags.Base.Orientation, 1)  # else Pillow turns it as it is loaded
        image._size = getattr(image, "_tile_size", image.size)
    elif image.format == "BMP" and bytes((mapped := np.memmap(path, mode="r"))[70:74]) == b"DEBM":
        start, size = mapped[126:134].view("<u4").tolist()  # of a profile behind the pixels, which are not read for it
        image.info["icc_profile"] = mapped[14 + start :][:size].tobytes()
    return image  # type: ignore[no-any-return]


@cache
def reads_heif() -> bool:
    """Whether pillow-heif is installed; then Pillow reads HEIC from now on."""
    with suppress(ImportError):
        importlib.import_module("pillow_heif").register_heif_opener()
        return True
    return False


def decoded(path: Path) -> Image.Image:
    """The pixels of an image as :func:`to_srgb` gives them; ``DataError`` if they are broken."""
    with reading(path, "an image that can be decoded", remedy=REPAIR, missing=REPAIR), opened(path) as image:
        image.load()
        return to_srgb(image)


def decoded_mask(path: Path) -> Image.Image:
    """A mask of type L whose pixels are 0 or 255, by half of the largest, as JPEG has no clear black."""
    with reading(path, "a mask that can be decoded", remedy=REPAIR, missing=REPAIR), opened(path) as image:
        grey = np.asarray(image.convert("L"))
    return Image.fromarray((grey > grey.max() / 2) * np.uint8(255))


def to_srgb(image: Image.Image) -> Image.Image:
    """An image of type L, RGB or RGBA in sRGB, by its ICC profile or what else states another colour space.

    As in browsers, a profile that is damaged or of another kind of pixels counts for nothing.
    """
    if image.mode not in _MODES:
        raise DataError(f"an image has pixels of type {image.mode}; convert it to RGB")
    if is_srgb(image):
        return image
    convert = _conversion(image) or (lambda same: same)
    base = image
    alpha = image.convert("RGBA").getchannel("A") if image.has_transparency_data else None
    if image.mode.startswith("I;16"):
        tags = getattr(image, "tag_v2", {})  # of a TIFF: its bits, which may be 12, and 0 if white is 0
        share = np.asarray(image) / (2.0 ** tags.get(258, [16])[0] - 1)
        base = Image.fromarray(np.round(255 * np.abs((tags.get(262) == 0) - share)).astype(np.uint8))
    base = convert(base.convert(_MODES[image.mode]))
    if alpha is not None:
        base = base.convert("RGB")
        base.putalpha(alpha)
    return base.convert("RGB") if base.mode == "CMYK" else base


def is_srgb(image: Image.Image) -> bool:
    """Whether the pixels are of type L, RGB or RGBA, and in sRGB."""
    return image.mode in ("L", "RGB", "RGBA") and "transparency" not in image.info and _conversion(image) is None


def _conversion(image: Image.Image) -> Callable[[Image.Image], Any] | None:
    """A function to sRGB, by what an image states, in the order of the PNG specification; None for those of sRGB."""
    if (cicp := image.info.get("cicp")) is None and (profile := image.info.get("icc_profile")) is not None:
        transform = _transform(profile, _MODES[image.mode])
        return transform and (lambda base: ImageCms.applyTransform(base.convert(transform.input_mode), transform))
    stated: tuple[float, Any] = 0, 0
    with suppress(Exception):  # a damaged entry is none
        if cicp is not None:
            stated = cicp[1], cicp[0]
        elif image.format == "PNG" and "srgb" not in image.info:
            gamma, xy = image.info.get("gamma", 1 / 2.2), tuple(image.info.get("chromaticity", (0, 0, *_SRGB))[2:])
            if 0.1 < gamma < 10 and np.abs(np.subtract((gamma, *xy), (1 / 2.2, *_SRGB))).max() > 0.005:
                _to_xyz(xy)  # raises for those of no colour space
                stated = 1 / gamma, xy
        elif "nclx_profile" in image.info:
            nclx = image.info["nclx_profile"]
            stated = int(nclx["transfer_characteristics"]), int(nclx["color_primaries"])
        elif image.format in ("JPEG", "MPO", "TIFF"):
            interop, inner = (image.getexif().get_ifd(kind) for kind in (ExifTags.IFD.Interop, ExifTags.IFD.Exif))
            stated = _ADOBE if interop.get(1) == "R03" or inner.get(ExifTags.Base.ColorSpace) == 2 else stated
    narrow = cicp is not None and cicp[3:] == b"\0"
    if stated[0] not in _LIGHT and stated[1] not in PRIMARIES and not isinstance(stated[0], float) and not narrow:
        return None

    def convert(base: Image.Image) -> Image.Image:
        if "deep" not in image.info:
            values = np.asarray(base.convert("RGB"))
        else:
            cv2: Any = importlib.import_module("cv2")  # takes 0.1 s
            flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
            values = cv2.imdecode(np.frombuffer(image.info["deep"], np.uint8), flags)[..., ::-1]
        return Image.fromarray(to_srgb_values(values, *stated, narrow=narrow))

    return convert


@lru_cache(maxsize=16)
def _transform(profile: bytes, mode: str) -> Any:
    """The transform from an ICC profile to sRGB; None if it changes no value by more than 1, or cannot be used."""
    try:
        stated = ImageCms.ImageCmsProfile(BytesIO(profile))
        source = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK"}[stated.profile.xcolor_space.strip()]
        transform = ImageCms.buildTransform(stated, ImageCms.createProfile("sRGB"), source, "RGB")
    except (KeyError, OSError, ImageCms.PyCMSError):
        return None
    levels = (np.indices((6, 6, 6)) * 51).reshape(3, 36, 6).transpose(1, 2, 0).astype(np.uint8)
    sample = Image.fromarray(levels).convert(mode)
    converted: Any = ImageCms.applyTransform(sample.convert(source), transform)
    change = np.asarray(ImageChops.difference(converted, sample.convert("RGB"))).max()
    return transform if change > 1 and (source == mode or (mode, source) == ("L", "RGB")) else None


def to_srgb_values(values: NDArray[Any], transfer: float, primaries: Any, *, narrow: bool = False) -> NDArray[np.uint8]:
    """sRGB ``[H, W, 3]`` of code values, by a number and a number, or by an exponent (float) and chromaticities.

    ``narrow`` values reach from 16 to 235 of 256. Unknown primaries count as BT.2020 in a high range, else as sRGB's.
    """
    codes = np.linspace(0, 1, count := np.iinfo(values.dtype).max + 1)
    codes = ((codes * (count - 1) * 256 / count - 16) / 219).clip(0, 1) if narrow else codes
    light = np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
    light = codes**transfer if isinstance(transfer, float) else _LIGHT[transfer](codes) if transfer in _LIGHT else light
    light = light.astype(np.float32)[values]
    if not isinstance(primaries, tuple):
        primaries = PRIMARIES.get(primaries, PRIMARIES[9] if transfer in HIGH_RANGE else _SRGB)
    if transfer == HLG:
        light *= 1000 / _WHITE * (light @ np.array([0.2627, 0.6780, 0.0593], np.float32))[..., None] ** np.float32(0.2)
    light = light @ np.linalg.solve(_to_xyz(_SRGB), _to_xyz(primaries)).T.astype(np.float32)
    if transfer in HIGH_RANGE:
        brightest = light.max(axis=-1, keepdims=True).clip(1e-6)
        rolled = 1 - (1 - _KNEE) * np.exp((_KNEE - brightest) / (1 - _KNEE))
        light *= np.where(brightest > _KNEE, rolled / brightest, 1)
    light = light.clip(0, 1)
    code = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** np.float32(1 / 2.4) - 0.055)
    return np.round(255 * code).astype(np.uint8)


def _to_xyz(xy: tuple[float, ...]) -> NDArray[np.float64]:
    """Matrix ``[3, 3]`` from light of these primaries, whose white is D65, to CIE XYZ."""
    columns = np.array([xy[::2], xy[1::2], [1 - x - y for x, y in zip(xy[::2], xy[1::2], strict=True)]], np.float64)
    return columns * np.linalg.solve(columns, np.array([0.3127, 0.3290, 0.3583]) / 0.3290)


def _pq(code: NDArray[np.float64]) -> NDArray[np.float64]:
    power = code ** (32 / 2523)
    return 10000 / _WHITE * ((power - 0.8359375).clip(0) / (18.8515625 - 18.6875 * power)) ** (8192 / 1305)


# Light of code values; that of HLG is of the scene.
_LIGHT: dict[float, Callable[[NDArray[np.float64]], NDArray[np.float64]]] = {
    **{4: lambda code: code**2.2, 5: lambda code: code**2.8, 8: lambda code: code, PQ: _pq},
    HLG: lambda code: np.where(code <= 0.5, code**2 / 3, (np.exp((code - 0.55991073) / 0.17883277) + 0.28466892) / 12),
}


def exif_orientation(path: Path) -> int:
    """EXIF orientation of an image, from 1 (as stored) to 8; 1 if it states none."""
    with suppress(Exception), opened(path) as image:  # decoders raise many kinds; a damaged entry is none
        return orientation_in(image) if image.format != "PNG" or "exif" in image.info else 1  # which decodes the pixels
    return 1


def orientation_in(image: Image.Image) -> int:
    """As :func:`exif_orientation`, of an image."""
    stated = image.info.get(_TURN) or image.getexif().get(ExifTags.Base.Orientation, 1)
    return stated if stated in range(1, 9) else 1


def turned(image: Image.Image, orientation: int) -> Image.Image:
    """Stored pixels upright by their EXIF orientation."""
    if orientation == 1:
        return image
    image = image.copy()
    image.info.pop(_TURN, None)
    image.getexif()[ExifTags.Base.Orientation] = orientation
    return ImageOps.exif_transpose(image)


def wrong_size(path: Path, size: Sequence[int], expected: Sequence[int], orientation: int) -> DataError:
    """The error for an image whose size is not that of its camera."""
    remedy = "give each size its own camera, or resize the images"
    if orientation in TURNED:
        remedy = "it is also turned by its EXIF entry: turn its pixels and remove the entry"
    elif max(abs(a - b) for a, b in zip(size, expected, strict=True)) <= 1:
        remedy = "give colmap --downscale-rounding-mode round (or ceil), or make the smaller images again"
    stated = f"{size[0]} x {size[1]} px but its camera says {expected[0]} x {expected[1]}"
    return DataError(f"{path.name} is {stated}; {remedy}")
