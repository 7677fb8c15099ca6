"""From photos or a video to a capture, by pycolmap: frames, images, features, matches, poses, capture.

All is made in a folder beside the capture, which is renamed at the end. The same request continues there: images and
features that exist are kept, and COLMAP passes over pairs of its database that are matched.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from sundae_ns.core.errors import ConfigError, DataError, writing
from sundae_ns.core.files import flush, write_text
from sundae_ns.data.capture_files import TRANSFORMS, Advance, Placed, placed_in, write_capture, write_images
from sundae_ns.data.layouts import LONGEST_SIDE
from sundae_ns.data.photos import LEAST_PHOTOS, Warn, find_photos, masks_of
from sundae_ns.data.video import is_video, write_frames
from sundae_ns.io.run_folder import reserve

Matching = Literal["auto", "exhaustive", "sequential", "similar"]
Reporter = Callable[[str, int], AbstractContextManager[Advance]]  # a stage by its name and its number of parts
INSTALL = 'pip install "sundae_ns[photos]"'
_MOST_EXHAUSTIVE, _ALIKE = 200, 40  # photos up to which all pairs are compared, and similar ones for each beyond that
_PAIRS_AT_ONCE = 100  # per thread between two reports of progress


class Request(NamedTuple):
    """Photos, and how to make a capture of them."""

    photos: Path  # a folder, or a video
    capture: Path  # folder to make
    matching: Matching
    frames: int  # of a video
    masks: Path | None  # folder of masks, one for each photo

    @property
    def work(self) -> Path:
        """Folder in which the capture is made."""
        return self.capture.with_name(f"{self.capture.name}.partial")


def pycolmap() -> Any:
    """The silenced module; ``ConfigError`` if it is not installed or cannot be loaded."""
    # The main thread imports it first: its library takes over SIGTERM to print a stack.
    before = signal.getsignal(signal.SIGTERM)
    try:
        import pycolmap as module
    except ImportError as error:
        raise ConfigError(f"camera poses need pycolmap ({error}); install it with {INSTALL}") from error
    if before is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)
    module.logging.minloglevel = module.logging.Level.FATAL.value
    return module


def threads() -> int:
    """Number of threads: that of the machine's processors, or ``OMP_NUM_THREADS``."""
    stated = os.environ.get("OMP_NUM_THREADS", "")
    return int(stated) if stated.isdecimal() and int(stated) > 0 else (os.cpu_count() or 1)


def find_poses(request: Request, report: Reporter, warn: Warn = print) -> Placed:
    """Make a capture; continue what an earlier process has begun with the same photos and options."""
    video = is_video(request.photos)
    work = request.work
    images, frames, made = (work / name for name in ("images", "frames", "capture"))

    def stage(name: str, parts: int, function: Callable[..., Any], *words: Any) -> Any:
        with report(name, parts) as advance:
            return function(*words, advance)

    with writing(f"cannot make {work}"):
        reserve(work, "works in {}; wait for it, or choose another folder")
        photos = [] if video else find_photos(request.photos)
        _keep_or_clear(request, [request.photos] if video else [photo.path for photo in photos])
        if video and not frames.exists():
            stage("frames", request.frames, write_frames, request.photos, frames, request.frames)
        photos = find_photos(frames) if video else photos
        written = stage("images", len(photos), write_images, photos, images, warn)
        names = list(written)
        stage("features", len(names), _find_features, work, images, names)
        if not (work / "sparse").exists():
            pairs = _pairs(work, names, request.matching, video)
            stage("matches of pairs", len(pairs), _match, work, pairs)
        models = stage("poses", len(names), _reconstruct, work, images, len(names))
        sources = {name: photo.path.name for name, photo in written.items()}
        masks = {} if request.masks is None else dict(zip(names, masks_of([*written.values()], request.masks)))
        stage("capture", len(_posed(models[0])), write_capture, made, models[0], images, sources, masks)
        flush(made / TRANSFORMS)  # written last; the system has written the other files meanwhile
        made.replace(request.capture)
        shutil.rmtree(work, ignore_errors=True)
    cameras = {Path(name).parent for name in _posed(models[0])}  # each has a folder of its own
    error = float(models[0].compute_mean_reprojection_error())
    counts = tuple(len(_posed(model)) for model in models)
    return placed_in(request.capture)._replace(cameras=len(cameras), error=error, models=counts)


def _keep_or_clear(request: Request, files: Sequence[Path]) -> None:
    """Clear the working folder, unless it was made of the same files with the same options."""
    times = [(str(path.absolute()), path.stat().st_size, path.stat().st_mtime_ns) for path in files]
    asked = json.dumps({"matching": request.matching, "frames": request.frames, "files": times}, indent=1) + "\n"
    path = request.work / "request.json"
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
    for block in _blocks(missing, 2 * threads(), advance):
        module.extract_features(path, images, block, module.CameraMode.PER_FOLDER, reader, extraction)
    with module.Database.open(path) as database:
        if database.num_keypoints() == 0:
            raise DataError("the photos show nothing that can be found again; add sharp ones of a scene with texture")


