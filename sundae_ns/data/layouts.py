"""Captures in COLMAP's and Blender's layouts: what a folder holds, the words of ns-train that read it, and advice."""

from __future__ import annotations

import shlex
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from sundae_ns.core.errors import DataError
from sundae_ns.data.capture import beside, entries, read_json
from sundae_ns.data.colmap import read_images
from sundae_ns.data.images import check_image

LONGEST_SIDE = 1600  # pixels, of the images to train on, if smaller ones are there; as in nerfstudio
# Folders where programs put COLMAP's models, directly or in numbered folders, and usual names of the folder of images.
_MODELS = "sparse colmap/sparse dense/sparse dense distorted/sparse sparse/aligned undistorted/sparse".split()
_IMAGES = ("images", "Images", "input", "photos", "image", "rgb", "frames", "imgs", "color", "undistorted")
_SUFFIXES = {".png", ".jpg", ".jpeg"}
_BLENDER = "transforms_train.json"
# Files with cameras of Metashape and RealityScan, which both write COLMAP's format too.
CAMERA_FILES = dict.fromkeys((".xml", ".csv"), "export its cameras as COLMAP, and give their folder, with the images")


class Layout(NamedTuple):
    """A capture that nerfstudio reads by another parser than that of ``transforms.json``."""

    description: str
    words: list[str]  # of ns-train that read the capture, behind all other options
    options: tuple[str, ...] = ()  # words of ns-train before all other options, which can replace them


def is_posed(data: Path) -> bool:
    """Whether a path is a ``.json``, or a folder with ``transforms.json``, a COLMAP model or Blender's files."""
    names = ("transforms.json", _BLENDER)
    return data.suffix == ".json" or any((data / name).is_file() for name in names) or bool(_model_folders(data))


def is_model(folder: Path) -> bool:
    """Whether a folder has the cameras of a COLMAP model."""
    return any((folder / f"cameras.{kind}").is_file() for kind in ("bin", "txt"))


def _model_folders(data: Path) -> list[Path]:
    usual = [data / name for name in _MODELS]
    numbered = [path for folder in usual for path in entries(folder) if path.name.isdigit()]
    numbered += [path / "sparse" for path in numbered]  # dense/0/sparse, of COLMAP's automatic reconstruction
    # RealityScan puts a model beside the images or their folder, others any name; one without images is no capture.
    has_images = any(path.name in _IMAGES or path.suffix.lower() in _SUFFIXES for path in entries(data))
    return [*filter(is_model, dict.fromkeys([*usual, *numbered, *([data, *entries(data)] if has_images else [])]))]


def models_in(data: Path) -> dict[str, int]:
    """Number of images of each COLMAP model in the usual places of a folder, the largest first; 0 if damaged."""
    counts: dict[str, int] = {}
    for folder in _model_folders(data):
        counts[name := folder.relative_to(data).as_posix()] = 0
        with suppress(DataError):
            counts[name] = len(read_images(folder))
    return dict(sorted(counts.items(), key=lambda item: -item[1]))


def posed_layout(data: Path, masks: Path | None = None) -> Layout | None:
    """The largest COLMAP model of a capture, with ``masks``, or else Blender's files; None for ``transforms.json``."""
    if (data / "transforms.json").is_file():
        return None
    if models := models_in(data):
        return _colmap_layout(data, next(iter(models)), len(models), masks)
    return _blender_layout(data) if (data / _BLENDER).is_file() else None


def _colmap_layout(data: Path, model: str, num_models: int = 1, masks: Path | None = None) -> Layout:
    names = [image.name for image in read_images(data / model).values()]
    # Undistorted images lie beside their model.
    above = [data / model, *(folder for folder in (data / model).parents if folder.is_relative_to(data))]
    candidates = [*(folder / usual for folder in above for usual in _IMAGES), data]
    found = next(((folder, name) for folder in candidates for name in names if (folder / name).is_file()), None)
    if found is None:
        near = next(filter(None, (beside(folder / names[0]) for folder in candidates)), "")
        where = f"which its model {model} states, in {', '.join(_IMAGES)}"
        raise DataError(f"{data} has no image {names[0]}{near}, {where}; {'rename it' if near else 'put it there'}")
    images, first = found
    longest = max(check_image(images / first))
    downscale = 1
    while longest / downscale > LONGEST_SIDE and (Path(f"{images}_{2 * downscale}") / first).is_file():
        downscale *= 2
    folder = images.relative_to(data).as_posix()
    more = [] if folder == "images" else ["--images-path", folder]
    several = f", the largest of {num_models} models" if num_models > 1 else ""
    smaller = f", at 1/{downscale} of their size" if downscale > 1 else ""
    description = f"COLMAP layout: {len(names):,} images in {folder}{smaller}, poses of {model}{several}"
    if masks is not None:
        used = masks if downscale == 1 else Path(f"{masks}_{downscale}")
        if lost := [mask for name in names if not (mask := (used / name).with_suffix(".png")).is_file()]:
            raise DataError(f"{lost[0]}, a mask, is missing; check --masks, or add it, black where to ignore pixels")
        more += ["--masks-path", str(masks.resolve())]
    return Layout(description, ["colmap", "--colmap-path", model, *more, "--downscale-factor", str(downscale)])


