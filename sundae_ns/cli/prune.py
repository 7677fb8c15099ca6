"""``sundae prune``: a scene of any program with fewer Gaussians, without its photos."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from sundae_ns.cli.inputs import Cleaning, chosen_cameras, copies_rows, warn_if_few
from sundae_ns.cli.options import Out, Overwrite, Scene, Share, check_exclusive, check_file, check_suffix
from sundae_ns.cuda.kernels import naming_full_memory
from sundae_ns.io.ply import keep_vertices
from sundae_ns.pruning.rule import PruneRule, ScoreName
from sundae_ns.rasterize.interface import fastest_device
from sundae_ns.scene import prune_scene as pruning
from sundae_ns.scene.load_save import SUFFIXES, load_with_mask, save
from sundae_ns.scene.prune_scene import within
from sundae_ns.scene.virtual_cameras import virtual_cameras


@dataclass
class RuleOptions(PruneRule):
    """The rule, with scores that have a name."""

    score: ScoreName = "detail-contribution"
    """Importance of a Gaussian: its blending weight over the cameras, with pixels weighted by the detail that the kept
    Gaussians cannot show (detail-contribution), or its high-pass response (response)."""


def prune(
    source: Scene,
    out: Out,
    keep: Share | None = None,
    count: int | None = None,
    target_drop: float | None = None,
    num_cameras: int | None = None,
    cameras: Path | None = None,
    overwrite: Overwrite = False,
    rule: Annotated[RuleOptions, tyro.conf.arg(name="")] = RuleOptions(),  # noqa: B008
    cleaning: Annotated[Cleaning, tyro.conf.arg(name="")] = Cleaning(),  # noqa: B008
) -> int:
    """Prune a scene of any program, without its photos.

    Kept are the Gaussians that virtual cameras see most of; the others are merged into them, and some steps fit pairs
    to the scene's own images. On a CPU a million Gaussians with three bands of harmonics take about 1.7 GB.

    Args:
        out: file to write, in the format of its suffix: .ply, .spz, .sog, .glb or .sundae. A .ply of a .ply keeps all
            properties and comments.
        keep: share of the Gaussians to keep, of those that a box and the floaters leave, 0.25 or 25%; by default 0.1.
        count: number of Gaussians to keep, in place of a share.
        target_drop: keep as few as lose at most this PSNR, in dB, of a full scene that shows its photos at 30 dB; by
            the images of held-out cameras.
        num_cameras: number of virtual cameras, for scenes that come without cameras; by default 128, on a GPU 256.
        cameras: a transforms.json, a COLMAP model (sparse/0), a camera path, a run or a packed scene, in place of the
            scene's own or virtual cameras.
    """
    check_exclusive(keep=keep, count=count, target_drop=target_drop)
    if target_drop is None:
        keep = 0.1 if keep is None and count is None else keep
        pruning.check_amount(keep, count)
    check_suffix(out, SUFFIXES)
    check_file(out, reads=[source, cameras], overwrite=overwrite)
    rule.validate()
    scene, usable = load_with_mask(source)
    total = scene.num_gaussians if usable is None else len(usable)
    with naming_full_memory(lambda: total):
        scene, used, clean = scene.to(fastest_device()), None, None
        looks_around = rule.uses_contribution or target_drop is not None
        given = chosen_cameras(scene, cameras, num_cameras) if looks_around or cleaning.remove_floaters else ()
        if cleaning.chosen:
            clean = cleaning.mask(scene, given)
            scene = scene[clean]
        warn_if_few(count, scene.num_gaussians)
        if looks_around:
            used = given or virtual_cameras(scene, num_cameras, seed=rule.seed)
        if target_drop is not None and used is not None:
            count, curve = pruning.count_for_drop(scene, target_drop, used, rule, progress=True)
            for number, psnr in curve:
                print(f"{number:12,} Gaussians: {psnr:.2f} dB against the full scene, on held-out cameras")
        pruned = pruning.prune_with_mask(scene, keep, count, used, rule, progress=True)
    small = pruned.scene.to("cpu")
    if copies_rows(source, out):
        rows = within(usable, within(clean, pruned.mask).cpu())
        keep_vertices(source, out, rows, small.gaussians if rule.redistribution == "merge" else None)
    else:
        save(small, out)
    print(f"{out}: {small.num_gaussians:,} of {total:,} Gaussians")
    if pruned.seen is not None and used:
        print(f"{len(used)} cameras see {pruned.seen:.1%} of the Gaussians")
    return 0
