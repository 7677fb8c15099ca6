"""``sundae prune``: a scene of any program with fewer Gaussians, without its photos."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
import tyro

from sundae_ns.cli.inputs import Edit, opened
from sundae_ns.cli.options import Advanced, Flag, Float, Int, Out, Plain, Scene, SceneDetails, Wishes, progress_bar
from sundae_ns.cli.refusals import check_exclusive, check_file, check_least, check_suffix
from sundae_ns.core.errors import CheckpointError, ConfigError, reading
from sundae_ns.pruning.rule import PruneRule, ScoreName
from sundae_ns.rasterize.interface import fastest_device
from sundae_ns.scene.compose import LEAST_SEEN, OTHERS
from sundae_ns.scene.load_save import SUFFIXES


@dataclass
class RuleOptions(PruneRule):
    """The rule, with scores that have a name."""

    score: ScoreName = "detail-contribution"
    """How Gaussians are ranked: by what they blend where others cannot show the detail, or by high-pass response."""
    seed: tyro.conf.Suppress[int] = 0  # one for all draws of a command


@dataclass(frozen=True)
class PruneDetails(SceneDetails):
    """Options that few need."""

    num_cameras: Int = None
    """number of virtual cameras, for scenes that come without cameras; by default 128, on a GPU 256."""
    steps: Int = None
    """number of training steps of --distill; by default 8,000 on a GPU, 3,000 on a CPU."""
    rule: Plain[RuleOptions] = field(default_factory=RuleOptions)


def prune(
    source: Scene,
    out: Out,
    wishes: Plain[Wishes] = Wishes(),  # noqa: B008
    target_drop: Float = None,
    distill: Flag = False,
    advanced: Advanced[PruneDetails] = PruneDetails(),  # noqa: B008
) -> int:
    """Prune a scene of any program, without its photos; by default to a tenth of its Gaussians.

    Kept are the Gaussians that virtual cameras see most of; the others are merged into them, and some steps fit pairs
    to the scene's own images. On a CPU half a million Gaussians of SH degree 3 take about 2.2 GB.

    Args:
        out: result, by its suffix .ply, .spz, .sog, .glb, .sundae or .html; a .ply of a binary one keeps all columns.
        target_drop: keep as few as lose at most this PSNR, in dB, of a full scene that shows its photos at 30 dB; by
            the images of held-out cameras.
        distill: train what is kept on the full scene's images, from cameras near the scene's or virtual ones, with a
            head if cameras that no step sees show that it pays. Ctrl-C saves; the same command resumes.
    """
    wishes.check_wishes(target_drop=target_drop)
    check_least(target_drop=(target_drop, 0.001), num_cameras=(advanced.num_cameras, 1))
    check_exclusive(distill=distill or None, target_drop=target_drop)
    with_head = check_suffix(out, SUFFIXES) in (".sundae", ".html")
    if advanced.steps is not None and not distill:
        raise ConfigError("--steps belongs to --distill; add it, or leave them out")
    if distill and not with_head and not advanced.no_head:
        raise ConfigError(f"{out} cannot hold a head; name it .sundae, or leave the head out with --no-head")
    if advanced.start_view is not None and not with_head:
        raise ConfigError(f"{out.suffix} files hold no start view; leave it out, or name a .sundae or .html")
    if not wishes.reduces and target_drop is None:
        wishes = replace(wishes, keep=0.1)
    check_file(out, reads=[source, advanced.cameras], overwrite=advanced.overwrite)
    advanced.rule.validate()
    before = opened(source, wishes, advanced)
    if distill:
        if code := _distilled(before.cleaned(), out, advanced.steps):
            return code
    else:
        left = before.reduced(out, rule=advanced.rule, num_cameras=advanced.num_cameras, target_drop=target_drop)
        left.write(out)
        print(f"{out}: {left.scene.num_gaussians:,} of {len(left.rows):,} Gaussians")
        if left.pruned is not None and left.pruned.seen_share is not None:
            what = f"; {OTHERS}" if before.cameras and left.pruned.seen_share < LEAST_SEEN else ""
            print(f"{len(left.cameras)} cameras see {left.pruned.seen_share:.1%} of the Gaussians{what}")
    before.print_cost(out)
    return 0


def _distilled(edit: Edit, out: Path, steps: int | None) -> int:
    """Train a smaller scene on images of the full one, and save it; its exit code."""
    from sundae_ns.plugin.distill import Distillation  # imports nerfstudio, which takes seconds
    from sundae_ns.train.progress import Interruption

    details, wishes, scene = edit.details, edit.wishes, edit.scene.to(fastest_device())
    count, partial = wishes.count, out.with_name(f"{out.name}.partial")
    sized = edit._replace(wishes=Wishes(max_mb=wishes.max_mb))
    if wishes.max_mb is not None and partial.exists():  # on a GPU a search may not repeat itself
        with reading(partial, "a checkpoint of this scene", CheckpointError, remedy="remove it to start anew"):
            count = torch.load(partial, map_location="cpu", weights_only=True)["options"]["counts"][1]
    elif wishes.max_mb is not None:
        count = len(sized.reduced(out).scene)
    options: dict[str, Any] = {"keep": wishes.keep, "count": count, "steps": steps, "head": not details.no_head}
    options |= {"cameras": details.cameras and edit.cameras, "seed": details.seed or 0, "progress": True}
    training = Distillation(scene, **options)
    if partial.exists():
        training.load(partial)
        print(f"resuming after step {training.step:,} of {training.steps:,}, with {partial}", file=sys.stderr)
    with Interruption(lambda: None) as interruption, progress_bar() as bar:
        task = bar.add_task("Training", total=None)

        def after_step(done: int, total: int) -> bool:
            bar.update(task, completed=done, total=total)
            return interruption.number == 0

        finished = training.train(after_step)
    if not finished:
        message = "nothing is saved yet: the trial of the head had not ended"
        if training.step > 0:
            training.save(partial)
            message = f"saved step {training.step:,} of {training.steps:,} as {partial}; the same command resumes"
        print(f"sundae: interrupted; {message}", file=sys.stderr)
        return 130
    rows = torch.ones(training.state.gaussians.num_gaussians, dtype=torch.bool)
    left = sized._replace(source=partial, scene=training.result(), rows=rows).reduced(out)
    left.write(out)
    partial.unlink(missing_ok=True)
    gain = training.gain and f"; it gained {training.gain:.2f} dB in its trial, on cameras that no step sees"
    kept = f"{len(left.scene):,} of {len(scene):,} Gaussians, {'with' if left.scene.head else 'without'} a head"
    print(f"{out}: {kept}{gain or ''}")
    return 0
