"""Views and points of captures of few training views; ``cut.py`` writes them.

Points are those that structure from motion of the training photos finds: of the capture's own, those that two of them
see; where these have no tracks, by pycolmap from the capture's poses.
"""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from nerfstudio.data.utils import colmap_parsing_utils as colmap


def spread(count: int, n: int) -> list[int]:
    """Indices of n of ``count`` items, each in the middle of its part."""
    return [int((i + 0.5) * count / n) for i in range(min(n, count))]


def seen_twice(points: dict[int, Any], trained: set[int]) -> dict[int, Any]:
    """The points that at least two of the training views see, without tracks in others."""
    kept = {}
    for key, point in points.items():
        mine = np.isin(point.image_ids, list(trained))
        if len(set(point.image_ids[mine].tolist())) >= 2:
            kept[key] = point._replace(image_ids=point.image_ids[mine], point2D_idxs=point.point2D_idxs[mine])
    return kept


def triangulated(cameras: dict[int, Any], placed: list[Any], images: Path) -> dict[int, Any]:
    """Points by features of these images, whose poses are kept; without tracks."""
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    with tempfile.TemporaryDirectory() as name:
        work, camera = Path(name), cameras[placed[0].camera_id]
        reader, extraction = pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions()
        reader.camera_model, reader.camera_params = camera.model, ", ".join(map(str, camera.params))
        extraction.num_threads = 1
        names = [image.name for image in placed]
        pycolmap.extract_features(work / "db", images, names, pycolmap.CameraMode.SINGLE, reader, extraction)
        matching = pycolmap.FeatureMatchingOptions()
        matching.num_threads = 1
        pycolmap.match_exhaustive(work / "db", matching)
        # The model gets the identifiers of the database.
        with pycolmap.Database.open(work / "db") as database:
            stated = {image.name: (image.image_id, image.camera_id) for image in database.read_all_images()}
        same = {stated[one.name][0]: one._replace(id=stated[one.name][0], camera_id=1) for one in placed}
        (work / "model").mkdir()
        colmap.write_model({1: camera._replace(id=1)}, same, {}, str(work / "model"), ext=".bin")
        found = pycolmap.triangulate_points(pycolmap.Reconstruction(work / "model"), work / "db", images, work)
        none = np.zeros(0, int)
        return {
            key: colmap.Point3D(key, point.xyz, point.color, point.error, none, none)
            for key, point in found.points3D.items()
        }
