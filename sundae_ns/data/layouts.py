"""Captures in COLMAP's and Blender's layouts: what a folder holds, and the words of ns-train that read it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sundae_ns.data.beside import beside, entries
from sundae_ns.data.capture import check_image, read_json
from sundae_ns.data.colmap import images_of, num_images
from sundae_ns.errors import DataError

_MODELS = ("sparse", "colmap/sparse", "dense/sparse", "dense", "distorted/sparse", "sparse/aligned")
"""Where programs put COLMAP's models, which may lie in numbered folders there."""
_FILES = ("cameras.bin", "cameras.txt")
_IMAGES = ("images", "input", "photos", "image", "rgb")
"""Usual names of the folder of images; COLMAP's programs use the first."""
_BLENDER = "transforms_{}.json"
"""Name of the file of a split (train, val, test) in Blender's layout."""
LONGEST_SIDE = 1600
"""Longest side in pixels that images are trained at where smaller ones are there, as nerfstudio does."""


@dataclass(frozen=True)
class ColmapLayout:
    """The largest model of a capture, with its images."""

    model: str
    """Folder of the model, relative to the capture."""
    images: str
    """Folder of the images, relative to the capture."""
    num_images: int
    num_models: int
    size: tuple[int, int]
    """Width and height of the first image, pixels."""
    downscale: int
    """Scale of the images to train on: those of ``images_4`` for 4."""
    options: tuple[str, ...] = ()
    """Words of ``ns-train`` before all other options, which can replace them."""

    @property
    def words(self) -> list[str]:
        """The words of ``ns-train`` that read the capture, behind all other options."""
        words = ["colmap", "--colmap-path", self.model]
        if self.images != "images":
            words += ["--images-path", self.images]
        return [*words, "--downscale-factor", str(self.downscale)]

    def __str__(self) -> str:
        several = f", the largest of {self.num_models} models" if self.num_models > 1 else ""
        smaller = f", at 1/{self.downscale} of their size" if self.downscale > 1 else ""
        return f"{self.num_images:,} images in {self.images}{smaller}, poses of {self.model}{several}"


@dataclass(frozen=True)
class BlenderLayout:
    """A capture of rendered images, with a file of cameras for each split."""

    num_images: int
    """Of training."""
    size: tuple[int, int]
    """Width and height of the first image, pixels."""
    downscale: int = 1
    options: tuple[str, ...] = ("--pipeline.model.background-color", "white")
    """nerfstudio puts transparent images over white."""

    @property
    def words(self) -> list[str]:
        """The words of ``ns-train`` that read the capture, behind all other options."""
        return ["blender-data"]

    def __str__(self) -> str:
        return f"{self.num_images:,} training images, over white"


def is_posed(data: Path) -> bool:
    """Whether a folder has a ``transforms.json``, a COLMAP model in one of the usual places, or Blender's files."""
    return (data / "transforms.json").is_file() or bool(model_folders(data)) or is_blender(data)


def is_blender(data: Path) -> bool:
    """Whether a folder has the training cameras of Blender's layout."""
    return (data / _BLENDER.format("train")).is_file()


def posed_layout(data: Path) -> ColmapLayout | BlenderLayout | None:
    """The largest COLMAP model of a capture, or else its files of Blender; None if it has a ``transforms.json``.

    Raises:
        DataError: a file is damaged or missing, or the images are in none of the usual places.
    """
    if (data / "transforms.json").is_file():
        return None
    if not model_folders(data):
        return _blender_layout(data) if is_blender(data) else None
    found = models_in(data)
    return layout_of(data, max(found, key=found.__getitem__), len(found))


def layout_of(data: Path, model: str, num_models: int = 1) -> ColmapLayout:
    """The layout of a capture with one of its :func:`models_in`; ``DataError`` as for :func:`posed_layout`."""
    try:
        names = [image.name for image in images_of(data / model)]
    except DataError as error:
        raise DataError(f"{data / model}: {error}") from error
    folder = _folder_of(data, model, names[0])
    size = check_image(data / folder / names[0])
    return ColmapLayout(model, folder, len(names), num_models, size, _downscale(data / folder, names[0], size))


def _blender_layout(data: Path) -> BlenderLayout:
    for split in ("train", "val", "test"):
        path = data / _BLENDER.format(split)
        if not path.exists():
            raise DataError(
                f"{path} does not exist, and Blender's layout needs one for each of train, val and test{beside(path)}; "
                "val and test may be copies of one another"
            )
        frames = read_json(path).get("frames")
        if not isinstance(frames, list) or not frames or not all(_names_image(frame) for frame in frames):
            raise DataError(f"{path} lists no frames with a file_path; export it again")
        if split == "train":
            count, first = len(frames), frames[0]["file_path"]
    return BlenderLayout(count, check_image(data / f"{first}.png"))


def _names_image(frame: object) -> bool:
    return isinstance(frame, dict) and isinstance(frame.get("file_path"), str)


def _folder_of(data: Path, model: str, name: str) -> str:
    """The folder with an image of a model; undistorted images lie beside their model."""
    places = [data / model, *(place for place in (data / model).parents if place.is_relative_to(data))]
    candidates = [*(place / usual for place in places for usual in _IMAGES), data]
    for folder in candidates:
        if (folder / name).is_file():
            return folder.relative_to(data).as_posix()
    raise DataError(
        f"{data} has no image {name}, which its model {model} states, in {', '.join(_IMAGES)}; put the images into "
        f"{data / 'images'}"
    )


def _downscale(images: Path, name: str, size: tuple[int, int]) -> int:
    """The least factor, with smaller images, that brings the longest side to :data:`LONGEST_SIDE` at most; else 1."""
    longest, factor = max(size), 1
    while longest / factor > LONGEST_SIDE:
        if not (images.with_name(f"{images.name}_{2 * factor}") / name).is_file():
            return factor
        factor *= 2
    return factor


def models_in(data: Path) -> dict[str, int]:
    """COLMAP models in the usual places of a folder: their paths in it, and their numbers of images."""
    found: dict[str, int] = {}
    for folder in model_folders(data):
        try:
            text = (folder / "cameras.txt").is_file()
            count = len(images_of(folder)) if text else num_images(folder)
        except DataError:
            count = 0
        found[folder.relative_to(data).as_posix()] = count
    return found


def model_folders(data: Path) -> list[Path]:
    """Folders of the COLMAP models in the usual places of a folder."""
    places = [data / place for place in _MODELS]
    numbered = [path for place in places for path in entries(place) if path.name.isdigit()]
    return [folder for folder in (*places, *numbered) if is_model(folder)]


def is_model(folder: Path) -> bool:
    """Whether a folder has the cameras of a COLMAP model."""
    return any((folder / name).is_file() for name in _FILES)
