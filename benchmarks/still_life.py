"""Ray-trace the still life as a nerfstudio data set; every seed is another scene.

    python benchmarks/still_life.py OUT --width 512 --height 384 --train-views 56 --test-views 4
    python benchmarks/still_life.py sundae_ns/data/demo_capture.zip    # the capture of sundae demo

The same machine makes the same bytes.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import zipfile
from pathlib import Path

from ray_tracing import write_still_life

LONG_AGO = (1980, 1, 1, 0, 0, 0)
"""Date of the files in an archive, so that its bytes depend on their contents only."""


def write_archive(folder: Path, path: Path) -> None:
    """Write the files of a capture into a .zip. Images are compressed already."""
    with zipfile.ZipFile(path, "w") as archive:
        for file in sorted(file for file in folder.rglob("*") if file.is_file()):
            kind = zipfile.ZIP_STORED if file.suffix == ".png" else zipfile.ZIP_DEFLATED
            entry = zipfile.ZipInfo(str(file.relative_to(folder)), LONG_AGO)
            archive.writestr(entry, file.read_bytes(), compress_type=kind, compresslevel=9)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="folder to write, new or empty; or a .zip, which is replaced")
    parser.add_argument("--seed", type=int, default=0, help="of the whole scene")
    parser.add_argument("--train-views", type=int, default=48)
    parser.add_argument("--test-views", type=int, default=8, help="at most as many as training views")
    parser.add_argument("--width", type=int, default=128, help="pixels")
    parser.add_argument("--height", type=int, default=128, help="pixels")
    parser.add_argument("--points", type=int, default=5000, help="size of the sparse cloud")
    options = vars(parser.parse_args())
    out = options.pop("out")
    if out.suffix == ".zip":
        with tempfile.TemporaryDirectory() as folder:
            write_archive(write_still_life(Path(folder), **options), out)
    elif out.exists() and (not out.is_dir() or any(out.iterdir())):
        parser.error(f"{out} holds files; name a new folder")
    else:
        write_still_life(out, **options)
    sys.exit(0)


if __name__ == "__main__":
    main()
