"""``sundae pack`` and ``sundae unpack``: a finished run as one small file, and back."""

from __future__ import annotations

import sys
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Annotated, Literal

import tyro

from sundae_ns.cli.files import check_folder


def pack(
    run: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    max_cameras: int = 100,
    finetune: int = 0,
    data: Path | None = None,
    position_bits: int = 16,
    block: int = 1024,
    scale_bits: int = 8,
    rotation_bits: int = 8,
    color_bits: int = 8,
    opacity_bits: int = 8,
    harmonics: Literal["transform", "codebooks"] = "transform",
    harmonics_step: float | None = None,
    harmonics_books: int = 4,
    feature_bits: int | None = None,
    feature_books: int = 0,
    head: Literal["int8", "fp16"] = "int8",
    head_bits: int | None = None,
    level: int = 19,
) -> int:
    """Pack a finished run into one file with everything that is needed to show the scene, and say what takes how much.

    Args:
        run: folder of a run of sundae or splatfacto, or its config.yml.
        out: the file to write, scene.sundae for example; an older one is replaced once the new one is whole.
        max_cameras: most training cameras to keep for looking around; 0: none, and the capture need not be there.
        finetune: train for so many steps first, 1000 for example, with this very rounding in the loop. The run is only read.
            What a scene can learn to live with is then rounded more coarsely, which takes fewer bytes.
        data: the capture, if it is not where the run says.
        position_bits: bits of each coordinate within a block, 4 to 21.
        block: primitives of a block of positions: smaller ones are more exact and take more bytes.
        scale_bits: bits of each log-scale, 4 to 16.
        rotation_bits: bits of each of the three stored components of a rotation, 4 to 16.
        color_bits: bits of each channel of the view-independent colour, 4 to 16.
        opacity_bits: bits of the logit of the opacity, 4 to 16.
        harmonics: view-dependent colour, transformed and rounded, or by residual codebooks: fewer bytes, more loss.
        harmonics_step: step that transformed coefficients are rounded to; by default 0.02, 0.03 with a fine-tune.
        harmonics_books: residual codebooks of the view-dependent colour: bytes a primitive, 1 to 32.
        feature_bits: bits of each feature, 4 to 16; by default 7, 6 with a fine-tune.
        feature_books: residual codebooks of the feature vectors instead, up to 32.
        head: weights of the head.
        head_bits: bits of each weight of an int8 head, 3 to 8; by default 7, 6 with a fine-tune.
        level: effort of the entropy coder, 1 to 22; unpacking is as fast at all of them.
    """
    from rich.console import Console
    from rich.progress import Progress

    from sundae_ns.errors import ConfigError
    from sundae_ns.scenes.packed import scene_of_run
    from sundae_ns.storage.packing import FINETUNED, PackConfig, fit_scene, write_fitted

    if finetune < 0:
        raise ConfigError(f"finetune is {finetune}; give the number of steps, or 0 for none")
    # What a fine-tune has other defaults for.
    given = {"harmonics_step": harmonics_step, "feature_bits": feature_bits, "head_bits": head_bits}
    fixed = {
        "position_bits": position_bits,
        "block": block,
        "scale_bits": scale_bits,
        "rotation_bits": rotation_bits,
        "color_bits": color_bits,
        "opacity_bits": opacity_bits,
        "harmonics": harmonics,
        "harmonics_books": harmonics_books,
        "feature_books": feature_books,
        "head": head,
        "level": level,
    }
    chosen = {name: value for name, value in given.items() if value is not None}
    config = PackConfig(**{**(FINETUNED if finetune else {}), **chosen, **fixed})  # type: ignore[arg-type]
    config.validate()
    check_folder(out)
    # The bar keeps its place to write to where what nerfstudio prints is held back.
    with Progress(console=Console(file=sys.stdout), transient=True) as progress:
        task = progress.add_task("Reading the run", total=2 + finetune)
        with redirect_stdout(StringIO()):  # nerfstudio is chatty while it reads a capture
            scene = scene_of_run(run, max_cameras=max_cameras, data=data)
            progress.update(task, advance=1, description="Fine-tuning" if finetune else "Packing")
            if finetune:
                from sundae_ns.scenes.finetune import finetune as train

                scene, codecs = train(
                    run, scene, config, finetune, data=data, progress=lambda _: progress.advance(task)
                )
            else:
                scene, codecs = fit_scene(scene, config)
        progress.update(task, description="Packing")
        report = write_fitted(out, scene, codecs)
    print(f"{out}: {report.primitives:,} primitives in {report.bytes:,} bytes ({report.bytes / 1e6:.2f} MB)")
    print(f"{'':14}{'bytes':>12}{'bits a primitive':>20}")
    for name, bits in report.bits.items():
        print(f"{name:14}{round(bits * report.primitives / 8):12,}{bits:20.2f}")
    print(f"{'all':14}{report.bytes:12,}{8 * report.bytes / report.primitives:20.2f}")
    return 0


def unpack(
    scene: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("outputs"),
    name: str | None = None,
    data: Path | None = None,
) -> int:
    """Unpack a scene as a run that ns-viewer, ns-render and ns-eval open. Nothing in the file is run.

    Args:
        scene: a file that sundae pack wrote.
        out: folder of runs, as ns-train's --output-dir.
        name: of the experiment; by default the file's.
        data: the capture that the scene was trained on, which ns-eval needs; without it there are cameras and no pictures.
    """
    from rich.progress import Progress

    from sundae_ns.scenes.packed import write_run
    from sundae_ns.storage.packing import read_scene

    with Progress(transient=True) as progress:
        task = progress.add_task("Unpacking", total=2)
        found = read_scene(scene)
        progress.update(task, advance=1, description="Writing the run")
        path = write_run(found, out, name or scene.stem, data=data)
    print(f"{len(found.field['means']):,} primitives, {'with' if found.head else 'without'} a head")
    print(f"Look around: ns-viewer --load-config {path}")
    if data is not None:
        print(f"Evaluate: ns-eval --load-config {path}")
    return 0
