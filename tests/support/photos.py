"""Files of photos, of one colour, which their names give, unless an image is given."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

ORIENTATION, MODEL, FOCAL, EXIF = 0x0112, 0x0110, 0x920A, 0x8769


def photo(
    path: Path,
    kind: str | None = None,
    mode: str = "RGB",
    size: tuple[int, int] = (16, 12),
    *,
    image: Image.Image | None = None,
    orientation: int = 1,
    model: str = "",
    focal: float | None = None,
    panorama: bool = False,
) -> Path:
    """Write a photo with entries of EXIF, of the kind of its suffix by default; its folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    exif.update({ORIENTATION: orientation} | ({MODEL: model} if model else {}))
    if focal is not None:
        exif.get_ifd(EXIF)[FOCAL] = focal
    if panorama:
        exif.get_ifd(EXIF)[0xA401] = 6  # of Apple
    colour = (31 * sum(path.name.encode()) % 256, 128, 128) if mode == "RGB" else 0
    (image or Image.new(mode, size, colour)).save(path, format=kind, exif=exif.tobytes())
    return path


def photos(folder: Path, count: int = 3, size: tuple[int, int] = (20, 16)) -> list[str]:
    """Write photos ``0.png``, ``1.png`` and so on; their names."""
    return [photo(folder / f"{index}.png", size=size).name for index in range(count)]
