"""Captures in COLMAP's and Blender's layouts: what a folder holds, the words of ns-train that read it, and advice."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

from sundae_ns.core.errors import DataError
from sundae_ns.data.capture import beside, check_image, entries, read_json
from sundae_ns.data.colmap import read_images

LONGEST_SIDE = 1600
"""Longest side in pixels that images are trained at where smaller ones are there, as nerfstudio does."""
_MODELS = ("sparse", "colmap/sparse", "dense/sparse", "dense", "distorted/sparse", "sparse/aligned")
"""Where programs put COLMAP's models, which may lie in numbered folders there."""
_IMAGES = ("images", "input", "photos", "image", "rgb")
"""Usual names of the folder of images; COLMAP's programs use the first."""
_BLENDER = "transforms_{}.json"
"""Name of the file of a split (train, val, test) in Blender's layout."""


@dataclass(frozen=True)
class Layout:
    """A capture that nerfstudio reads by another parser than that of ``transforms.json``."""

    program: str
    """COLMAP or Blender."""
    description: str
    size: tuple[int, int]
    """Width and height of the first image, pixels."""
    words: list[str]
    """Words of ``ns-train`` that read the capture, behind all other options."""
    options: tuple[str, ...] = ()
    """Words of ``ns-train`` before all other options, which can replace them."""
    downscale: int = 1
    """Scale of the images to train on: those of ``images_4`` for 4."""


def is_posed(data: Path) -> bool:
    """Whether a folder has a ``transforms.json``, a COLMAP model in one of the usual places, or Blender's files."""
    return (data / "transforms.json").is_file() or bool(model_folders(data)) or is_blender(data)


def is_blender(data: Path) -> bool:
    """Whether a folder has the training cameras of Blender's layout."""
    return (data / _BLENDER.format("train")).is_file()


def is_model(folder: Path) -> bool:
    """Whether a folder has the cameras of a COLMAP model."""
    return any((folder / f"cameras.{kind}").is_file() for kind in ("bin", "txt"))


def model_folders(data: Path) -> list[Path]:
    """Folders of the COLMAP models in the usual places of a folder."""
    usual = [data / name for name in _MODELS]
    numbered = [path for folder in usual for path in entries(folder) if path.name.isdigit()]
    return [folder for folder in (*usual, *numbered) if is_model(folder)]


def models_in(data: Path) -> dict[str, int]:
    """COLMAP models in the usual places of a folder: their paths in it, and their numbers of images; 0 if damaged."""
    counts: dict[str, int] = {}
    for folder in model_folders(data):
        try:
            count = len(read_images(folder))
        except DataError:
            count = 0
        counts[folder.relative_to(data).as_posix()] = count
    return counts


def posed_layout(data: Path) -> Layout | None:
    """The largest COLMAP model of a capture, or else its files of Blender; None if it has a ``transforms.json``.

    Raises:
        DataError: a file is damaged or missing, or the images are in none of the usual places.
    """
    if (data / "transforms.json").is_file():
        return None
    models = models_in(data)
    if models:
        return _colmap_layout(data, max(models, key=models.__getitem__), len(models))
    return _blender_layout(data) if is_blender(data) else None


def _colmap_layout(data: Path, model: str, num_models: int = 1) -> Layout:
    try:
        names = [image.name for image in read_images(data / model).values()]
    except DataError as error:
        raise DataError(f"{data / model}: {error}") from error
    # Undistorted images lie beside their model.
    above = [data / model, *(folder for folder in (data / model).parents if folder.is_relative_to(data))]
    candidates = [*(folder / usual for folder in above for usual in _IMAGES), data]
    images = next((folder for folder in candidates if (folder / names[0]).is_file()), None)
    if images is None:
        raise DataError(
            f"{data} has no image {names[0]}, which its model {model} states, in {', '.join(_IMAGES)}; put the images "
            f"into {data / 'images'}"
        )
    size = check_image(images / names[0])
    downscale = 1
    while max(size) / downscale > LONGEST_SIDE:
        if not (images.with_name(f"{images.name}_{2 * downscale}") / names[0]).is_file():
            break
        downscale *= 2
    folder = images.relative_to(data).as_posix()
    path = [] if folder == "images" else ["--images-path", folder]
    words = ["colmap", "--colmap-path", model, *path, "--downscale-factor", str(downscale)]
    several = f", the largest of {num_models} models" if num_models > 1 else ""
    smaller = f", at 1/{downscale} of their size" if downscale > 1 else ""
    description = f"{len(names):,} images in {folder}{smaller}, poses of {model}{several}"
    return Layout("COLMAP", description, size, words, downscale=downscale)


