"""``sundae pack``: convert a scene into one small file."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from functools import cache
from io import StringIO
from json import dumps
from typing import TYPE_CHECKING, Any

from sundae_ns.cli.inputs import opened
from sundae_ns.cli.options import Advanced, Flag, Float, Out, Plain, Scene, SceneDetails, Wishes, progress_bar, words_of
from sundae_ns.cli.refusals import check_exclusive, check_file, check_least
from sundae_ns.core.errors import ConfigError, SundaeError
from sundae_ns.core.tables import MEGABYTE, without_nan
from sundae_ns.io.formats import FORMATS, PRIMITIVES, kind_of, kind_of_gaussians
from sundae_ns.io.pack.config import FINETUNED_SIZE, PackConfig
from sundae_ns.io.pack.packed_scene import fit_scene, pack_bytes, write_fitted
from sundae_ns.io.run_folder import files_of
from sundae_ns.scene.packing import contents_of

if TYPE_CHECKING:
    from sundae_ns.plugin.tuned_packs import Judge, Tuned


@dataclass(frozen=True)
class PackDetails(SceneDetails):
    """Options that few need."""

    target_drop: Float = None
    """find the coarsest steps that lose at most this PSNR on some test views, dB."""
    finetune: int = 0
    """training steps with quantisation in the loop, such as 1000, for a smaller file; they do not change the run."""
    max_cameras: int = 100
    """maximum number of training cameras to store for viewers; with 0, the capture is not needed."""
    json: Flag = False
    """print one JSON object in place of the table."""


def pack(
    run: Scene,
    out: Out,
    wishes: Plain[Wishes] = Wishes(),  # noqa: B008
    advanced: Advanced[PackDetails] = PackDetails(),  # noqa: B008
) -> int:
    """Pack a scene into one file that can be rendered; print the size of each part, and the quality before and after.

    Args:
        out: file to write, for example scene.sundae.
    """
    steps, target_drop, max_mb = advanced.finetune, advanced.target_drop, wishes.max_mb
    check_exclusive(max_mb=max_mb, target_drop=target_drop)
    check_least(max_cameras=(advanced.max_cameras, 0), finetune=(steps, 0), target_drop=(target_drop, 0.001))
    if out.suffix.lower() in (*FORMATS, ".html"):
        raise ConfigError(f"{out} is a name of another format; name it .sundae, or write it with sundae export")
    if wishes.cleans and (steps or target_drop is not None):
        raise ConfigError(f"--finetune and --target-drop need the whole scene; leave out {wishes.cleans[0]}, or them")
    check_file(out, reads=[*files_of(run), advanced.data, advanced.cameras], overwrite=advanced.overwrite)
    packed = kind_of(run) == "packed" or (run.suffix.lower() == ".html" and run.is_file())
    kind = "packed" if packed else kind_of_gaussians(run)
    if kind is not None and (of_photos := words_of(advanced, "finetune", "target_drop", "data")):
        name = PRIMITIVES.get(kind, "packed scene")
        raise ConfigError(f"{run} is a {name} without photos; leave out {of_photos[0]}, or give a run")
    before = opened(run, wishes, advanced, capture=True, most=advanced.max_cameras)
    # A fine-tune shrinks the file; by up to a quarter more, coarser steps lose less than fewer Gaussians.
    larger = None if max_mb is None else max_mb / (0.75 * FINETUNED_SIZE if steps else 1)
    left = before._replace(wishes=replace(wishes, max_mb=larger)).reduced(out.with_suffix(".sundae"), rounds=not steps)
    source = contents_of(left.stated)
    packs: list[Tuned] = []
    most = None if max_mb is None else int(max_mb * MEGABYTE)
    with progress_bar() as bar, redirect_stdout(StringIO()):  # nerfstudio's messages
        task = bar.add_task("Fine-tuning" if steps else "Packing", total=2 + steps * (1 if most is None else 2))
        if kind is None:
            from sundae_ns.plugin.tuned_packs import Judge, Search, best_pack, finetune_within

            judge = cache(lambda: Judge(run, advanced.data))
        if steps:
            more: dict[str, Any] = {"data": advanced.data, "progress": lambda _: bar.advance(task)}
            packs.append(finetune_within(run, source, steps, most, **more))
        bar.update(task, description="Packing")
        if target_drop is not None:
            # Starts from the source, because positions of a fitted pack are rounded.
            searches = [Search(source, PackConfig(), judge), *(Search(*each, judge) for each in packs)]
            best = best_pack(searches, target_drop)
            if packs and best.scene is not packs[0][0]:
                print("the fine-tune loses too much for the target; packed without it, try more steps", file=sys.stderr)
            packs = [(best.scene, best.codecs)]  # both are compared already
        elif not steps or most is None:
            packs.append(fit_scene(source, left.form.precision))
        report = write_fitted(out, *packs[0])
        bar.update(task, advance=1, description="Measuring")
        # Photos show what a box leaves out.
        figures = _measured(judge, packs, report.bytes, steps) if kind is None and wishes.crop is None else {}
    if advanced.json:
        print(dumps(without_nan({"file": str(out), **report.summary(), **figures})))
        return 0
    print(f"{out}: {report.primitives:,} Gaussians in {report.bytes:,} bytes ({report.bytes / 1e6:.2f} MB)")
    print(f"{'':14}{'bytes':>12}{'bits per Gaussian':>20}")
    for name, bits in report.bits.items():
        print(f"{name:14}{round(bits * report.primitives / 8):12,}{bits:20.2f}")
    if not figures:
        before.print_cost(out)
        return 0
    (psnr, packed_psnr), (ssim, packed_ssim) = figures["psnr"], figures["ssim"]
    change = f"PSNR {psnr:.2f} -> {packed_psnr:.2f} dB, SSIM {ssim:.4f} -> {packed_ssim:.4f}, before and after"
    print(f"{change}, on {figures['views']} of {figures['test_views']} test views")
    return 0


def _measured(judge: Callable[[], Judge], packs: Sequence[Tuned], size: int, steps: int) -> dict[str, Any]:
    """Figures of the run and of the first pack, of ``size`` bytes; a second pack is that without the fine-tune."""
    from sundae_ns.plugin.tuned_packs import is_worth

    try:
        views = judge()
        after, *others = (views.quality(*pack) for pack in packs)
    except SundaeError as error:
        print(f"the quality is not measured: {error}", file=sys.stderr)
        return {}
    for other, pack in zip(others, packs[1:], strict=True):
        plain = len(pack_bytes(*pack)[0])
        if not is_worth(after.psnr, size, other.psnr, plain):
            lost = f"the fine-tune of {steps:,} steps loses {views.before.psnr - after.psnr:.2f} dB"
            other_lost = f"a pack without it has {plain:,} bytes and loses {views.before.psnr - other.psnr:.2f} dB"
            print(f"{lost}; {other_lost}: give more steps, or leave out --finetune", file=sys.stderr)
    figures = {"psnr": [views.before.psnr, after.psnr], "ssim": [views.before.ssim, after.ssim]}
    return {**figures, "views": views.cameras, "test_views": views.all_cameras}
