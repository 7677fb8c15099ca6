"""Run commands on a disk that is full, or gets full while they write; print one JSON line.

    python benchmarks/full_disk.py                    # every command, at three levels of free space each
    python benchmarks/full_disk.py --only train pack

The disk is a small tmpfs in a mount namespace of this script, which needs ``unshare`` and either root or user
namespaces. A first run of a command says what it writes and how much. Then older results lie there, and the disk has
room for none, a third and nearly all of it. The command must end with one line that names the full disk, leave the
older results as they were and nothing beside them, and succeed once there is room. A training must leave its older
checkpoint whole and resume to the same result. Exits with 1 if anything was lost. Commands take a GPU if there is one.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from ray_tracing import write_still_life

DISK = 32 << 20
"""Bytes of the small disk."""
LEVELS = (0.0, 0.33, 0.9)
"""Free space, as shares of what a command writes."""
STEPS = 60
TRAIN = f"""
--experiment-name e --timestamp t --vis tensorboard --viewer.quit-on-train-completion True --steps-per-eval-image 1000
--max-num-iterations {STEPS} --steps-per-save 20 --pipeline.model.pruning.prune-at 30 --pipeline.model.warmup-length 5
--pipeline.model.refine-every 10 --pipeline.model.sh-degree-interval 20
"""


def inside() -> None:
    """Start this script again in a mount namespace of its own, unless it is there already."""
    if os.environ.get("SUNDAE_NAMESPACE"):
        return
    words = ["unshare", "--mount"] if os.geteuid() == 0 else ["unshare", "--mount", "--user", "--map-root-user"]
    os.execvpe("env", ["env", "SUNDAE_NAMESPACE=1", *words, sys.executable, *sys.argv], os.environ)


class Disk:
    """A small disk at a folder.

    Args:
        place: an empty folder.
    """

    def __init__(self, place: Path) -> None:
        self.place, self._ballast = place, place / "ballast"
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK}", "tmpfs", str(place)], check=True)

    @property
    def free(self) -> int:
        """Bytes that can still be written."""
        found = os.statvfs(self.place)
        return found.f_bavail * found.f_frsize

    @contextmanager
    def leaving(self, free: int) -> Iterator[None]:
        """Fill the disk up to ``free`` bytes."""
        with self._ballast.open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, max(self.free - free, 1))
        try:
            yield
        finally:
            self._ballast.unlink()

    def files(self) -> dict[str, bytes]:
        """Contents of all files but the ballast, by path."""
        found = (path for path in sorted(self.place.rglob("*")) if path.is_file() and path != self._ballast)
        return {str(path.relative_to(self.place)): path.read_bytes() for path in found}

    def empty(self) -> None:
        """Remove everything."""
        for path in self.place.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()


def call(*words: object) -> tuple[int, str]:
    """Run an installed command; its exit code, and what it wrote to stdout and stderr."""
    command = shutil.which(str(words[0]), path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    environment = {**os.environ, "COLUMNS": "200", "PYTHONUNBUFFERED": "1"}
    arguments = [command or str(words[0]), *map(str, words[1:])]
    done = subprocess.run(
        arguments, capture_output=True, text=True, env=environment, stdin=subprocess.DEVNULL, check=False
    )
    return done.returncode, done.stdout + done.stderr


def succeeds(*words: object) -> None:
    code, output = call(*words)
    if code != 0:
        raise SystemExit(f"{' '.join(map(str, words))}: exit code {code}\n{output[-3000:]}")


def says_so(code: int, output: str) -> bool:
    """Whether a command failed with one line of ours that names the full disk, and the remedy."""
    errors = [line for line in output.splitlines() if line.startswith("sundae: ")]
    one = len(errors) == 1 and "the disk is full; make room" in errors[0]
    return code not in (0, -9) and one and "Traceback" not in output


def commands(run: Path, ply: Path, packed: Path, disk: Path) -> dict[str, list[object]]:
    """Commands that write to the disk, by a name."""
    return {
        "prune .ply": ["prune", ply, "--views", "4", "-o", disk / "a.ply"],
        "prune .sundae": ["prune", run, "--views", "4", "-o", disk / "a.sundae"],
        "pack": ["pack", run, "-o", disk / "a.sundae"],
        "pack --finetune": ["pack", run, "--finetune", "5", "-o", disk / "a.sundae"],
        "export .ply": ["export", run, "-o", disk / "a.ply"],
        "export .spz": ["export", ply, "-o", disk / "a.spz"],
        "export .sog": ["export", ply, "-o", disk / "a.sog"],
        "export .html": ["export", packed, "-o", disk / "a.html"],
        "export, a folder": ["export", packed, "-o", disk / "page"],
        "render .png": ["render", packed, "--view", "0", "-o", disk / "a.png"],
        "render .mp4": ["render", packed, "-o", disk / "a.mp4"],
        "report": ["report", run, "--repeats", "0", "-o", disk / "report"],
    }


def tried(disk: Disk, words: list[object], exact: bool) -> Counter[str]:
    """Fill the disk under a command at each level; counts of what was tried and of what held."""
    tally: Counter[str] = Counter()
    disk.empty()
    before = disk.free
    succeeds("sundae", *words)
    fresh, size = disk.files(), before - disk.free
    older = {path: b"older " + content[:100] for path, content in fresh.items()}
    for level in LEVELS:
        disk.empty()
        for path, content in older.items():
            (disk.place / path).parent.mkdir(exist_ok=True)
            (disk.place / path).write_bytes(content)
        with disk.leaving(int(level * size)):
            code, output = call("sundae", *words, "--overwrite")
            found = disk.files()
        tally["tried"] += 1
        tally["one line"] += says_so(code, output)
        # A page in a folder is two files, each old or new.
        pair = set(fresh) == {"page/index.html", "page/scene.sundae"}
        tally["older results whole"] += found == older or (
            pair
            and all(found.get(path) in (older[path], fresh[path]) for path in older)
            and found.keys() == older.keys()
        )
        code, output = call("sundae", *words, "--overwrite")
        again = disk.files()
        same = exact and not str(words[-1]).endswith(".mp4")  # threads of the encoder have no fixed order
        tally["succeeds with room"] += code == 0 and (again == fresh if same else again.keys() == fresh.keys())
        if code != 0 or again != fresh:
            changed = [path for path in fresh if again.get(path) != fresh[path]]
            print(f"not as before: {', '.join(changed)}\n{output[-2000:]}", file=sys.stderr)
    return tally


def tried_training(disk: Disk, scene: Path, whole: dict[str, Any], size: int, exact: bool) -> Counter[str]:
    """Trainings whose disk gets full: at their start, before the first save, and at a later one."""
    from sundae_ns.errors import CheckpointError
    from sundae_ns.storage import checkpoint

    tally: Counter[str] = Counter()
    words = ["ns-train", "sundae-tiny", "--data", scene, "--output-dir", disk.place / "out", *TRAIN.split()]
    run = disk.place / "out" / "e" / "sundae-tiny" / "t"
    # A new checkpoint is written before the older one goes.
    for level in (0, size // 2, size + size // 2):
        disk.empty()
        with disk.leaving(level):
            code, output = call(*words)
        tally["tried"] += 1
        tally["one line"] += says_so(code, output)
        try:
            done = int(checkpoint.read_newest(run)[1]["step"]) + 1
        except CheckpointError:
            done = 0
        tally["older results whole"] += (done > 0) == (level > size)
        more = ["--load-dir", run / "nerfstudio_models", "--max-num-iterations", STEPS - done] if done else []
        code, output = call(*words, *more)
        if code != 0:
            print(output[-2000:], file=sys.stderr)
            continue
        found = checkpoint.read_newest(run)[1]["pipeline"]
        tensors = [name for name, value in whole.items() if isinstance(value, torch.Tensor)]
        same = found.keys() == whole.keys() and all(torch.equal(found[name], whole[name]) for name in tensors)
        tally["succeeds with room"] += same or not exact
    return tally


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    names = ["train", *commands(*[Path()] * 4)]
    parser.add_argument("--only", nargs="+", choices=names, default=names, metavar="COMMAND", help=", ".join(names))
    options = parser.parse_args()
    inside()
    from sundae_ns.storage import checkpoint

    exact = not torch.cuda.is_available()  # sums have no fixed order there
    found: dict[str, Counter[str]] = {}
    with tempfile.TemporaryDirectory(prefix="full-disk-") as folder:
        root = Path(folder)
        scene = write_still_life(
            root / "scene", train_views=8, test_views=2, width=64, height=64, points=2000, samples=1
        )
        train = ["--data", scene, "--output-dir", root / "out", *TRAIN.split()]
        succeeds("ns-train", "sundae-tiny", *train)
        run, ply, packed = root / "out" / "e" / "sundae-tiny" / "t", root / "a.ply", root / "a.sundae"
        succeeds("sundae", "export", run, "-o", ply)
        succeeds("sundae", "pack", run, "-o", packed)
        (root / "disk").mkdir()
        disk = Disk(root / "disk")
        try:
            path, loaded = checkpoint.read_newest(run)
            for name in options.only:
                if name == "train":
                    found[name] = tried_training(disk, scene, loaded["pipeline"], path.stat().st_size, exact)
                else:
                    found[name] = tried(disk, commands(run, ply, packed, disk.place)[name], exact)
                print(name, dict(found[name]), file=sys.stderr, flush=True)
        finally:
            subprocess.run(["umount", str(disk.place)], check=True)
    total = sum(found.values(), Counter())
    lost = {name: dict(counts) for name, counts in found.items() if len(set(counts.values())) != 1 or len(counts) != 4}
    device = "cpu" if exact else torch.cuda.get_device_name(0)
    print(json.dumps({"device": device, "commands": list(found), **total, "not held": lost}))
    sys.exit(1 if lost else 0)


if __name__ == "__main__":
    main()