def _blender_layout(data: Path) -> Layout:
    stated = {}
    for split in ("train", "val", "test"):
        path = data / _BLENDER.format(split)
        if not path.exists():
            raise DataError(
                f"{path} does not exist, and Blender's layout needs one for each of train, val and test{beside(path)}; "
                "val and test may be copies of one another"
            )
        frames = read_json(path).get("frames")
        named = isinstance(frames, list) and all(isinstance(f, dict) and "file_path" in f for f in frames)
        if not frames or not named:
            raise DataError(f"{path} lists no frames with a file_path; export it again")
        stated[split] = frames
    size = check_image(data / f"{stated['train'][0]['file_path']}.png")
    # nerfstudio puts transparent images over white.
    white = ("--pipeline.model.background-color", "white")
    return Layout("Blender", f"{len(stated['train']):,} training images, over white", size, ["blender-data"], white)


def no_transforms(data: Path) -> DataError:
    """The error for a path without a ``transforms.json``, with advice that fits its contents."""
    if data.is_file():
        return DataError(f"{data} is a file, not a capture; sundae poses makes a capture of a video")
    if is_blender(data):
        return DataError(
            f"{data} has no transforms.json; it is in Blender's layout (transforms_train.json): add `blender-data` "
            "to ns-train"
        )
    if is_model(data):
        return DataError(f"{data} is a COLMAP model without its images; give the folder that holds both")
    models = models_in(data)
    if models:
        return DataError(
            f"{data} has no transforms.json; it is in COLMAP layout: add {_words(data, models)} to ns-train"
        )
    inner = next((path for path in entries(data) if (path / "transforms.json").is_file()), None)
    if inner is not None:
        return DataError(f"{data} has no transforms.json, but {inner} has; give that folder")
    return DataError(f"{data} has no transforms.json{beside(data / 'transforms.json')}; {how_to_make_one(data)}")


def no_model(data: Path, model: Path) -> DataError:
    """The error for a ``--colmap-path`` that is no folder, with the models that a capture has."""
    models = models_in(data)
    advice = f"give {_words(data, models)}" if models else "give the folder of the model (usually sparse/0)"
    return DataError(f"{data / model} is not a folder; {advice} as colmap --colmap-path")


def _words(data: Path, models: dict[str, int]) -> str:
    """The words of ``ns-train`` that read the largest of some models, in backquotes."""
    best = max(models, key=models.__getitem__)
    try:
        words = _colmap_layout(data, best).words
    except DataError:  # the images are elsewhere, or the model is damaged; ns-train then says so
        words = ["colmap", "--colmap-path", best]
    several = f" (the largest of {len(models)} models, with {models[best]:,} images)" if len(models) > 1 else ""
    return f"`{shlex.join(words)}`{several}"


def larger_model(data: Path, model: Path) -> str | None:
    """A remark on a COLMAP model beside ``model`` that has placed more images; None if there is none."""
    models = models_in(data) if len(model_folders(data)) > 1 else {}  # counting may take long
    count, best = models.get(model.as_posix()), max(models, key=models.__getitem__, default="")
    if count is None or models[best] <= count:
        return None
    return f"{model} has {count:,} images and {best} has {models[best]:,}; to train on those, give --colmap-path {best}"


def how_to_make_one(images: Path) -> str:
    """Advice with the command that makes a capture of a folder of images."""
    folder = shlex.quote(f"./{images}" if str(images).startswith("-") else str(images))
    return f"make a capture of images with `sundae poses {folder} -o CAPTURE`"


def unused_masks(folder: Path) -> str | None:
    """Name of a folder of masks in a capture, if it has one with images."""
    suffixes = (".png", ".jpg", ".jpeg")
    return next(
        (name for name in ("masks", "mask") if any(path.suffix.lower() in suffixes for path in entries(folder / name))),
        None,
    )
