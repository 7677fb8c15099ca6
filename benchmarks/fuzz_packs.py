"""Change packed scenes behind valid checksums, and compare the verdicts of both readers; print one JSON line.

    python benchmarks/fuzz_packs.py --count 5000               # needs Node and the page's build tools (make web)
    python benchmarks/fuzz_packs.py --count 1 --seed 1234 --keep folder

Each seed changes header, arrays, streams or frames of a small scene (``harness/pack_changes.py``). Python opens the
result and, if it is valid, makes the page of it. The page's decoder opens it under Node. Exits with 1 if the verdicts
differ, if both decode other positions, cameras or weights, or if either fails with another error than its own.
"""

from __future__ import annotations

import argparse
import faulthandler
import hashlib
import json
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import torch
from bench_page import WEB, bundled

import sundae_ns as sn
from harness.pack_changes import Json, Pack, mutated
from sundae_ns.core.errors import SundaeError
from sundae_ns.core.gaussians import Gaussians
from sundae_ns.head.head import CompensationHead, HeadConfig
from sundae_ns.io.pack.packed_scene import read_scene
from sundae_ns.scene.packing import scene_of
from sundae_ns.scene.page import packed_of, page_of
from sundae_ns.scene.scene import from_points

SECONDS = 60  # time limit of one verdict; it takes milliseconds, so only a hang reaches it, and ends the script
POINTS = 60
LENS = ("fx", "fy", "cx", "cy", "width", "height")


class Verdict(NamedTuple):
    """What a reader makes of a file: an error message, or what it has decoded."""

    error: str | None
    content: Json
    failed: bool = False
    """Whether the reader ended with an error that is not its own."""


def scenes() -> list[Pack]:
    """Small scenes of every kind: harmonics, logits, antialiased, and both heads."""
    residual, features = ("residual", 1, 3), ("features", 2, 4)
    kinds = [(3, None), (0, None), (1, residual), (4, None), (1, features), (2, None)]
    return [Pack.of(packed_of(_scene(*kind))) for kind in kinds]


def _scene(degree: int, kind: tuple[Any, int, int] | None) -> sn.Scene:
    torch.manual_seed(degree)
    points, width = torch.rand(POINTS, 3) - 0.5, kind[2] if kind else 1
    gaussians = from_points(points, torch.rand(POINTS, 3), sh_degree=degree)
    gaussians["features_rest"] = 0.2 * torch.randn(POINTS, (degree + 1) ** 2 - 1, 3)
    gaussians["quats"] = torch.randn(POINTS, 4)
    head = None
    if kind is not None:
        gaussians["features"] = torch.randn(POINTS, width)
        head = CompensationHead(HeadConfig(mode=kind[0], size="tiny", pixel_unshuffle=kind[1], num_features=width))
        for value in head.parameters():  # few that are not zero: zeros decode fast
            value.data *= torch.rand_like(value) < 0.002
    pose = torch.eye(4)
    pose[2, 3] = 2.0
    near = pose.clone()
    near[2, 3] = 0.3
    cameras = tuple(sn.Camera.from_pose(each, (20.0, 21.0, 12.0, 9.0), 24, 18) for each in (pose, near))
    return sn.Scene(
        Gaussians(gaussians, "harmonics" if degree else "logits"),
        head,
        background_color=("black", "white", "random")[degree % 3],  # type: ignore[arg-type]
        antialiased=degree == 4,
        trained_focal=(20.0, 21.0) if head else None,
        cameras=cameras,
        up=(0.6, 0.0, -0.8) if degree % 2 else None,
        start=cameras[1] if degree % 2 else None,
        in_model_frame=True,
        meta={"source": {"method": "sundae", "step": 9}, "frame": {"transform": torch.eye(4).tolist(), "scale": 1.0}},
    )


