"""What lies beside a path that cannot be used, and the command that reads it."""

from __future__ import annotations

import shlex
from pathlib import Path

from sundae_ns.data.beside import beside, entries
from sundae_ns.data.colmap import images_of, num_images
from sundae_ns.errors import DataError

_MODELS = ("sparse", "colmap/sparse", "dense/sparse", "dense", "distorted/sparse", "sparse/aligned")
"""Where programs put COLMAP's models, which may lie in numbered folders there."""
_FILES = ("cameras.bin", "cameras.txt")


def no_transforms(data: Path) -> DataError:
    """The error for a path without a ``transforms.json``, with advice that fits its contents."""
    if data.is_file():
        return DataError(f"{data} is a file, not a capture; ns-process-data video makes a capture of a video")
    if (data / "transforms_train.json").is_file():
        return DataError(
            f"{data} has no transforms.json; it is in Blender's layout (transforms_train.json): add `blender-data` "
            "to ns-train"
        )
    found = models_in(data)
    if found:
        best = max(found, key=found.__getitem__)
        several = f" (the largest of {len(found)} models, with {found[best]:,} images)" if len(found) > 1 else ""
        return DataError(
            f"{data} has no transforms.json; it is in COLMAP layout: add `colmap {_options(data, best)}` to "
            f"ns-train{several}"
        )
    inner = next((path for path in entries(data) if path.is_dir() and (path / "transforms.json").is_file()), None)
    if inner is not None:
        return DataError(f"{data} has no transforms.json, but {inner} has; give that folder")
    return DataError(f"{data} has no transforms.json{beside(data / 'transforms.json')}; {how_to_make_one(data)}")


def _options(data: Path, model: str) -> str:
    """Options of nerfstudio's ``colmap`` parser for a model and the images that belong to it."""
    words = f"--colmap-path {shlex.quote(model)}"
    folder = (data / model).parent
    while folder != data and not (folder / "images").is_dir():
        folder = folder.parent
    if folder != data:  # undistorted images lie beside their model
        words += f" --images-path {shlex.quote((folder / 'images').relative_to(data).as_posix())}"
    return words


def models_in(data: Path) -> dict[str, int]:
    """COLMAP models in the usual places of a folder: their paths in it, and their numbers of images."""
    found: dict[str, int] = {}
    for folder in _model_folders(data):
        try:
            text = (folder / "cameras.txt").is_file()
            count = len(images_of(folder)) if text else num_images(folder)
        except DataError:
            count = 0
        found[folder.relative_to(data).as_posix()] = count
    return found


def _model_folders(data: Path) -> list[Path]:
    places = [data / place for place in _MODELS]
    numbered = [path for place in places for path in entries(place) if path.name.isdigit()]
    return [folder for folder in (*places, *numbered) if any((folder / name).is_file() for name in _FILES)]


def no_model(data: Path, model: Path) -> DataError:
    """The error for a ``--colmap-path`` that is no folder, with the models that a capture has."""
    found = models_in(data)
    if not found:
        return DataError(
            f"{data / model} is not a folder; give the folder of the model with colmap --colmap-path (usually sparse/0)"
        )
    best = max(found, key=found.__getitem__)
    return DataError(f"{data / model} is not a folder; the model is in {best}: give `colmap {_options(data, best)}`")


def larger_model(data: Path, model: Path) -> str | None:
    """A remark on a COLMAP model beside ``model`` that has placed more images; None if there is none."""
    found = models_in(data) if len(_model_folders(data)) > 1 else {}  # counting may take long
    own = found.get(model.as_posix())
    if own is None:
        return None
    best = max(found, key=found.__getitem__)
    if found[best] <= own:
        return None
    return f"{model} has {own:,} images and {best} has {found[best]:,}; to train on those, give --colmap-path {best}"


def how_to_make_one(images: Path) -> str:
    """Advice with the command that makes a capture of a folder of images."""
    folder = shlex.quote(str(images))
    return f"make a capture of images with `ns-process-data images --data {folder} --output-dir CAPTURE`"
