"""``sundae distill``: a small scene of any other, trained on the images of the full one."""

from __future__ import annotations

import shlex
import sys
import time
from pathlib import Path
from typing import Annotated

import tyro

from sundae_ns.cli.files import cameras_for, check_one
from sundae_ns.cli.outputs import Overwrite, check_file
from sundae_ns.cli.process import loading

_TIMED = 10
"""Steps after which the expected time is known."""


def distill_file(
    source: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    keep: float | None = None,
    count: int | None = None,
    steps: int | None = None,
    head: bool = True,
    seed: int = 0,
    cameras: Path | None = None,
    overwrite: Overwrite = False,
) -> int:
    """Prune a scene of any program, and train the rest on the images of the full one; no photos are needed.

    Each step has a virtual camera of its own, and the full field renders what it should see. A head is added if cameras
    that no step sees show that it pays. Ctrl-C saves; the same command goes on.

    Args:
        source: a .ply, .spz, .sog, .glb, .splat, .ksplat or gsplat's .pt, a packed scene, or a run.
        out: file to write, in the format of its suffix: .sundae, or without a head .ply, .spz or .sog.
        keep: share of the primitives to keep, in (0, 1]; by default 0.1.
        count: number of primitives to keep, in place of a share.
        steps: number of training steps; by default 8,000 on a GPU, 3,000 on a CPU.
        head: whether a head may be added; without one the scene is complete in other viewers.
        seed: random seed.
        cameras: a transforms.json, a COLMAP model (sparse/0), a camera path, a run or a packed scene, whose cameras the
            steps begin from in place of virtual ones.
        overwrite: replace an existing file, once the new one is complete.
    """
    from sundae_ns.api import files
    from sundae_ns.errors import ConfigError, writing

    check_one({"--keep": keep, "--count": count})
    suffix = out.suffix.lower()
    if suffix not in files.SUFFIXES:
        raise ConfigError(f"{out} has no supported suffix; name it {', '.join(files.SUFFIXES)}")
    if head and suffix not in (".sundae", ".html"):
        raise ConfigError(f"{out} cannot hold a head; name it .sundae, or leave the head out with --no-head")
    check_file(out, reads=[source, cameras], overwrite=overwrite)
    scene = files.load(source)
    with loading():
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        from sundae_ns.rasterization import fastest_device
        from sundae_ns.scenes.distill import Distillation
        from sundae_ns.training.interruption import Interruption
        from sundae_ns.training.progress import duration

    device = fastest_device()
    scene = scene.to(device)
    partial = out.with_name(f"{out.name}.partial")
    console = Console(stderr=True)
    views = cameras_for(scene, cameras, None, seed) if cameras is not None else None
    made = Distillation(scene, keep=keep, count=count, views=views, steps=steps, seed=seed, head=head, progress=True)
    if partial.exists():
        made.load(partial)
        console.print(f"going on from step {made.step:,} of {made.steps:,}, with {partial}", highlight=False)
    before, kept = scene.num_primitives, made.state.field.num_primitives
    stopped: list[bool] = []
    columns = (TextColumn("Training"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Interruption(lambda: stopped.append(True)), Progress(*columns, console=console, transient=True) as progress:
        task, began = progress.add_task("", total=None), [0, time.monotonic()]

        def after_step(done: int, total: int) -> bool:
            if began[0] == 0:
                began[:] = [done, time.monotonic()]  # the first step compiles
            elif done == began[0] + _TIMED:
                left = (time.monotonic() - began[1]) / _TIMED * (total - done)
                place = "the GPU" if device.type == "cuda" else "the CPU"
                console.print(
                    f"{before:,} to {kept:,} primitives, {total - done:,} steps on {place}: about {duration(left)}",
                    highlight=False,
                )
            progress.update(task, completed=done, total=total)
            return not stopped

        whole = made.train(after_step)
    if not whole:
        if made.step == 0:
            print("nothing is saved yet: the trial of the head had not ended", file=sys.stderr)
            return 130
        with writing(f"cannot write {partial}"):
            made.save(partial)
        print(f"saved step {made.step:,} of {made.steps:,} as {partial}; the same command goes on:", file=sys.stderr)
        print(f"    {shlex.join(['sundae', *sys.argv[1:]])}", file=sys.stderr)
        return 130
    result = made.result()
    files.save(result, out)
    partial.unlink(missing_ok=True)
    print(f"{out}: {kept:,} of {before:,} primitives, {'with' if result.head else 'without'} a head")
    if made.gain is not None:
        print(f"a head gained {made.gain:.2f} dB in its trial, on cameras that no step sees")
    psnr = made.quality()
    print(f"{psnr:.2f} dB against the full field on {len(made.held_out)} such cameras; {out.stat().st_size:,} bytes")
    return 0
