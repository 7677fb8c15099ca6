"""From photos or a video to a capture, by pycolmap: frames, images, features, matches, poses, capture.

All is made in a folder beside the capture, which is renamed at the end. The same request continues there: images and
features that exist are kept, and COLMAP passes over pairs of its database that are matched.
"""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from sundae_ns.core.errors import ConfigError, DataError, writing
from sundae_ns.core.files import flush, write_text
from sundae_ns.data.capture_files import TRANSFORMS, Placed, add_masks, names_of, placed_in, write_capture, write_images
from sundae_ns.data.layouts import LONGEST_SIDE
from sundae_ns.data.photos import find_photos, masks_of
from sundae_ns.data.video import is_video, write_frames
from sundae_ns.io.run_folder import reserve

Matching = Literal["auto", "exhaustive", "sequential", "similar"]
Advance = Callable[[int], None]
"""Called with the number of further parts of a stage that are done."""
Reporter = Callable[[str, int], AbstractContextManager[Advance]]
"""Shows the progress of a stage with this name and this number of parts."""
INSTALL = 'pip install "sundae_ns[photos]"'
_MOST_EXHAUSTIVE = 200
"""Number of photos up to which all pairs are compared: 19,900 pairs."""
_ALIKE = 40
"""Number of similar photos that each is compared with."""
_PAIRS_AT_ONCE = 100
"""Pairs per thread between two reports of progress."""
_LEAST_MODEL = 3
"""Images of the smallest model that is kept."""


class Request(NamedTuple):
    """Photos, and how to make a capture of them."""

    photos: Path
    """Folder of photos, or a video."""
    capture: Path
    """Folder to make."""
    matching: Matching
    frames: int
    """Number of frames of a video."""
    masks: Path | None
    """Folder of masks, one for each photo."""

    @property
    def work(self) -> Path:
        """Folder in which the capture is made."""
        return self.capture.with_name(f"{self.capture.name}.partial")


class Model(NamedTuple):
    """A model of COLMAP."""

    folder: Path
    images: tuple[str, ...]
    """Names of the images with a pose, sorted."""
    error: float
    """Mean reprojection error, pixels."""


def pycolmap() -> Any:
    """The silenced module; ``ConfigError`` if it is not installed or cannot be loaded.

    The main thread imports it first: its library takes over SIGTERM to print a stack.
    """
    check_installed()
    before = signal.getsignal(signal.SIGTERM)
    try:
        import pycolmap as module
    except ImportError as error:
        raise ConfigError(f"pycolmap cannot be loaded ({error}); install it again with {INSTALL}") from error
    if before is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)
    module.logging.minloglevel = module.logging.Level.FATAL.value
    return module


def check_installed() -> None:
    """Raise ``ConfigError`` if pycolmap is not installed; imports nothing."""
    loaded = "pycolmap" in sys.modules
    if sys.modules.get("pycolmap") is None if loaded else importlib.util.find_spec("pycolmap") is None:
        raise ConfigError(f"camera poses need pycolmap; install it with {INSTALL}")


def threads() -> int:
    """Number of threads: that of the machine's processors, or ``OMP_NUM_THREADS``."""
    stated = os.environ.get("OMP_NUM_THREADS", "")
    return int(stated) if stated.isdigit() and int(stated) > 0 else (os.cpu_count() or 1)


def find_poses(request: Request, report: Reporter) -> Placed:
    """Make a capture; continue what an earlier process has begun with the same photos and options.

    Raises:
        DataError: photos cannot be used, or none could be placed.
        StorageError: another process works on it, or the disk is full or not writable.
    """
    work, video = request.work, is_video(request.photos)
    images, frames, made = work / "images", work / "frames", work / "capture"
    with writing(f"cannot make {work}"):
        reserve(work, "works in {}; wait for it, or choose another folder")
        photos = [] if video else find_photos(request.photos)
        _keep_or_clear(request, [request.photos] if video else [photo.path for photo in photos])
        if video:
            if not frames.exists():
                with report("frames", request.frames) as advance:
                    write_frames(request.photos, frames, request.frames, advance)
            photos = find_photos(frames)
        names = names_of(photos)
        with report("images", len(photos)) as advance:
            write_images(photos, images, advance)
        with report("features", len(photos)) as advance:
            _find_features(work, images, names, advance)
        if not (work / "sparse").exists():
            pairs = _pairs(work, names, request.matching, video)
            with report("matches of pairs", len(pairs)) as advance:
                _match(work, pairs, advance)
        with report("poses", len(photos)) as advance:
            models = _reconstruct(work, images, len(photos), advance)
        sources = {name: photo.path.name for name, photo in zip(names, photos, strict=True)}
        with report("capture", len(models[0].images)) as advance:
            write_capture(made, load_model(models[0].folder), images, sources, advance)
            masks = None if request.masks is None else add_masks(made, masks_of(photos, request.masks))
        flush(made / TRANSFORMS)  # written last; the system has written the other files meanwhile
        made.replace(request.capture)
        shutil.rmtree(work, ignore_errors=True)
    cameras = len({Path(name).parent for name in models[0].images})
    sizes = tuple(len(model.images) for model in models)
    return placed_in(request.capture)._replace(cameras=cameras, error=models[0].error, models=sizes, masks=masks)


