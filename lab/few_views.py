"""Cut captures to few training views, and put what a suite measures on them into a table.

    python lab/few_views.py CAPTURES... -o CUTS --views 12 16 24
    python benchmarks/suite.py CUTS -o DIR --arms splatfacto sundae-auto
    python lab/few_views.py --suite DIR -o benchmarks/results/few_counts.csv

``CUTS/NAME-12`` has the test views of the capture NAME, every 8th image by name, and 12 of the others, evenly spread.
Its points are those that structure from motion of these 12 finds: the points of the capture that two of them see, or
if its points have no tracks, those that COLMAP triangulates from features of the 12 and the poses of the capture.
"""

import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import tyro
from nerfstudio.data.utils import colmap_parsing_utils as colmap

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from harness.rows import Rows, read_rows
from harness.run import run_script
from sundae_ns.core.errors import ConfigError, DataError, StorageError, reading, writing
from sundae_ns.data.reconstruct import pycolmap

COLUMNS = ("capture", "views", "seed", "arm", "primitives", "head", "psnr", "ssim")
UNTRACKED = {"image_ids": np.zeros(0, int), "point2D_idxs": np.zeros(0, int)}


def cut(capture: Path, views: int, out: Path) -> None:
    """Write a capture in COLMAP layout with so many training views; ``DataError`` if it has fewer."""
    model = capture / "sparse" / "0"
    with reading(model, "a binary COLMAP model"):
        cameras, images, points = colmap.read_model(str(model), ext=".bin")
    order = sorted(images.values(), key=lambda image: image.name)
    others = [i for i in range(len(order)) if i % 8]
    if not 1 < views <= len(others):
        raise DataError(f"{capture} has {len(others)} training views, not {views}; give other --views")
    chosen = {others[int((i + 0.5) * len(others) / views)] for i in range(views)}
    train: dict[int, Any] = {}
    test: dict[int, Any] = {}
    if out.exists():
        raise StorageError(f"{out} is already there; remove it, or give another folder")
    with writing(f"cannot make {out}"):
        for folder in ("images", "sparse/0"):
            (out / folder).mkdir(parents=True)
        for i, image in enumerate(order):
            if i % 8 and i not in chosen:
                continue
            kind, group = ("train", train) if i in chosen else ("eval", test)
            # A number in place of the name, in which nerfstudio might find the other kind.
            name = f"{kind}_{i:04}{Path(image.name).suffix}"
            shutil.copyfile(capture / "images" / image.name, out / "images" / name)
            group[image.id] = image._replace(name=name, xys=np.zeros((0, 2)), point3D_ids=UNTRACKED["image_ids"])
        seen = {k: p for k, p in points.items() if len(train.keys() & set(p.image_ids.tolist())) > 1}
        seen = seen or triangulated(cameras, train, out / "images")
        seen = {k: p._replace(**UNTRACKED) for k, p in seen.items()}
        colmap.write_model(cameras, train | test, seen, str(out / "sparse" / "0"), ext=".bin")
    print(f"{out}: {len(train)} training and {len(test)} test views, {len(seen):,} points")


def triangulated(cameras: Mapping[int, Any], images: Mapping[int, Any], folder: Path) -> dict[int, Any]:
    """Points by number, from features of the images in a folder; their cameras and poses are kept."""
    module = pycolmap()
    with TemporaryDirectory() as work:
        colmap.write_model(cameras, images, {}, work, ext=".bin")
        model, path = module.Reconstruction(work), Path(work) / "database.db"
        with module.Database.open(path) as database:
            for camera in model.cameras.values():
                camera.has_prior_focal_length = True
                database.write_camera(camera, use_camera_id=True)
            for rig in model.rigs.values():
                database.write_rig(rig, use_rig_id=True)
            for frame in model.frames.values():
                database.write_frame(frame, use_frame_id=True)
            for image in model.images.values():
                database.write_image(image, use_image_id=True)
        module.extract_features(path, folder, [image.name for image in images.values()])
        verification = module.TwoViewGeometryOptions()
        verification.ransac.random_seed = 0  # the same points on any number of threads
        module.match_exhaustive(path, verification_options=verification)
        points = module.triangulate_points(model, path, folder, work).points3D
        return {k: colmap.Point3D(k, p.xyz, p.color, p.error, *UNTRACKED.values()) for k, p in points.items()}


def record(suite: Path, out: Path) -> None:
    """Put the results of a suite on cut captures into a table; ``DataError`` if it has none."""
    if not (results := read_rows(suite / "results.csv")):
        raise DataError(f"{suite} holds no results.csv with rows; give the folder that suite.py wrote")
    rows = Rows(out, COLUMNS, COLUMNS[:4])
    for row in results:
        capture, _, views = row["scene"].rpartition("-")
        arm = "default" if row["variant"] == "sundae-auto" else row["variant"]
        head = "on" if float(row["bytes_head"] or 0) else "off"
        errors = f"{float(row['psnr']):.3f}", f"{float(row['ssim']):.4f}"
        figures = (capture, views, row["seed"], arm, row["primitives"], head, *errors)
        rows.put(dict(zip(COLUMNS, figures, strict=True)))


def main(
    captures: Annotated[tuple[Path, ...], tyro.conf.Positional] = (),
    /,
    *,
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    views: tuple[int, ...] = (12, 16, 24),
    suite: Path | None = None,
) -> int:
    """Make the cuts, or the rows.

    Args:
        captures: folders in COLMAP layout, ``sparse/0`` in binary files.
        out: folder for the cuts; with --suite the table, in which other rows stay.
        views: numbers of training views.
        suite: folder of a suite on such captures, whose figures become rows.
    """
    if not captures and suite is None:
        raise ConfigError("there is nothing to do; give folders of captures, or --suite DIR")
    for capture in captures:
        for count in views:
            cut(capture.resolve(), count, out / f"{capture.resolve().name}-{count}")
    if suite is not None:
        record(suite, out)
    return 0


if __name__ == "__main__":
    run_script(main, __doc__)
