"""``sundae bench``: one command and one module for each measurement. A module is imported when its command runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from sundae_ns.cli.bench.options import PaperOptions, QualityOptions, SuiteOptions

app = tyro.extras.SubcommandApp()
INLINE = tyro.conf.arg(name="")
"""Shows the fields of a dataclass as options of the command itself."""


@app.command
def quality(options: Annotated[QualityOptions, INLINE]) -> int:
    """Compare methods and options on one capture: train and evaluate each arm. Stopped, the same command resumes.

    --arms MINE.yaml compares arms of your own. The file is a list; each entry has a name, a method of ns-train (of this
    package, splatfacto, or mcmc for 3DGS-MCMC), and options of ns-train:

        - name: sundae-30
          method: sundae
          options:
            pipeline.model.pruning.keep-ratio: 0.3
            pipeline.model.head.mode: off
        - name: splatfacto
          method: splatfacto

    Methods that prune once share a warm-up of each seed, and prune at every share of --keep-ratios. Other methods train
    from scratch. Methods and options are checked before anything is trained.

    Every finished job is a file of one line in OUT/done. Shards of a plan may run side by side, in one folder, or in
    several whose results.jsonl are concatenated.
    """
    from sundae_ns.cli.bench.quality import run_quality

    return run_quality(options)


@app.command
def suite(options: Annotated[SuiteOptions, INLINE]) -> int:
    """Measure all methods on every capture of a folder: quality, frames, training times, packed bytes. It resumes.

    Whole methods train from scratch, one job at a time, so that their times are those of their commands. A job that
    shares its GPU with another one has no times. Several commands may share OUT: its tables are of all their jobs.

    A capture that is missing, damaged or too large for the GPU is named and left out; the exit code is then 1.
    """
    from sundae_ns.cli.bench.quality import run_suite

    return run_suite(options)


@app.command
def paper(options: Annotated[PaperOptions, INLINE]) -> int:
    """Measure the paper's eleven scenes at its keep ratios, in one table with the paper's figures.

    Images as in papers: images_4 outdoors and images_2 indoors of Mip-NeRF 360, every eighth for test.
    """
    from sundae_ns.cli.bench.quality import run_paper

    return run_paper(options)


@app.command
def frame(
    load_config: Path,
    factors: tuple[float, ...] = (1.0,),
    precisions: tuple[Literal["fp32", "bf16", "fp16"], ...] = (),
    phases: tuple[Literal[1, 2, 4], ...] = (),
    views: int | None = None,
    repeats: int = 5,
    data: Path | None = None,
    json: bool = False,
) -> int:
    """Time the frames of a finished run: splat, head and whole frame, with the error of the timed frames.

    Args:
        load_config: the run's folder, or its config.yml.
        factors: on the sides of the images; the test images are resized alike.
        precisions: arithmetic of the head; by default all three on CUDA, and fp32 on a CPU, the only one there.
        phases: passes of the head for a frame, at as many offsets of its grid; by default those of the run.
        views: number of test views to measure on, from the first; by default all.
        repeats: timed runs of each view; their median counts.
        data: folder of the capture, if it moved.
        json: print one line of JSON for each size and precision, instead of a table.
    """
    from sundae_ns.cli.bench.frame import run_frame

    return run_frame(
        load_config,
        factors=factors,
        precisions=precisions,
        phases=phases,
        views=views,
        repeats=repeats,
        data=data,
        json=json,
    )


@app.command
def flicker(
    load_config: Path,
    places: int = 3,
    phases: tuple[Literal[1, 2, 4], ...] = (),
    data: Path | None = None,
    json: bool = False,
) -> int:
    """Measure the flicker of the head along camera paths, over that of base colours, as StopThePop measures popping.

    Frames 1 and 7 apart are compared, the earlier warped onto the later by the field's depth. A sharper image shows more
    difference at the same flicker.

    Args:
        load_config: the folder of a run with a head, or its config.yml.
        places: number of paths, each between two neighbouring training cameras.
        phases: passes of the head for a frame, as in bench frame; by default those of the run.
        data: folder of the capture, if it moved.
        json: print one line of JSON for each of these and each distance of frames, instead of a table.
    """
    from sundae_ns.cli.bench.flicker import run_flicker

    return run_flicker(load_config, places=places, phases=phases, data=data, json=json)


__all__ = ["app"]
