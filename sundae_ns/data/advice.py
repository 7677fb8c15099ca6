"""What lies beside a path that cannot be used, and the command that reads it."""

from __future__ import annotations

import shlex
from pathlib import Path

from sundae_ns.data.beside import beside, entries
from sundae_ns.data.layouts import is_blender, is_model, layout_of, model_folders, models_in
from sundae_ns.errors import DataError


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
    found = models_in(data)
    if found:
        best = max(found, key=found.__getitem__)
        several = f" (the largest of {len(found)} models, with {found[best]:,} images)" if len(found) > 1 else ""
        return DataError(
            f"{data} has no transforms.json; it is in COLMAP layout: add `{_options(data, best)}` to ns-train{several}"
        )
    inner = next((path for path in entries(data) if path.is_dir() and (path / "transforms.json").is_file()), None)
    if inner is not None:
        return DataError(f"{data} has no transforms.json, but {inner} has; give that folder")
    return DataError(f"{data} has no transforms.json{beside(data / 'transforms.json')}; {how_to_make_one(data)}")


def _options(data: Path, model: str) -> str:
    try:
        return shlex.join(layout_of(data, model).words)
    except DataError:  # the images are elsewhere, or the model is damaged; ns-train then says so
        return shlex.join(["colmap", "--colmap-path", model])


def no_model(data: Path, model: Path) -> DataError:
    """The error for a ``--colmap-path`` that is no folder, with the models that a capture has."""
    found = models_in(data)
    if not found:
        return DataError(
            f"{data / model} is not a folder; give the folder of the model with colmap --colmap-path (usually sparse/0)"
        )
    best = max(found, key=found.__getitem__)
    return DataError(f"{data / model} is not a folder; the model is in {best}: give `{_options(data, best)}`")


def larger_model(data: Path, model: Path) -> str | None:
    """A remark on a COLMAP model beside ``model`` that has placed more images; None if there is none."""
    found = models_in(data) if len(model_folders(data)) > 1 else {}  # counting may take long
    own = found.get(model.as_posix())
    if own is None:
        return None
    best = max(found, key=found.__getitem__)
    if found[best] <= own:
        return None
    return f"{model} has {own:,} images and {best} has {found[best]:,}; to train on those, give --colmap-path {best}"


def how_to_make_one(images: Path) -> str:
    """Advice with the command that makes a capture of a folder of images."""
    folder = shlex.quote(f"./{images}" if str(images).startswith("-") else str(images))
    return f"make a capture of images with `sundae poses {folder} -o CAPTURE`"
