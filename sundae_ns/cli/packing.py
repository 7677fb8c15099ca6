"""``sundae pack``: convert a scene into one small file."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass
from functools import cache
from io import StringIO
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from sundae_ns.cli.cleaning import Cleaning
from sundae_ns.cli.outputs import Overwrite, check_file

if TYPE_CHECKING:
    from sundae_ns.scenes.targets import Judge
    from sundae_ns.storage.pack import Codecs, PackedScene


@dataclass(frozen=True)
class Precision:
    """Options of ``PackConfig`` whose defaults a fine-tune changes."""

    position_bits: int | None = None
    """bits per coordinate within a block, 4 to 16; by default 13, 12 with a fine-tune."""
    scale_step: float | None = None
    """rounding step of log-scales; by default 0.05, 0.1 with a fine-tune."""
    rotation_step: float | None = None
    """rounding step of x, y and z of unit quaternions; by default 0.008, 0.018 with a fine-tune."""
    color_step: float | None = None
    """rounding step of the view-independent colour; by default 0.03, 0.07 with a fine-tune."""
    opacity_step: float | None = None
    """rounding step of the opacity's logit; by default 0.2, 0.4 with a fine-tune."""
    harmonics_step: float | None = None
    """rounding step of the view-dependent colour; by default 0.02, 0.06 with a fine-tune."""
    feature_step: float | None = None
    """rounding step of features; by default 0.09, 0.2 with a fine-tune."""
    head_step: float | None = None
    """rounding step of weights, as a share of their channel's largest; by default 0.02, 0.14 with a fine-tune."""


def pack(
    run: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    target_bytes: int | None = None,
    target_drop: float | None = None,
    finetune: int = 0,
    max_cameras: int = 100,
    start_view: str | None = None,
    up: tuple[float, float, float] | None = None,
    data: Path | None = None,
    json: bool = False,
    overwrite: Overwrite = False,
    block: int = 1024,
    precision: Annotated[Precision, tyro.conf.arg(name="")] = Precision(),  # noqa: B008
    cleaning: Annotated[Cleaning, tyro.conf.arg(name="")] = Cleaning(),  # noqa: B008
) -> int:
    """Pack a scene into one file that can be rendered; print the size of each part, and the quality before and after.

    Args:
        run: a run of sundae or splatfacto (its folder or config.yml), or a .ply, .spz, .sog, .glb, .splat,
            .ksplat or gsplat's .pt.
        out: file to write, for example scene.sundae.
        target_bytes: find the finest steps whose file has at most this many bytes.
        target_drop: find the coarsest steps that lose at most this PSNR on some test views, dB.
        finetune: training steps with quantisation in the loop before packing, for example 1000; the run is not changed.
            The defaults then quantise more coarsely, for a smaller file.
        max_cameras: maximum number of training cameras to store for viewers; with 0, the capture is not needed.
        start_view: what a page of the scene opens with: index of a stored camera, or a camera file as sundae render
            reads it; by default the first camera.
        up: direction that is upwards, for example 0 0 1; by default that of a run's capture.
        data: folder of the capture, if it moved.
        json: print one JSON object in place of the table.
        overwrite: replace an existing file, once the new one is complete.
        block: number of primitives per block of positions; smaller blocks are more exact and larger on disk.
    """
    import torch
    from rich.console import Console
    from rich.progress import Progress

    from sundae_ns.api.files import load
    from sundae_ns.api.packing import contents_of
    from sundae_ns.api.views import with_start
    from sundae_ns.errors import ConfigError
    from sundae_ns.storage.config_file import check_run
    from sundae_ns.storage.pack import FINETUNE_STEPS, FINETUNED, PackConfig, fit_scene, write_fitted
    from sundae_ns.storage.run_folder import files_of

    if max_cameras < 0:
        raise ConfigError(f"max-cameras is {max_cameras}; give the number of cameras, or 0 for none")
    if finetune < 0:
        raise ConfigError(f"finetune is {finetune}; give the number of steps, or 0 for none")
    if target_bytes is not None and target_drop is not None:
        raise ConfigError("--target-bytes and --target-drop exclude each other; give one")
    if target_bytes is not None and target_bytes < 1:
        raise ConfigError(f"target-bytes is {target_bytes}; give 1 or more")
    if target_drop is not None and not 0 < target_drop < 100:
        raise ConfigError(f"target-drop is {target_drop}; give a positive number of dB")
    if cleaning.chosen and (finetune or target_drop is not None):
        raise ConfigError(
            f"--finetune and --target-drop look at photos of the whole scene; leave out {cleaning.chosen[0]}, or cut "
            "the scene by `sundae export` or `sundae prune` afterwards"
        )
    chosen = {name: value for name, value in {**asdict(precision), "block": block}.items() if value is not None}
    plain = PackConfig(**chosen)  # type: ignore[arg-type]
    config = PackConfig(**{**FINETUNED, **chosen}) if finetune else plain  # type: ignore[arg-type]
    config.validate()
    check_file(out, reads=[*files_of(run), data], overwrite=overwrite)
    has_photos = _has_photos(run, {"--finetune": finetune, "--target-drop": target_drop, "--data": data})
    if has_photos:
        check_run(run)
    quality, notes, tuned = "", list[str](), finetune > 0
    figures: dict[str, Any] = {}
    # The bar writes to the real stdout while nerfstudio's messages are suppressed.
    with Progress(console=Console(file=sys.stdout), transient=True, disable=json) as progress:
        task = progress.add_task("Reading the run", total=3 + finetune)
        with redirect_stdout(StringIO()):  # nerfstudio prints messages while it reads a capture
            if has_photos:
                from sundae_ns.scenes.models import load_run  # takes seconds

                opened = load_run(run, max_cameras=max_cameras, data=data)
            else:
                opened = load(run)
            if cleaning.chosen:
                opened = cleaning.cleaned(opened, progress=False)
            source = contents_of(with_start(opened, start_view, up))
            progress.update(task, advance=1, description="Fine-tuning" if finetune else "Packing")
            judge = _judge_of(run, data)
            if finetune:
                from sundae_ns.scenes.finetune import finetune as tune

                scene, codecs = tune(
                    run, source, config, finetune, data=data, progress=lambda _: progress.advance(task)
                )
            else:
                scene, codecs = fit_scene(source, config)
            progress.update(task, description="Packing")
            if target_bytes is not None or target_drop is not None:
                from sundae_ns.scenes.targets import Search, fewest_bytes, least_drop

                # Not what is fitted already without a fine-tune: its positions are rounded.
                searches = [Search(source, plain, judge)]
                if finetune:
                    searches.append(Search(scene, codecs, judge))
                if target_bytes is not None:
                    found = least_drop(searches, target_bytes)
                else:
                    found = fewest_bytes(searches[::-1], target_drop or 0.0)
                if finetune and found.scene is not scene:
                    notes.append("the fine-tune loses too much for the target; packed without it, try more steps")
                    finetune = 0
                scene, codecs = found.scene, found.codecs
            report = write_fitted(out, scene, codecs)
            progress.update(task, advance=1, description="Measuring")
            if has_photos and cleaning.crop is None:  # photos show what a box leaves out
                targeted = target_bytes is not None or target_drop is not None
                # Of a target, both are compared already.
                packs = [(scene, codecs), *([fit_scene(source, plain)] if finetune and not targeted else [])]
                quality, figures = _measured(judge, packs, finetune, notes)
    for note in notes:
        print(note, file=sys.stderr)
    if json:
        print(dumps({"file": str(out), **report.summary(), **figures}))
        return 0
    print(f"{out}: {report.primitives:,} primitives in {report.bytes:,} bytes ({report.bytes / 1e6:.2f} MB)")
    print(f"{'':14}{'bytes':>12}{'bits per primitive':>20}")
    for name, bits in report.bits.items():
        print(f"{name:14}{round(bits * report.primitives / 8):12,}{bits:20.2f}")
    print(f"{'all':14}{report.bytes:12,}{8 * report.bytes / report.primitives:20.2f}")
    if quality:
        print(quality)
    if quality and not tuned and not cleaning.chosen and torch.cuda.is_available():
        print(f"--finetune {FINETUNE_STEPS} makes it about 40% smaller")
    return 0


