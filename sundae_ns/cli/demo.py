"""``sundae demo``: train the shipped capture with nerfstudio's command, and evaluate it."""

from __future__ import annotations

import json
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Annotated

import torch
import tyro
from rich.console import Console

from sundae_ns.cli.options import Overwrite
from sundae_ns.cli.process import quoted, run_command, word
from sundae_ns.cli.refusals import check_folder, check_least
from sundae_ns.core.errors import writing
from sundae_ns.core.files import write_bytes, write_text
from sundae_ns.core.metrics import Lpips
from sundae_ns.data.capture_files import write_demo_capture
from sundae_ns.io.run_folder import prunes_of

METHOD = "sundae-tiny"


def demo(
    out: Annotated[Path, tyro.conf.Positional] = Path(".demo"), steps: int | None = None, overwrite: Overwrite = False
) -> int:
    """Write the embedded capture, train it with ns-train, evaluate it, and print the results.

    Args:
        out: folder for the capture, the run, the packed scene and its page.
        steps: number of training steps; by default that of sundae-tiny.
    """
    check_folder(out, reads=[], overwrite=overwrite)
    check_least(steps=(steps, 1))
    console = Console()
    scene, run = out / "scene", out / "runs" / "demo" / METHOD / "run"
    device = torch.cuda.get_device_name(0) if torch.cuda.is_available() else "CPU"
    console.print(f"SUNDAE demo on {device}: train a small scene with ns-train, and evaluate it.")
    with writing(f"cannot write to {out}"):
        write_demo_capture(scene)
    train = ["ns-train", METHOD, "--data", word(scene), "--output-dir", word(out / "runs")]
    train += ["--experiment-name", "demo", "--timestamp", "run"]
    # Where no training view looks, above all beside the sky, a dark background shows as stains.
    train += ["--pipeline.model.background-color", "white"]
    train += [] if steps is None else ["--max-num-iterations", str(steps)]
    (run / "prune.json").unlink(missing_ok=True)  # of an earlier demo
    if code := run_command(train, out / "train.log"):
        return code
    # nerfstudio prints messages while it imports and loads.
    with console.status("Evaluating"), open(out / "measure.log", "w", encoding="utf-8") as log:
        with redirect_stdout(log), redirect_stderr(log):
            from sundae_ns.plugin.finished_runs import load_model, load_run
            from sundae_ns.report.measure import Subject, markdown, measure
            from sundae_ns.scene.page import packed_of, write_page

            subject = Subject.of_run(load_model(run))
            measured = measure(subject, label="demo", lpips=Lpips(), warmup=1, repeats=3)
            write_text(out / "eval.json", json.dumps(measured.as_json(), indent=2) + "\n")
            finished = load_run(run)
            packed = packed_of(finished)
            write_bytes(out / "scene.sundae", packed)
            write_page(out / "scene.html", ("sundae demo", finished, packed))

    (prune,) = prunes_of(run)[-1:] or [{"before": measured.primitives, "after": measured.primitives}]
    for name, count, means in (("warm up", prune["before"], "warm_up"), ("pruned", prune["after"], "pruned")):
        if means in prune:
            print(f"{name}: {count:,} Gaussians, {prune[means]['psnr']:.2f} dB, SSIM {prune[means]['ssim']:.4f}")
    print(markdown({f"The end, on {len(measured.full.views)} test views": [measured]}, []), end="")
    print(f"Kept: {prune['after'] / max(prune['before'], 1):.1%} of the Gaussians. Packed: {len(packed) / 1e6:.2f} MB.")
    console.print(f"In a browser: {out / 'scene.html'}   View: ns-viewer --load-config {quoted(run / 'config.yml')}")
    return 0