def _pairs(work: Path, names: Sequence[str], matching: Matching, video: bool) -> list[tuple[str, str]]:
    """Pairs of images to compare: all, the most similar, or neighbours, at distances that double and similar ones."""
    module = pycolmap()
    if matching == "auto":
        matching = "sequential" if video else "exhaustive" if len(names) <= _MOST_EXHAUSTIVE else "similar"
    with module.Database.open(work / "database.db") as database:
        stored = {image.image_id: image.name for image in database.read_all_images()}
        if matching == "exhaustive" or len(names) <= _ALIKE:
            numbers = module.ExhaustivePairGenerator(module.ExhaustivePairingOptions(), database).all_pairs()
        else:
            overlap, alike, distance = (10, 5, 20) if matching == "sequential" else (3, _ALIKE, 0)
            options = module.SequentialPairingOptions()
            options.overlap, options.quadratic_overlap, options.num_threads = overlap, False, threads()
            options.loop_detection, options.loop_detection_period = True, 1
            options.loop_detection_num_images = alike + 1  # an image is most like itself
            options.loop_detection_min_index_distance = distance
            options.vocab_tree_path = _vocabulary(module, database, list(stored), work / "vocabulary.bin")
            numbers = module.SequentialPairGenerator(options, database).all_pairs()
            if matching == "sequential":
                options.quadratic_overlap, options.loop_detection = True, False
                numbers += module.SequentialPairGenerator(options, database).all_pairs()
        pairs = {(min(pair), max(pair)) for pair in numbers if pair[0] != pair[1]}
    # In blocks, whose features COLMAP loads once.
    return [(stored[a], stored[b]) for a, b in sorted(pairs, key=lambda pair: (pair[0] // 20, pair[1] // 20, pair))]


def _vocabulary(module: Any, database: Any, images: Sequence[int], path: Path) -> Path:
    """A visual vocabulary of the largest features of these images, so that none has to be downloaded."""
    each = 100_000 // len(images)  # COLMAP stores the smallest features first
    largest = [np.asarray(database.read_descriptors(image).data)[-each:] for image in images]
    descriptors = np.concatenate(largest).astype(np.float32)
    options = module.VisualIndex.BuildOptions()
    options.num_visual_words = min(max(len(descriptors) // 40, 1), 2048)  # it warns of fewer than 39 a word
    options.num_iterations, options.num_rounds, options.num_threads = 10, 1, threads()
    index = module.VisualIndex.create(descriptors.shape[1], 64)
    index.build(options, module.FeatureDescriptorsFloat(module.FeatureExtractorType.SIFT, descriptors))
    index.write(path)
    return path


def _match(work: Path, pairs: Sequence[tuple[str, str]], advance: Advance) -> None:
    """Match the features of pairs of images; COLMAP passes over those that are matched."""
    module = pycolmap()
    options, listed = module.FeatureMatchingOptions(), module.ImportedPairingOptions()
    options.num_threads, listed.match_list_path = threads(), work / "pairs.txt"
    for block in _blocks(pairs, _PAIRS_AT_ONCE * threads(), advance):
        listed.match_list_path.write_text("".join(f"{a} {b}\n" for a, b in block), encoding="utf-8", newline="\n")
        module.match_image_pairs(work / "database.db", options, listed)


def _blocks(items: Sequence[Any], size: int, advance: Advance) -> Iterator[Sequence[Any]]:
    for start in range(0, len(items), size):
        yield items[start : start + size]
        advance(len(items[start : start + size]))


def _reconstruct(work: Path, images: Path, count: int, advance: Advance) -> list[Any]:
    """Find poses and points, unless they are there; the models (``pycolmap.Reconstruction``), the largest first."""
    # The four terms of distortion of OPENCV diverge where few photos constrain them. If it leaves out more than a
    # twentieth, SIMPLE_RADIAL is tried, with one; as it fits less well, it must place a tenth more.
    module, folder = pycolmap(), work / "sparse"
    models = _models(folder)
    for attempt in () if models else ("database", "simple_radial"):
        database, partial = work / f"{attempt}.db", work / f"sparse.partial-{attempt}"
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir()
        if attempt == "simple_radial":
            shutil.copyfile(work / "database.db", database)
            with module.Database.open(database) as copy:
                for camera in copy.read_all_cameras():
                    lens = camera.mean_focal_length(), camera.width, camera.height
                    simple = module.Camera.create_from_model_name(camera.camera_id, "SIMPLE_RADIAL", *lens)
                    simple.has_prior_focal_length = camera.has_prior_focal_length
                    copy.update_camera(simple)
        # COLMAP's own thresholds: weaker ones, and global mapping, join what only looks alike, with small errors.
        options = module.IncrementalPipelineOptions()
        # A fixed seed: the same photos give the same poses on the same machine.
        options.num_threads, options.random_seed, options.min_model_size = threads(), 0, LEAST_PHOTOS
        callbacks = {"initial_image_pair_callback": lambda: advance(2), "next_image_callback": lambda: advance(1)}
        module.incremental_mapping(database, images, partial, options, **callbacks)
        if (made := _models(partial)) and (not models or len(_posed(made[0])) > 1.1 * len(_posed(models[0]))):
            models, best = made, partial
        if models and len(_posed(models[0])) >= 0.95 * count:
            break
    if not models:
        remedy = "add sharp ones that overlap by two thirds, taken from places some steps apart"
        raise DataError(f"no photos could be placed relative to each other; {remedy}")
    if not folder.exists():
        best.replace(folder)
    return models


def _models(folder: Path) -> list[Any]:
    """The models of a folder, the largest first, without the poses of images that see hardly a point."""
    models = []
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        model = pycolmap().Reconstruction(path)
        for image in list(model.images.values()):
            if image.has_pose and image.num_points3D < 15:  # after the removal of outliers it may stand anywhere
                model.deregister_frame(image.frame_id)
        if len(_posed(model)) >= LEAST_PHOTOS:
            models.append(model)
    return sorted(models, key=lambda model: (-len(_posed(model)), float(model.compute_mean_reprojection_error())))


def _posed(model: Any) -> list[str]:
    return [image.name for image in model.images.values() if image.has_pose]
