"""nerfstudio's viewer in a headless Chromium, while training; print one JSON line.

    python benchmarks/browser.py --seconds 300          # needs a Chromium (apt-get install chromium)

Trains with the viewer open, moves the camera and uses the controls, and watches the render thread and memory. Exits
with 1 if the viewer falls silent, a log has an error, training stands still, or the training process still grows by
more than ``--allowed`` megabytes a minute in the second half.
"""

from __future__ import annotations

import argparse
import itertools
import json
import random
import re
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch

from harness.chromium import find_chromium, wait_for
from harness.still_life import write_still_life
from harness.viewer_page import Server, ViewerPage

PRUNE_AT = 300
STEP = re.compile(r"(\d+) \(\d+\.\d+%\)")
"""nerfstudio's table of progress."""
SLICE = 30.0
"""In every period of this many seconds images must arrive."""


def last_step(log: str) -> int:
    """Last step in the log; -1 before the first."""
    found = STEP.findall(log[-20_000:])
    return int(found[-1]) if found else -1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--allowed", type=float, default=5.0, help="megabytes a minute")
    options = parser.parse_args()
    chromium = find_chromium()
    if chromium is None:
        sys.exit("no Chromium here; apt-get install chromium")
    chance = random.Random(0)
    with tempfile.TemporaryDirectory() as folder:
        size = {"train_views": 8, "test_views": 2, "width": 64, "height": 64, "points": 300}
        scene = write_still_life(Path(folder) / "scene", **size)
        words = ["ns-train", "sundae-tiny", "--data", scene, "--output-dir", Path(folder) / "out", "--vis", "viewer"]
        words += ["--max-num-iterations", 10_000_000, "--steps-per-save", 10_000_000, "--logging.steps-per-log", 10]
        words += ["--pipeline.model.pruning.prune-at", PRUNE_AT, "--pipeline.model.warmup-length", 5]
        server = Server(words, Path(folder) / "train.log", "(0.00%)")
        training = psutil.Process(server.process.pid)
        try:
            with ViewerPage(chromium, 640, 400) as page:
                wait_for(server.listens, "ns-train", 180)
                page.open(server.address)
                wait_for(lambda: bool(page.images), "the first image", 60)
                wait_for(lambda: last_step(server.output()) > PRUNE_AT, "the prune", 300)
                page.press("Hide Train Cams")
                outputs = page.options("Output type")
                acts: Any = itertools.cycle(
                    [
                        *((page.choose, "Output type", name) for name in (*outputs, outputs[0])),
                        (page.tick, "Neural compensation", False),
                        *((page.slide, "Keep ratio", ratio) for ratio in (0.3, 0.05, 1.1)),
                        (page.tick, "Neural compensation", True),
                    ]
                )
                start, first_step = time.monotonic(), last_step(server.output())
                samples, arrived, acted, next_act = [], [len(page.images)], 0, start
                while (now := time.monotonic()) < start + options.seconds:
                    if now >= next_act:
                        act, *words = next(acts)
                        act(*words)
                        acted, next_act = acted + 1, now + 5
                    page.drag(200, 250, 200 + chance.uniform(-80, 80), 250 + chance.uniform(-30, 30), seconds=0.5)
                    samples.append((now - start, training.memory_info().rss / 1e6, last_step(server.output())))
                    if now - start > SLICE * len(arrived):
                        arrived.append(len(page.images))
                arrived.append(len(page.images))
                errors = list(page.errors)
            listening, complaints = server.listens(), server.complaints()
        finally:
            server.stop()

    seconds, memory, steps = np.array(samples, dtype=float).T
    late = seconds > seconds[-1] / 2
    growth = float(np.polyfit(seconds[late], memory[late], 1)[0]) * 60
    slices = np.diff(arrived).tolist()
    moves = {"controls_used": acted, "camera_moves": len(samples), "images": arrived[-1] - arrived[0]}
    result: dict[str, object] = {"seconds": round(float(seconds[-1]), 1), "steps": int(steps[-1]) - first_step, **moves}
    result |= {"images_in_the_poorest_30_s": min(slices), "page_errors": errors, "log_errors": complaints}
    points = {"first": memory[0], "middle": memory[late][0], "last": memory[-1], "a_minute_second_half": growth}
    result |= {f"host_mb_{name}": round(float(value), 2) for name, value in points.items()}
    result["device"] = torch.cuda.get_device_name(0) if torch.cuda.is_available() else "cpu"
    print(json.dumps(result))
    stuck = min(slices) == 0 or steps[-1] <= steps[late][0]
    sys.exit(int(stuck or bool(errors) or bool(complaints) or not listening or growth > options.allowed))


if __name__ == "__main__":
    main()
