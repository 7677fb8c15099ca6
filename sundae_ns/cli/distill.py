"""``sundae distill``: a small scene of any other, trained on the images of the full one."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from sundae_ns.cli.inputs import chosen_cameras
from sundae_ns.cli.options import Out, Overwrite, Scene, check_exclusive, check_file, check_suffix
from sundae_ns.core.errors import ConfigError, writing
from sundae_ns.rasterize.interface import fastest_device
from sundae_ns.scene.load_save import SUFFIXES, load, save
from sundae_ns.scene.virtual_cameras import virtual_cameras


def distill(
    source: Scene,
    out: Out,
    keep: float | None = None,
    count: int | None = None,
    steps: int | None = None,
    head: bool = True,
    seed: int = 0,
    cameras: Path | None = None,
    overwrite: Overwrite = False,
) -> int:
    """Prune a scene of any program, and train the rest on the images of the full one; no photos are needed.

    Each step has a virtual camera of its own, and the full scene renders its target. A head is added if cameras that no
    step sees show that it pays. Ctrl-C saves; the same command resumes.

    Args:
        out: file to write, in the format of its suffix: .sundae, or without a head .ply, .spz or .sog.
        keep: share of the Gaussians to keep, in (0, 1]; by default 0.1.
        count: number of Gaussians to keep, in place of a share.
        steps: number of training steps; by default 8,000 on a GPU, 3,000 on a CPU.
        head: whether a head may be added; without one the scene is complete in other viewers.
        seed: random seed.
        cameras: a transforms.json, a COLMAP model (sparse/0), a camera path, a run or a packed scene, whose cameras
            replace virtual ones as the start of each step.
    """
    check_exclusive(keep=keep, count=count)
    if check_suffix(out, SUFFIXES) not in (".sundae", ".html") and head:
        raise ConfigError(f"{out} cannot hold a head; name it .sundae, or leave the head out with --no-head")
    check_file(out, reads=[source, cameras], overwrite=overwrite)
    scene = load(source).to(fastest_device())
    from sundae_ns.plugin.distill import Distillation
    from sundae_ns.train.progress import Interruption

    partial = out.with_name(f"{out.name}.partial")
    console = Console(stderr=True)
    given = None if cameras is None else chosen_cameras(scene, cameras, None) or virtual_cameras(scene, None, seed=seed)
    training = Distillation(
        scene, keep=keep, count=count, cameras=given, steps=steps, seed=seed, head=head, progress=True
    )
    if partial.exists():
        training.load(partial)
        console.print(f"resuming after step {training.step:,} of {training.steps:,}, with {partial}", highlight=False)
    stopped: list[bool] = []
    columns = (TextColumn("Training"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Interruption(lambda: stopped.append(True)), Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("", total=None)

        def after_step(done: int, total: int) -> bool:
            progress.update(task, completed=done, total=total)
            return not stopped

        finished = training.train(after_step)
    if not finished:
        if training.step == 0:
            print("nothing is saved yet: the trial of the head had not ended", file=sys.stderr)
            return 130
        with writing(f"cannot write {partial}"):
            training.save(partial)
        said = f"saved step {training.step:,} of {training.steps:,} as {partial}; the same command resumes:"
        print(f"{said}\n    {shlex.join(['sundae', *sys.argv[1:]])}", file=sys.stderr)
        return 130
    result = training.result()
    save(result, out)
    partial.unlink(missing_ok=True)
    head_text = "with" if result.head else "without"
    print(f"{out}: {result.num_gaussians:,} of {scene.num_gaussians:,} Gaussians, {head_text} a head")
    if training.gain is not None:
        print(f"a head gained {training.gain:.2f} dB in its trial, on cameras that no step sees")
    held_out = f"{len(training.held_out)} cameras that no step sees"
    print(f"{training.quality():.2f} dB against the full scene on {held_out}; {out.stat().st_size:,} bytes")
    return 0