def _keep_or_clear(request: Request, files: Sequence[Path]) -> None:
    """Clear the working folder, unless it was made of the same files with the same options."""
    times = [(str(path.absolute()), path.stat().st_size, path.stat().st_mtime_ns) for path in files]
    stated = {"matching": request.matching, "frames": request.frames, "files": times}
    asked, path = json.dumps(stated, indent=1) + "\n", request.work / "request.json"
    if path.is_file() and path.read_text(encoding="utf-8", errors="replace") == asked:
        return
    for entry in request.work.iterdir():
        if entry.is_dir():
            shutil.rmtree(entry)
        elif entry.suffix != ".lock":
            entry.unlink()
    write_text(path, asked)


def _find_features(work: Path, images: Path, names: Sequence[str], advance: Advance) -> None:
    """Make a database of images, with a camera for each of their folders, and find the features that it lacks."""
    module, path, partial = pycolmap(), work / "database.db", work / "database.db.partial"
    reader, extraction = module.ImageReaderOptions(), module.FeatureExtractionOptions()
    reader.camera_model = "OPENCV"
    extraction.num_threads, extraction.max_image_size = threads(), LONGEST_SIDE
    if not path.exists():
        for left in work.glob(f"{partial.name}*"):  # with the journal of a killed process
            left.unlink()
        module.Database.open(partial).close()
        module.import_images(partial, images, module.CameraMode.PER_FOLDER, list(names), reader)
        partial.replace(path)
    with module.Database.open(path) as database:
        have = {image.name for image in database.read_all_images() if database.exists_keypoints(image.image_id)}
    missing = [name for name in names if name not in have]
    advance(len(names) - len(missing))
    for start in range(0, len(missing), 2 * threads()):
        part = missing[start : start + 2 * threads()]
        module.extract_features(path, images, part, module.CameraMode.PER_FOLDER, reader, extraction)
        advance(len(part))
    with module.Database.open(path) as database:
        if database.num_keypoints() == 0:
            raise DataError("the photos show nothing that can be found again; add sharp ones of a scene with texture")


