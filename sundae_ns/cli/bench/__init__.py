"""``sundae bench``: one command and one module for each measurement. A module is imported when its command runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from sundae_ns.cli.bench.options import PaperOptions, QualityOptions

app = tyro.extras.SubcommandApp()
INLINE = tyro.conf.arg(name="")
"""Shows the fields of a dataclass as options of the command itself."""


@app.command
def graph(
    points: int = 1_000_000,
    neighbors: int = 16,
    device: Literal["cpu", "cuda"] = "cpu",
    distribution: Literal["field", "clusters", "duplicates", "uniform"] = "field",
    field: Path | None = None,
    reference: Literal["true", "false"] = "true",
    repeats: int = 3,
    seed: int = 0,
    json: bool = False,
) -> int:
    """Time the neighbour graph and the high-pass response of positions; compare with scipy's cKDTree.

    Args:
        points: number of points to draw.
        neighbors: neighbours of each point.
        device: where to measure; the reference always runs on all cores of the CPU.
        distribution: of the points; field is like a trained one, clusters and duplicates are hard for a search.
        field: use the positions of this checkpoint or .ply instead of drawing points.
        reference: false leaves cKDTree out, which is slow for many millions of points.
        repeats: timed runs; their median counts.
        seed: of the points.
        json: print one line of JSON.
    """
    from sundae_ns.cli.bench.graph import run_graph

    return run_graph(
        points=points,
        neighbors=neighbors,
        device=device,
        distribution=distribution,
        field=field,
        reference=reference == "true",
        repeats=repeats,
        seed=seed,
        json=json,
    )


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
        json: print one line of JSON for each size and precision, instead of a table.
    """
    from sundae_ns.cli.bench.frame import run_frame

    return run_frame(
        load_config, factors=factors, precisions=precisions, phases=phases, views=views, repeats=repeats, json=json
    )


@app.command
def rasterizer(
    counts: tuple[int, ...] = (100, 1000, 10_000, 100_000, 1_000_000),
    rasterizers: tuple[Literal["auto", "gsplat", "cpu", "reference"], ...] = (),
    dtypes: tuple[Literal["float32", "float64"], ...] = ("float32", "float64"),
    size: tuple[int, int] = (640, 480),
    channels: int = 16,
    pixels: float = 2.0,
    repeats: int = 20,
    seed: int = 0,
    shard: str = "1/1",
    output: Path | None = None,
    json: bool = False,
) -> int:
    """Time the rasterisers on random views, with their errors against the reference in float64.

    Args:
        counts: numbers of primitives.
        rasterizers: to measure; by default all that run here. gsplat runs on CUDA, cpu on a CPU.
        dtypes: precisions; gsplat has float32 only.
        size: width and height of the image.
        channels: number of blended values, without alpha.
        pixels: standard deviation of a primitive on the screen.
        repeats: timed runs; their median counts. Fewer if together they take longer than 20 s.
        seed: of the views.
        shard: i/n measures the i-th of n parts; their outputs are merged by concatenation.
        output: append a line of JSON for every row to this file; rows in it are not measured again.
        json: print one line of JSON for every row, instead of a table.
    """
    from sundae_ns.cli.bench.rasterizer import run_rasterizer

    return run_rasterizer(
        counts=counts,
        rasterizers=rasterizers,
        dtypes=dtypes,
        size=size,
        channels=channels,
        pixels=pixels,
        repeats=repeats,
        seed=seed,
        shard=shard,
        output=output,
        json=json,
    )


__all__ = ["app"]
