"""Make a capture of few training views from a COLMAP capture.

    python benchmarks/harness/few_views.py CAPTURE OUT -n 16
    ns-train sundae --data OUT colmap --colmap-path sparse/0 --eval-mode filename --downscale-factor 1

Training and test views are spread evenly over the capture; names of images start with train_ or eval_. Points are those
that structure from motion of the training photos finds: of the capture's own, those that two of them see; where these
have no tracks, by pycolmap from the capture's poses. --all-points keeps all.
"""

import argparse
import shutil
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


def main() -> None:
    """Write the capture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("-n", type=int, default=16, help="number of training views")
    parser.add_argument("--tests", type=int, default=40, help="number of test views")
    parser.add_argument("--all-points", action="store_true", help="keep the points of all photos")
    args = parser.parse_args()
    model = args.out / "sparse/0"
    cameras, images, points = colmap.read_model(str(args.capture / "sparse/0"), ext=".bin")
    order = sorted(images.values(), key=lambda image: image.name)
    train = spread(len(order), args.n)
    left = [i for i in range(len(order)) if i not in train]
    kinds = {order[i].id: "train" for i in train}
    kinds |= {order[left[i]].id: "eval" for i in spread(len(left), args.tests)}
    for folder in ("images", "sparse/0"):
        (args.out / folder).mkdir(parents=True, exist_ok=True)
    chosen, none = {}, np.zeros(0, int)
    for key, kind in kinds.items():
        image = images[key]
        name = f"{kind}_{image.name.replace('/', '_')}"
        chosen[key] = image._replace(name=name, xys=np.zeros((0, 2)), point3D_ids=none)
        shutil.copyfile(args.capture / "images" / image.name, args.out / "images" / name)
    tracked = any(len(point.image_ids) for point in points.values())
    kept = points if args.all_points else seen_twice(points, {order[i].id for i in train}) if tracked else {}
    if not kept:
        kept = triangulated(cameras, [chosen[order[i].id] for i in train], args.out / "images")
    bare = {key: point._replace(image_ids=none, point2D_idxs=none) for key, point in kept.items()}
    colmap.write_model(cameras, chosen, bare, str(model), ext=".bin")
    print(f"{args.out}: {len(train)} training and {len(kinds) - len(train)} test views, {len(kept):,} points")


if __name__ == "__main__":
    main()