def _has_photos(source: Path, options: Mapping[str, object]) -> bool:
    """Whether a scene is a run; ``ConfigError`` for a file of primitives with one of the options that need photos."""
    from sundae_ns.errors import ConfigError
    from sundae_ns.storage.formats import PRIMITIVES, kind_of_primitives

    kind = kind_of_primitives(source)
    if kind is None:
        return True
    for name, value in options.items():
        if value:
            raise ConfigError(f"{source} is a {PRIMITIVES[kind]} without photos; leave out {name}, or give a run")
    return False


def _judge_of(run: Path, data: Path | None) -> Callable[[], Judge]:
    """Opens the test views of a run, once."""

    @cache
    def judge() -> Judge:
        from sundae_ns.scenes.targets import Judge

        return Judge(run, data)

    return judge


def _measured(
    judge: Callable[[], Judge], packs: Sequence[tuple[PackedScene, Codecs]], finetune: int, notes: list[str]
) -> tuple[str, dict[str, Any]]:
    """A line and figures of the quality of a pack; a second pack is that without the fine-tune. Adds to the notes."""
    from sundae_ns.errors import SundaeError
    from sundae_ns.scenes.targets import is_worth
    from sundae_ns.storage.pack import pack_bytes

    try:
        opened = judge()
        before, after = opened.before, opened.quality(*packs[0])
    except SundaeError as error:
        notes.append(f"the quality is not measured: {error}")
        return "", {}
    figures: dict[str, Any] = {"psnr": [before.psnr, after.psnr], "views": opened.views}
    shown = f"PSNR {before.psnr:.2f} -> {after.psnr:.2f} dB"
    if math.isfinite(before.ssim + after.ssim):  # not for images smaller than its window
        figures["ssim"] = [before.ssim, after.ssim]
        shown += f", SSIM {before.ssim:.4f} -> {after.ssim:.4f}"
    for plain in packs[1:]:
        without = opened.quality(*plain).psnr
        size, plain_size = (len(pack_bytes(*pack)[0]) for pack in (packs[0], plain))
        if not is_worth(after.psnr, size, without, plain_size):
            notes.append(
                f"the fine-tune of {finetune:,} steps loses {before.psnr - after.psnr:.2f} dB; a pack without it has "
                f"{plain_size:,} bytes and loses {before.psnr - without:.2f} dB, which is worth more: give more steps, "
                "or leave out --finetune"
            )
    return f"{shown}, before and after, on {opened.views} of {opened.all_views} test views", figures
