"""``sundae pack``: convert a scene into one small file."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from functools import cache
from io import StringIO
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import torch
import tyro

from sundae_ns.cli.inputs import Left, chosen_cameras, open_run, print_cost, reduced
from sundae_ns.cli.options import Advanced, Flag, Maybe, Out, Plain, SceneDetails, Wishes, progress_bar
from sundae_ns.cli.refusals import check_drop, check_exclusive, check_file, check_least
from sundae_ns.core.errors import ConfigError, SundaeError
from sundae_ns.core.tables import MEGABYTE
from sundae_ns.io.formats import PRIMITIVES, kind_of_gaussians
from sundae_ns.io.pack.config import FINETUNE_STEPS, FINETUNED, FINETUNED_SIZE, PackConfig
from sundae_ns.io.pack.packed_scene import fit_scene, pack_bytes, write_fitted
from sundae_ns.io.run_folder import files_of
from sundae_ns.scene.cameras import with_start
from sundae_ns.scene.load_save import load
from sundae_ns.scene.packing import contents_of

if TYPE_CHECKING:
    from sundae_ns.io.pack.packed_scene import Codecs, PackedScene
    from sundae_ns.plugin.tuned_packs import Judge


@dataclass(frozen=True)
class PackDetails(SceneDetails):
    """Options that few need."""

    target_drop: Maybe[float] = None
    """find the coarsest steps that lose at most this PSNR on some test views, dB."""
    finetune: int = 0
    """training steps with quantisation in the loop before packing, for example 1000, for a smaller file; the run is not
    changed."""
    max_cameras: int = 100
    """maximum number of training cameras to store for viewers; with 0, the capture is not needed."""
    json: Flag = False
    """print one JSON object in place of the table."""


def pack(
    run: Annotated[Path, tyro.conf.Positional],
    out: Out,
    wishes: Plain[Wishes] = Wishes(),  # noqa: B008
    advanced: Advanced[PackDetails] = PackDetails(),  # noqa: B008
) -> int:
    """Pack a scene into one file that can be rendered; print the size of each part, and the quality before and after.

    Args:
        run: a run of sundae or splatfacto (its folder or config.yml), or a .ply, .spz, .sog, .glb, .splat,
            .ksplat or gsplat's .pt.
        out: file to write, for example scene.sundae.
    """
    finetune, target_drop, data = advanced.finetune, advanced.target_drop, advanced.data
    wishes.check_wishes()
    check_exclusive(max_mb=wishes.max_mb, target_drop=target_drop)
    check_least(max_cameras=(advanced.max_cameras, 0), finetune=(finetune, 0))
    check_drop(target_drop)
    if wishes.cleans and (finetune or target_drop is not None):
        whole = "--finetune and --target-drop look at photos of the whole scene"
        raise ConfigError(f"{whole}; leave out {wishes.cleans}, or cut the scene by `sundae prune` afterwards")
    check_file(out, reads=[*files_of(run), data, advanced.cameras], overwrite=advanced.overwrite)
    kind = kind_of_gaussians(run)
    for name, value in (("--finetune", finetune), ("--target-drop", target_drop), ("--data", data)):
        if kind is not None and value:
            raise ConfigError(f"{run} is a {PRIMITIVES[kind]} without photos; leave out {name}, or give a run")
    tuned, packs = finetune > 0, list[tuple["PackedScene", "Codecs"]]()

    @cache
    def judge() -> Judge:
        from sundae_ns.plugin.tuned_packs import Judge

        return Judge(run, data)

    scene = open_run(run, max_cameras=advanced.max_cameras, data=data) if kind is None else load(run)
    scene = with_start(scene, advanced.start_view, advanced.up)
    before = Left(scene, None, len(scene), cameras=chosen_cameras(scene, advanced.cameras, None))
    # A fine-tune shrinks the file, and the search below rounds it to its size.
    max_mb = None if wishes.max_mb is None else wishes.max_mb / (FINETUNED_SIZE if tuned else 1)
    like = out.with_suffix(".sundae")
    left = reduced(before, run, replace(wishes, max_mb=max_mb), advanced, out=like, rounds=not tuned)
    most = None if wishes.max_mb is None else int(wishes.max_mb * MEGABYTE)
    source = contents_of(left.stated)
    with progress_bar() as bar, redirect_stdout(StringIO()):  # nerfstudio's messages
        task = bar.add_task("Fine-tuning" if finetune else "Packing", total=2 + finetune)
        if finetune:
            from sundae_ns.plugin.tuned_packs import finetune as tune

            packs.append(tune(run, source, FINETUNED, finetune, data=data, progress=lambda _: bar.advance(task)))
        bar.update(task, description="Packing")
        if (tuned and most is not None) or target_drop is not None:
            from sundae_ns.plugin.tuned_packs import Search, best_pack

            # Starts from the source, because positions of a fitted pack are rounded.
            searches = [Search(source, PackConfig(), judge), *(Search(*each, judge) for each in packs)]
            best = best_pack(searches, most_bytes=most, most_drop=target_drop or 0.0)
            if packs and best.scene is not packs[0][0]:
                print("the fine-tune loses too much for the target; packed without it, try more steps", file=sys.stderr)
                finetune = 0
            packs = [(best.scene, best.codecs)]  # both are compared already
        else:
            packs.append(fit_scene(source, left.precision))
        report = write_fitted(out, *packs[0])
        bar.update(task, advance=1, description="Measuring")
        # Photos show what a box leaves out.
        figures = _measured(judge, packs, finetune) if kind is None and wishes.crop is None else {}
    if advanced.json:
        print(dumps({"file": str(out), **report.summary(), **figures}))
        return 0
    print(f"{out}: {report.primitives:,} Gaussians in {report.bytes:,} bytes ({report.bytes / 1e6:.2f} MB)")
    print(f"{'':14}{'bytes':>12}{'bits per Gaussian':>20}")
    for name, bits in {**report.bits, "all": 8 * report.bytes / report.primitives}.items():
        print(f"{name:14}{round(bits * report.primitives / 8):12,}{bits:20.2f}")
    if figures:
        psnr, ssim = figures["psnr"], figures.get("ssim")
        shown = "" if ssim is None else f", SSIM {ssim[0]:.4f} -> {ssim[1]:.4f}"
        views = f"{figures['views']} of {figures['test_views']} test views"
        print(f"PSNR {psnr[0]:.2f} -> {psnr[1]:.2f} dB{shown}, before and after, on {views}")
        if not tuned and not wishes.cleans and torch.cuda.is_available():
            print(f"--finetune {FINETUNE_STEPS} makes it about 40% smaller")
    else:
        print_cost(out, before, run, wishes, advanced)
    return 0


def _measured(judge: Callable[[], Judge], packs: Sequence[tuple[PackedScene, Codecs]], finetune: int) -> dict[str, Any]:
    """Figures of the run and of the first pack; a second pack is that without the fine-tune."""
    from sundae_ns.plugin.tuned_packs import is_worth

    try:
        views = judge()
        before, after = views.before, views.quality(*packs[0])
    except SundaeError as error:
        print(f"the quality is not measured: {error}", file=sys.stderr)
        return {}
    figures: dict[str, Any] = {"psnr": [before.psnr, after.psnr]}
    if math.isfinite(before.ssim + after.ssim):  # not for images smaller than its window
        figures["ssim"] = [before.ssim, after.ssim]
    for plain in packs[1:]:
        without = views.quality(*plain).psnr
        size, plain_size = (len(pack_bytes(*pack)[0]) for pack in (packs[0], plain))
        if not is_worth(after.psnr, size, without, plain_size):
            lost, plain_lost = before.psnr - after.psnr, before.psnr - without
            other = f"a pack without it has {plain_size:,} bytes and loses {plain_lost:.2f} dB, which is worth more"
            remedy = "give more steps, or leave out --finetune"
            print(f"the fine-tune of {finetune:,} steps loses {lost:.2f} dB; {other}: {remedy}", file=sys.stderr)
    return {**figures, "views": views.cameras, "test_views": views.all_cameras}