def python_verdict(path: Path) -> Verdict:
    """The verdict of Python's reader, which also makes the page of a valid file."""
    faulthandler.dump_traceback_later(SECONDS, exit=True, file=2)
    try:
        packed = read_scene(path)
        scene = scene_of(packed)
        page_of(("a", scene, b""))
    except Exception as error:
        ours = isinstance(error, SundaeError) and "\n" not in str(error) and len(str(error)) < 600
        return Verdict(str(error) if ours else f"{type(error).__name__}: {error}", None, failed=not ours)
    finally:
        faulthandler.cancel_dump_traceback_later()
    digest = hashlib.sha256(packed.gaussians["means"].numpy().tobytes())
    for name in sorted(packed.head):
        digest.update(packed.head[name].contiguous().numpy().tobytes())
    cameras = packed.cameras or dict.fromkeys(("poses", "intrinsics", "sizes"), torch.zeros(0))
    for pose, lens, size in zip(cameras["poses"], cameras["intrinsics"], cameras["sizes"], strict=True):
        digest.update(torch.cat([pose.reshape(-1).double(), lens, size.double()]).numpy().tobytes())
    rest, start = packed.gaussians["features_rest"].shape[1], packed.meta.get("start")
    content = {
        "digest": digest.hexdigest(),
        "degree": round((rest + 1) ** 0.5) - 1,
        "logits": scene.gaussians.encoding == "logits",
        "antialiased": scene.antialiased,
        "background": [round(float(value), 4) for value in scene.background],
        "trainedFocal": list(scene.trained_focal) if scene.trained_focal else None,
        "up": packed.meta.get("up"),
        # As the page has it.
        "start": start and {"pose": sum(start["pose"], []), **dict(zip(LENS, [*start["intrinsics"], *start["size"]]))},
    }
    assert (scene.up is None, scene.start is None) == (content["up"] is None, start is None)
    return Verdict(None, content)


@contextmanager
def page_verdicts(folder: Path) -> Iterator[Callable[[Path], Verdict]]:
    """The verdicts of the page's decoder, by one process of Node."""
    program = bundled("judge.ts", folder / "judge.mjs", "--platform=node")
    with subprocess.Popen(["node", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        ask, answers = process.stdin, process.stdout

        def judge(path: Path) -> Verdict:
            ask.write(f"{path}\n")
            ask.flush()
            found = json.loads(answers.readline())
            if "digest" in found:
                return Verdict(None, found)
            return Verdict(found.get("error", found.get("traceback")), None, failed="traceback" in found)

        yield judge
        ask.close()


def problem_of(python: Verdict, page: Verdict) -> str | None:
    """What is wrong with the verdicts of one file; None if both agree."""
    for reader, verdict in (("python", python), ("page", page)):
        if verdict.failed:
            return f"{reader} fails: {verdict.error}"
    if (python.error is None) != (page.error is None):
        return f"python: {python.error or 'valid'}; page: {page.error or 'valid'}"
    return None if python.content == page.content else f"python has {python.content}, page has {page.content}"


def run(count: int, seed: int = 0, keep: Path | None = None) -> tuple[Counter[str], list[str]]:
    """Judge ``count`` files from a seed on; the numbers of verdicts, and a line for each file on which both differ."""
    tally: Counter[str] = Counter()
    problems = []
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        goods = scenes()
        with page_verdicts(folder) as page_verdict:
            for i in range(seed, seed + count):
                path = folder / "a.sundae"
                path.write_bytes(mutated(goods[i % len(goods)], i))
                python, page = python_verdict(path), page_verdict(path)
                tally["valid" if python.error is None else "refused"] += 1
                problem = problem_of(python, page)
                if problem is not None:
                    problems.append(f"seed {i}: {problem}")
                if keep is not None and (problem is not None or count == 1):
                    keep.mkdir(parents=True, exist_ok=True)
                    shutil.copy(path, keep / f"{i}.sundae")
    return tally, problems


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=5000, help="number of changed files")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first one")
    parser.add_argument("--keep", type=Path, help="folder for files on which the readers differ")
    options = parser.parse_args()
    if shutil.which("node") is None or not (WEB / "node_modules").is_dir():
        sys.exit("the page's decoder needs Node and its build tools; run make web")
    torch.set_num_threads(1)
    started = time.perf_counter()
    tally, problems = run(options.count, options.seed, options.keep)
    print("\n".join(problems), file=sys.stderr)
    row = {"benchmark": "fuzz_packs", "files": options.count, "seed": options.seed, **tally}
    print(json.dumps({**row, "differences": len(problems), "seconds": round(time.perf_counter() - started)}))
    sys.exit(1 if problems else 0)


if __name__ == "__main__":
    main()
