"""Features, matches and models of images, by pycolmap; each part continues where a killed process has left it."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sundae_ns.errors import DataError
from sundae_ns.poses.library import LARGEST, SEED, pycolmap, threads
from sundae_ns.poses.pairs import Pairs

CAMERAS = ("OPENCV", "SIMPLE_RADIAL")
"""COLMAP's models of the cameras of an attempt. The first has two focal lengths and four terms of distortion. Where few
photos constrain these, they diverge; the second has one of each."""
DATABASE = "database.db"
MODELS = "sparse"
_LISTED = "pairs.txt"
_COMPARED = 2000
"""Features of a photo by which it is compared with others as a whole."""
_PAIRS_AT_ONCE = 100
"""Pairs per thread between two reports of progress."""
_LEAST_MODEL = 3
"""Images of the smallest model that is kept."""
_LEAST_POINTS = 15
"""Points that an image with a pose sees; one that sees fewer after outliers were removed may stand anywhere."""
_MOST = 0.95
"""Share of the photos that is placed well enough not to try other cameras."""
_BETTER = 1.1
"""Photos that a later attempt must place, in those of the earlier one; its cameras fit less well."""

Advance = Callable[[int], None]


class Model(NamedTuple):
    """A model of COLMAP."""

    folder: Path
    images: tuple[str, ...]
    """Names of the images with a pose, sorted."""
    error: float
    """Mean reprojection error, pixels."""
    points: int


def make_database(work: Path, images: Path, names: Sequence[str]) -> None:
    """Make a database that lists images, with a camera for each of their folders; an existing one stays."""
    module = pycolmap()
    path = work / DATABASE
    if path.exists():
        return
    partial = work / f"{DATABASE}.partial"
    for left in work.glob(f"{partial.name}*"):  # with the journal of a killed process
        left.unlink()
    module.Database.open(partial).close()
    options = module.ImageReaderOptions()
    options.camera_model = CAMERAS[0]
    module.import_images(partial, images, module.CameraMode.PER_FOLDER, list(names), options)
    partial.replace(path)


def find_features(work: Path, images: Path, names: Sequence[str], advance: Advance) -> None:
    """Find the features of images that have none yet.

    Raises:
        DataError: no image has any feature.
    """
    module = pycolmap()
    with module.Database.open(work / DATABASE) as database:
        have = {image.name for image in database.read_all_images() if database.exists_keypoints(image.image_id)}
    missing = [name for name in names if name not in have]
    advance(len(names) - len(missing))
    reader, extraction = module.ImageReaderOptions(), module.FeatureExtractionOptions()
    reader.camera_model = CAMERAS[0]
    extraction.num_threads, extraction.max_image_size = threads(), LARGEST
    for start in range(0, len(missing), 2 * threads()):
        part = missing[start : start + 2 * threads()]
        module.extract_features(work / DATABASE, images, part, module.CameraMode.PER_FOLDER, reader, extraction)
        advance(len(part))
    with module.Database.open(work / DATABASE) as database:
        if database.num_keypoints() == 0:
            raise DataError("the photos show nothing that can be found again; add sharp ones of a scene with texture")


def read_descriptors(work: Path, names: Sequence[str]) -> list[NDArray[np.uint8]]:
    """Descriptors of each image ``[M, 128]``, of its largest features at most."""
    found = []
    with pycolmap().Database.open(work / DATABASE) as database:
        identifiers = {image.name: image.image_id for image in database.read_all_images()}
        for name in names:
            descriptors = np.asarray(database.read_descriptors(identifiers[name]).data)
            found.append(descriptors[-_COMPARED:].copy())  # COLMAP stores the smallest features first
    return found


def match(work: Path, names: Sequence[str], pairs: Pairs, advance: Advance) -> None:
    """Match the features of pairs of images; COLMAP passes over those that are matched."""
    module = pycolmap()
    options, listed = module.FeatureMatchingOptions(), module.ImportedPairingOptions()
    options.num_threads, listed.match_list_path = threads(), work / _LISTED
    size = _PAIRS_AT_ONCE * threads()
    for start in range(0, len(pairs), size):
        part = pairs[start : start + size]
        with (work / _LISTED).open("w", encoding="utf-8", newline="\n") as file:
            file.writelines(f"{names[i]} {names[j]}\n" for i, j in part)
        module.match_image_pairs(work / DATABASE, options, listed)
        advance(len(part))


def reconstruct(work: Path, images: Path, count: int, advance: Advance) -> list[Model]:
    """Find poses and points, unless they are there; the models, the largest first.

    Args:
        work: folder of the database.
        images: folder of the images.
        count: number of images.
        advance: called with the number of further images that have a pose.

    Raises:
        DataError: no photos could be placed relative to each other.
    """
    module = pycolmap()
    folder = work / MODELS
    if not folder.exists():
        kept: list[Model] = []
        for number, camera in enumerate(CAMERAS):
            partial = work / f"{MODELS}.partial-{number}"
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir()
            database = work / DATABASE if number == 0 else _with_cameras(module, work, camera)
            # COLMAP's own thresholds: weaker ones, and global mapping, join what only looks alike, with small errors.
            options = module.IncrementalPipelineOptions()
            options.num_threads, options.random_seed, options.min_model_size = threads(), SEED, _LEAST_MODEL
            module.incremental_mapping(
                database,
                images,
                partial,
                options,
                initial_image_pair_callback=lambda: advance(2),
                next_image_callback=lambda: advance(1),
            )
            found = _models(partial)
            if found and (not kept or len(found[0].images) > _BETTER * len(kept[0].images)):
                kept = found
            if kept and len(kept[0].images) >= _MOST * count:
                break
        if kept:
            kept[0].folder.parent.replace(folder)
    models = _models(folder)
    if not models:
        raise DataError(
            "no photos could be placed relative to each other; add sharp ones that overlap by two thirds, taken from "
            "places some steps apart"
        )
    return models


def _with_cameras(module: Any, work: Path, kind: str) -> Path:
    """A copy of the database whose cameras are of another model, with the focal lengths that are known so far."""
    path = work / f"{kind.lower()}.db"
    shutil.copyfile(work / DATABASE, path)
    with module.Database.open(path) as database:
        for camera in database.read_all_cameras():
            size = camera.width, camera.height
            other = module.Camera.create_from_model_name(camera.camera_id, kind, camera.mean_focal_length(), *size)
            other.has_prior_focal_length = camera.has_prior_focal_length
            database.update_camera(other)
    return path


def _models(folder: Path) -> list[Model]:
    """The models of a folder, the largest first."""
    models = [_model(path) for path in sorted(folder.iterdir())] if folder.is_dir() else []
    models = [model for model in models if len(model.images) >= _LEAST_MODEL]
    return sorted(models, key=lambda model: (-len(model.images), model.error))


def load_model(folder: Path) -> Any:
    """A stored model (``pycolmap.Reconstruction``), without the poses of images that see hardly a point of it."""
    model = pycolmap().Reconstruction(folder)
    for image in list(model.images.values()):
        if image.has_pose and image.num_points3D < _LEAST_POINTS:
            model.deregister_frame(image.frame_id)
    return model


def _model(folder: Path) -> Model:
    model = load_model(folder)
    names = tuple(sorted(image.name for image in model.images.values() if image.has_pose))
    return Model(folder, names, float(model.compute_mean_reprojection_error()), model.num_points3D())
