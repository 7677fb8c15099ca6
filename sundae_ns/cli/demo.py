"""``sundae demo``: what ``sundae run`` does, on the embedded capture."""

from __future__ import annotations

import shutil
from pathlib import Path

from sundae_ns.cli.options import Input, Int, Overwrite
from sundae_ns.cli.refusals import check_folder, check_least
from sundae_ns.cli.run import Project, carry_out
from sundae_ns.cli.train import TrainOptions
from sundae_ns.core.errors import writing
from sundae_ns.data.capture_files import write_demo_capture


def demo(out: Input = Path(".demo"), steps: Int = None, overwrite: Overwrite = False) -> int:
    """Write the embedded capture, train it with ns-train, pack it, compare it with its photos, and write its page.

    Args:
        out: folder for the capture, the run, the packed scene, the report and the page.
        steps: number of training steps; by default that of sundae-tiny.
    """
    check_folder(out, reads=[], overwrite=overwrite)
    check_least(steps=(steps, 1))
    train = TrainOptions(method="sundae-tiny", steps=steps)
    # Where no training view looks, above all beside the sky, a dark background shows as stains.
    project = Project(out / "scene", out, train=train, more=("--pipeline.model.background-color", "white"))
    with writing(f"cannot write to {out}"):
        write_demo_capture(project.photos)
        shutil.rmtree(project.run, ignore_errors=True)  # of an earlier demo
    return carry_out(project)
