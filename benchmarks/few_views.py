"""Cut captures to few training views, measure methods on the cuts, and put their figures into a table. It resumes.

    python benchmarks/few_views.py CAPTURES... -o DIR --table benchmarks/results/few_counts.csv
    python benchmarks/few_views.py CAPTURES... -o DIR --views 12 40 --arms sundae-auto --seeds 42 43

``DIR/captures/NAME-12`` has the test views of the capture NAME, and 12 of its training views, evenly spread by name. Of
the points it has those that two of the 12 see. If the tracks name none, COLMAP triangulates points from features of the
12, at their poses. ``DIR/suite`` holds jobs and results of suite.py; the table calls its arm sundae-auto ``default``.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import tyro
from nerfstudio.data.utils import colmap_parsing_utils as colmap
from suite import SuiteOptions, run_suite

from harness.arms import choose_arms
from harness.plan import parser_of
from harness.rows import Rows, read_rows
from harness.run import run_script
from sundae_ns.core.errors import ConfigError, DataError, reading, writing
from sundae_ns.data.reconstruct import pycolmap

COLUMNS = ("capture", "views", "seed", "arm", "primitives", "head", "psnr", "ssim")
EMPTY = np.zeros(0, int)


def cut(capture: Path, views: int, out: Path) -> None:
    """Write a capture in COLMAP layout with so many training views; ``DataError`` if it has fewer."""
    model, by_name = capture / "sparse" / "0", "filename" in parser_of(capture)
    with reading(model, "a binary COLMAP model"):
        cameras, images, points = colmap.read_model(str(model), ext=".bin")
    order = sorted(images.values(), key=lambda image: image.name)
    test = [i for i, image in enumerate(order) if (image.name.startswith("eval_") if by_name else i % 8 == 0)]
    others = [i for i in range(len(order)) if i not in test]
    if not 1 < views <= len(others):
        raise DataError(f"{capture} has {len(others)} training views, not {views}; give other --views")
    chosen = [others[int((i + 0.5) * len(others) / views)] for i in range(views)]
    with writing(f"cannot make {out}"), TemporaryDirectory(dir=out.parent, prefix=".") as folder:
        made = Path(folder) / out.name
        (made / "images").mkdir(parents=True)
        (made / "sparse" / "0").mkdir(parents=True)
        kept: dict[str, dict[int, Any]] = {"train": {}, "eval": {}}
        for kind, numbers in (("train", chosen), ("eval", test)):
            for i in numbers:
                # A number in place of the name, in which nerfstudio might find the other kind.
                name = f"{kind}_{i:04}{Path(order[i].name).suffix}"
                shutil.copyfile(capture / "images" / order[i].name, made / "images" / name)
                kept[kind][order[i].id] = order[i]._replace(name=name, xys=np.zeros((0, 2)), point3D_ids=EMPTY)
        seen = {k: p for k, p in points.items() if len(kept["train"].keys() & set(p.image_ids.tolist())) > 1}
        seen = seen or triangulated(cameras, kept["train"], made / "images")
        seen = {k: p._replace(image_ids=EMPTY, point2D_idxs=EMPTY) for k, p in seen.items()}
        colmap.write_model(cameras, kept["train"] | kept["eval"], seen, str(made / "sparse" / "0"), ext=".bin")
        (made / "capture.txt").write_text(str(capture), encoding="utf-8")
        made.replace(out)
    print(f"{out}: {views} training and {len(test)} test views, {len(seen):,} points")


def triangulated(cameras: Mapping[int, Any], images: Mapping[int, Any], folder: Path) -> dict[int, Any]:
    """Points by number that COLMAP triangulates from features of the images in a folder, at their poses."""
    module = pycolmap()
    with TemporaryDirectory() as work:
        colmap.write_model(cameras, images, {}, work, ext=".bin")
        model, path = module.Reconstruction(work), Path(work) / "database.db"
        with module.Database.open(path) as database:
            for camera in model.cameras.values():
                camera.has_prior_focal_length = True
            for kind in ("camera", "rig", "frame", "image"):
                for each in getattr(model, f"{kind}s").values():
                    getattr(database, f"write_{kind}")(each, **{f"use_{kind}_id": True})
        module.extract_features(path, folder, [image.name for image in images.values()])
        verification = module.TwoViewGeometryOptions()
        verification.ransac.random_seed = 0  # the same points on any number of threads
        module.match_exhaustive(path, verification_options=verification)
        points = module.triangulate_points(model, path, folder, work).points3D
        return {k: colmap.Point3D(k, p.xyz, p.color, p.error, EMPTY, EMPTY) for k, p in points.items()}


def record(suite: Path, table: Path | None) -> None:
    """Put the results of a suite on cuts into a table, in which other rows stay."""
    rows = Rows(table, COLUMNS, COLUMNS[:4])
    for row in read_rows(suite / "results.csv"):
        capture, _, views = row["scene"].rpartition("-")
        arm = "default" if row["variant"] == "sundae-auto" else row["variant"]
        head = "on" if float(row["bytes_head"] or 0) else "off"
        errors = f"{float(row['psnr']):.3f}", f"{float(row['ssim']):.4f}"
        figures = (capture, views, row["seed"], arm, row["primitives"], head, *errors)
        rows.put(dict(zip(COLUMNS, figures, strict=True)))


def main(
    captures: Annotated[tuple[Path, ...], tyro.conf.Positional],
    /,
    *,
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    views: tuple[int, ...] = (12, 16, 24),
    arms: tuple[str, ...] = ("sundae-auto", "splatfacto"),
    seeds: tuple[int, ...] = (42,),
    table: Path | None = None,
) -> int:
    """Cut, measure and put the rows into the table; the exit code is that of suite.py.

    Args:
        captures: folders in COLMAP layout, ``sparse/0`` in binary files.
        out: folder for cuts, jobs and their results; those that are there are not made again.
        views: numbers of training views; each makes a cut of every capture.
        arms: as of suite.py.
        seeds: as of suite.py.
        table: table of results, in which rows take the place of earlier ones; by default they are only printed.
    """
    cuts = {f"{path.resolve().name}-{count}": (path.resolve(), count) for path in captures for count in views}
    if len(cuts) < len(captures) * len(views):
        raise ConfigError("two captures or numbers of views are named alike; rename one, or give each once")
    folder = out / "captures"
    options = SuiteOptions(folder=folder, out=out / "suite", arms=arms, seeds=seeds, scenes=tuple(cuts))
    choose_arms(options.arms, options.method, options.steps_scale, from_scratch=True)  # refused before minutes of cuts
    with writing(f"cannot make {folder}"):
        folder.mkdir(parents=True, exist_ok=True)
    for name, (capture, count) in cuts.items():
        note = folder / name / "capture.txt"
        if not note.parent.exists():
            cut(capture, count, folder / name)
        elif (of := note.read_text(encoding="utf-8") if note.exists() else "an earlier version") != str(capture):
            raise ConfigError(f"{folder / name} is a cut of {of}; choose another --out for {capture}")
    code = run_suite(options)
    record(options.out, table)
    return code


if __name__ == "__main__":
    run_script(main, __doc__)