def _blender_layout(data: Path) -> Layout:
    lists: list[Any] = []
    for split in ("train", "val", "test"):
        if not (path := data / f"transforms_{split}.json").exists():
            raise DataError(f"{path} does not exist{beside(path)}, which Blender's layout needs; copy another split's")
        frames = read_json(path, slashes=False).get("frames")
        named = isinstance(frames, list) and all(isinstance(frame, dict) and "file_path" in frame for frame in frames)
        if not frames or not named:
            raise DataError(f"{path} lists no frames with a file_path; export it again")
        if any("\\" in str(frame["file_path"]) for frame in frames):
            raise DataError(f"{path} has paths of Windows, which nerfstudio does not find here; write / in place of \\")
        if (data / str(frames[0]["file_path"])).is_file():  # of BlenderNeRF
            raise DataError(f"{path} names images with their suffix, unlike Blender's layout; give that file instead")
        lists.append(frames)
    check_image(data / f"{lists[0][0]['file_path']}.png")
    description = f"Blender layout: {len(lists[0]):,} training images, over white"  # as nerfstudio puts them
    return Layout(description, ["blender-data"], ("--pipeline.model.background-color", "white"))


def no_transforms(data: Path) -> DataError:
    """The error for a path without a ``transforms.json``, with advice that fits its contents."""
    if data.is_file():
        advice = CAMERA_FILES.get(data.suffix.lower(), "sundae poses makes a capture of a video")
        return DataError(f"{data} is a file, not a capture; {advice}")
    advice = f"{data} has no transforms.json"
    if (data / _BLENDER).is_file():
        advice += f"; it is in Blender's layout ({_BLENDER}): add `blender-data` to ns-train"
    elif models := models_in(data):
        advice += f"; it is in COLMAP layout: add {_words(data, models)} to ns-train"
    elif is_model(data) or any(map(is_model, entries(data))):
        advice = f"{data} is a COLMAP model without its images; give the folder that holds both"
    elif inner := next((path for path in entries(data) if path.is_dir() and is_posed(path)), None):
        advice = f"{data} is no capture, but {inner} is; give that folder"
    else:
        path = shlex.quote(f"./{data}" if str(data).startswith("-") else str(data))
        advice += f"{beside(data / 'transforms.json')}; make a capture of images with `sundae poses {path} -o CAPTURE`"
    return DataError(advice)


def no_model(data: Path, model: Path) -> DataError:
    """The error for a ``--colmap-path`` that is no folder, with the models that a capture has."""
    advice = f"give {_words(data, models)}" if (models := models_in(data)) else "give the model's (usually sparse/0)"
    return DataError(f"{data / model} is not a folder; {advice} as colmap --colmap-path")


def _words(data: Path, models: dict[str, int]) -> str:
    """The words of ``ns-train`` that read the largest of some models, in backquotes."""
    largest, count = next(iter(models.items()))
    words = ["colmap", "--colmap-path", largest]
    with suppress(DataError):  # the images are elsewhere, or the model is damaged; ns-train then says so
        words = _colmap_layout(data, largest).words
    several = f" (the largest of {len(models)} models, with {count:,} images)" if len(models) > 1 else ""
    return f"`{shlex.join(words)}`{several}"


def larger_model(data: Path, model: Path) -> str | None:
    """A remark on a COLMAP model beside ``model`` that has placed more images; None if there is none."""
    models = models_in(data) if len(_model_folders(data)) > 1 else {}  # counting may take long
    largest, count = next(iter(models), ""), models.get(model.as_posix())
    if count is None or models[largest] <= count:
        return None
    return f"{model} has {count:,} images and {largest} has {models[largest]:,}; for those give --colmap-path {largest}"


def unused_masks(folder: Path) -> str | None:
    """Name of a folder of masks in a capture, if it has one with images."""
    kinds = {name: {path.suffix.lower() for path in entries(folder / name)} for name in ("masks", "mask")}
    return next((name for name, suffixes in kinds.items() if suffixes & _SUFFIXES), None)
