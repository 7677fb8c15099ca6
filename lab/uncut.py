"""Captures cut by benchmarks/few_views.py, whose images stay where they are: uncut.py pack CUT CAPTURE OUT, or uncut.py unpack FOLDER SCENES."""

import shutil
import sys
from pathlib import Path

kind, first, second, *rest = sys.argv[1:]
if kind == "pack":
    cut, capture, out = Path(first), Path(second), Path(rest[0])
    shutil.copytree(cut / "sparse", out / "sparse", dirs_exist_ok=True)
    originals = sorted(str(path.relative_to(capture / "images")) for path in (capture / "images").rglob("*") if path.is_file())
    (out / "names.txt").write_text("".join(f"{path.name}\t{originals[int(path.stem.split('_')[1])]}\n" for path in sorted((cut / "images").iterdir())))
else:
    for path in sorted(Path(first).iterdir()):
        capture, out = Path(second) / path.name.rsplit("-", 1)[0], Path(second) / path.name
        if not capture.is_dir() or out.is_dir():
            continue
        (out / "images").mkdir(parents=True)
        shutil.copytree(path / "sparse", out / "sparse")
        for line in (path / "names.txt").read_text().splitlines():
            name, original = line.split("\t")
            shutil.copyfile(capture / "images" / original, out / "images" / name)
