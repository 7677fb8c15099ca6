"""``sundae distill``: a small scene of any other, trained on the images of the full one."""

from __future__ import annotations

import sys
from pathlib import Path

from sundae_ns.cli.inputs import chosen_cameras, warn_if_few
from sundae_ns.cli.options import Out, Overwrite, Scene, Share, check_exclusive, check_file, check_suffix, progress_bar
from sundae_ns.core.errors import ConfigError
from sundae_ns.rasterize.interface import fastest_device
from sundae_ns.scene.load_save import SUFFIXES, load, save
from sundae_ns.scene.virtual_cameras import virtual_cameras


def distill(
    source: Scene,
    out: Out,
    keep: Share | None = None,
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
        keep: share of the Gaussians to keep, 0.25 or 25%; by default 0.1.
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

    warn_if_few(count, scene.num_gaussians)
    partial = out.with_name(f"{out.name}.partial")
    given = None if cameras is None else chosen_cameras(scene, cameras, None) or virtual_cameras(scene, None, seed=seed)
    training = Distillation(
        scene, keep=keep, count=count, cameras=given, steps=steps, seed=seed, head=head, progress=True
    )
    if partial.exists():
        training.load(partial)
        print(f"resuming after step {training.step:,} of {training.steps:,}, with {partial}", file=sys.stderr)
    stopped: list[bool] = []
    with Interruption(lambda: stopped.append(True)), progress_bar() as bar:
        task = bar.add_task("Training", total=None)

        def after_step(done: int, total: int) -> bool:
            bar.update(task, completed=done, total=total)
            return not stopped

        finished = training.train(after_step)
    if not finished:
        said = "nothing is saved yet: the trial of the head had not ended"
        if training.step > 0:
            training.save(partial)
            said = f"saved step {training.step:,} of {training.steps:,} as {partial}; the same command resumes"
        print(f"sundae: interrupted; {said}", file=sys.stderr)
        return 130
    result = training.result()
    save(result, out)
    partial.unlink(missing_ok=True)
    counts = f"{result.num_gaussians:,} of {scene.num_gaussians:,} Gaussians"
    print(f"{out}: {counts}, {'with' if result.head else 'without'} a head")
    if training.gain is not None:
        print(f"a head gained {training.gain:.2f} dB in its trial, on cameras that no step sees")
    quality = f"{training.quality():.2f} dB against the full scene on {len(training.held_out)} cameras"
    print(f"{quality} that no step sees; {out.stat().st_size:,} bytes")
    return 0