def _pairs(work: Path, names: Sequence[str], matching: Matching, video: bool) -> list[tuple[str, str]]:
    """Pairs of images to compare: in a video neighbours, frames at distances that double, and similar ones that close
    a loop; otherwise all pairs, or the most similar photos and the next by name."""
    module = pycolmap()
    if matching == "auto":
        matching = "sequential" if video else "exhaustive" if len(names) <= _MOST_EXHAUSTIVE else "similar"
    with module.Database.open(work / "database.db") as database:
        stored = {image.image_id: image.name for image in database.read_all_images()}
        if matching == "exhaustive" or len(names) <= _ALIKE:
            found = module.ExhaustivePairGenerator(module.ExhaustivePairingOptions(), database).all_pairs()
        else:
            overlap, alike, distance = (10, 5, 20) if matching == "sequential" else (3, _ALIKE, 0)
            options = module.SequentialPairingOptions()
            options.overlap, options.quadratic_overlap, options.num_threads = overlap, False, threads()
            options.loop_detection, options.loop_detection_period = True, 1
            options.loop_detection_num_images = alike + 1  # an image is most like itself
            options.loop_detection_min_index_distance = distance
            options.vocab_tree_path = _vocabulary(module, database, list(stored), work / "vocabulary.bin")
            found = module.SequentialPairGenerator(options, database).all_pairs()
            if matching == "sequential":
                options.quadratic_overlap, options.loop_detection = True, False
                found += module.SequentialPairGenerator(options, database).all_pairs()
        pairs = {(min(pair), max(pair)) for pair in found if pair[0] != pair[1]}
    # In blocks, whose features COLMAP loads once.
    return [(stored[a], stored[b]) for a, b in sorted(pairs, key=lambda pair: (pair[0] // 20, pair[1] // 20, pair))]


def _vocabulary(module: Any, database: Any, images: Sequence[int], path: Path) -> Path:
    """A visual vocabulary of the largest features of these images, so that none has to be downloaded."""
    each = 100_000 // len(images)
    # COLMAP stores the smallest features first.
    largest = [np.asarray(database.read_descriptors(image).data)[-each:] for image in images]
    descriptors = np.concatenate(largest).astype(np.float32)
    options = module.VisualIndex.BuildOptions()
    options.num_visual_words = min(max(len(descriptors) // 40, 16), 2048)
    options.num_iterations, options.num_rounds, options.num_threads = 10, 1, threads()
    index = module.VisualIndex.create(descriptors.shape[1], 64)
    saved, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)  # the library warns of few words
        index.build(options, module.FeatureDescriptorsFloat(module.FeatureExtractorType.SIFT, descriptors))
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(nowhere)
    index.write(path)
    return path


def _match(work: Path, pairs: Sequence[tuple[str, str]], advance: Advance) -> None:
    """Match the features of pairs of images; COLMAP passes over those that are matched."""
    module = pycolmap()
    options, listed = module.FeatureMatchingOptions(), module.ImportedPairingOptions()
    options.num_threads, listed.match_list_path = threads(), work / "pairs.txt"
    size = _PAIRS_AT_ONCE * threads()
    for start in range(0, len(pairs), size):
        part = pairs[start : start + size]
        listed.match_list_path.write_text("".join(f"{a} {b}\n" for a, b in part), encoding="utf-8", newline="\n")
        module.match_image_pairs(work / "database.db", options, listed)
        advance(len(part))


def _reconstruct(work: Path, images: Path, count: int, advance: Advance) -> list[Model]:
    """Find poses and points, unless they are there; the models, the largest first.

    OPENCV has two focal lengths and four terms of distortion, which diverge where few photos constrain them. If it
    leaves out more than a twentieth of the photos, SIMPLE_RADIAL is tried, with one of each; as it fits less well, it
    must place a tenth more.
    """
    module, folder = pycolmap(), work / "sparse"
    if not folder.exists():
        kept: list[Model] = []
        for attempt in ("database", "simple_radial"):
            database, partial = work / f"{attempt}.db", work / f"sparse.partial-{attempt}"
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir()
            if attempt == "simple_radial":
                _simplify_cameras(module, shutil.copyfile(work / "database.db", database))
            # COLMAP's own thresholds: weaker ones, and global mapping, join what only looks alike, with small errors.
            options = module.IncrementalPipelineOptions()
            # A fixed seed: the same photos give the same poses on the same machine.
            options.num_threads, options.random_seed, options.min_model_size = threads(), 0, _LEAST_MODEL
            callbacks = {"initial_image_pair_callback": lambda: advance(2), "next_image_callback": lambda: advance(1)}
            module.incremental_mapping(database, images, partial, options, **callbacks)
            models = _models(partial)
            if models and (not kept or len(models[0].images) > 1.1 * len(kept[0].images)):
                kept = models
            if kept and len(kept[0].images) >= 0.95 * count:
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


def _simplify_cameras(module: Any, path: Path) -> None:
    """Turn the cameras of a database into SIMPLE_RADIAL ones with their known focal lengths."""
    with module.Database.open(path) as database:
        for camera in database.read_all_cameras():
            lens = camera.mean_focal_length(), camera.width, camera.height
            other = module.Camera.create_from_model_name(camera.camera_id, "SIMPLE_RADIAL", *lens)
            other.has_prior_focal_length = camera.has_prior_focal_length
            database.update_camera(other)


def _models(folder: Path) -> list[Model]:
    """The models of a folder, the largest first."""
    models = []
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        model = load_model(path)
        names = sorted(image.name for image in model.images.values() if image.has_pose)
        if len(names) >= _LEAST_MODEL:
            models.append(Model(path, tuple(names), float(model.compute_mean_reprojection_error())))
    return sorted(models, key=lambda model: (-len(model.images), model.error))


def load_model(folder: Path) -> Any:
    """A stored model (``pycolmap.Reconstruction``), without the poses of images that see hardly a point of it."""
    model = pycolmap().Reconstruction(folder)
    for image in list(model.images.values()):
        if image.has_pose and image.num_points3D < 15:  # after the removal of outliers it may stand anywhere
            model.deregister_frame(image.frame_id)
    return model
