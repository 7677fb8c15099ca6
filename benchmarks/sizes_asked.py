"""Files of asked sizes: what was asked, what was got, and its quality; print one CSV row for each.

    python benchmarks/sizes_asked.py FIELDS... CAPTURES... -o benchmarks/results/sizes_asked.csv    # best on a GPU

A field, a file of Gaussians, is pruned without photos (``sundae prune --max-mb``), and compared with its own images in
16 virtual cameras that the prune has not seen, as ``sundae compare`` does. A capture, a folder, is trained for each
size (``sundae train --max-mb``), and its pack compared with the test photos. All files are ``.sundae``. Rows of ``-o``
that are there are kept. ``--more="--num-cameras 16"`` are further options of the command, here for fields on a CPU.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import sundae_ns as sn
from harness.rows import Rows
from sundae_ns.rasterize.interface import fastest_device
from sundae_ns.report.measure import against_first, against_photos, measure
from sundae_ns.scene.describe import held_out_cameras

COLUMNS = ("capture", "source", "asked_mb", "got_mb", "psnr", "ssim")


def made(path: Path, size: float, more: list[str], folder: Path) -> Path:
    """A packed scene of at most a size in MB, of a field or of a capture."""
    packed = folder / "field.sundae"
    words = ["prune", str(path), "-o", str(packed)] if path.is_file() else ["train", str(path), "-o", str(folder)]
    words += ["--max-mb", f"{size:g}", *more, *([] if path.is_file() else ["--", "--timestamp", "run"])]
    subprocess.run(["sundae", *words], check=True, stdout=sys.stderr)
    return packed if packed.exists() else next(folder.glob("*/*/run/scene.sundae"))


def figures(path: Path, size: float, more: list[str]) -> dict[str, Any]:
    """Bytes and quality of the file of a size in MB."""
    with TemporaryDirectory() as folder:
        packed = made(path, size, more, Path(folder))
        opened = against_photos(path)
        if path.is_file():
            whole = sn.load(path, device=fastest_device())
            opened = against_first(path, whole, held_out_cameras(whole, ()))
        full = measure(opened(packed), repeats=0).full
    means = {name: f"{full.mean(name):.{digits}f}" for name, digits in (("psnr", 3), ("ssim", 4))}
    return {"got_mb": f"{full.bytes / 1e6:.4f}", **means}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path, help="files of fields, and folders of captures")
    parser.add_argument("-o", "--out", type=Path, help="table of results; rows that are there are kept")
    parser.add_argument("--sizes", nargs="+", type=float, default=[0.25, 0.5, 1.0, 2.0, 4.0], help="MB")
    parser.add_argument("--more", type=shlex.split, default=[], help="further options of prune or train")
    options = parser.parse_args()
    rows, failed = Rows(options.out, COLUMNS, ("capture", "source", "asked_mb")), 0
    for path in options.scenes:
        for size in options.sizes:
            row = {"capture": path.stem, "source": "field" if path.is_file() else "trained", "asked_mb": size}
            if row in rows:
                continue
            try:
                rows.put({**row, **figures(path, size, options.more)})
            except (sn.SundaeError, OSError, subprocess.CalledProcessError) as error:
                print(f"{path}, {size:g} MB: {error}", file=sys.stderr)
                failed = 1
    return failed


if __name__ == "__main__":
    sys.exit(main())
