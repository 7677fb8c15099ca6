"""``sundae bench``: one command and one module a measurement. Modules are imported when their command runs."""

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
    """Time the neighbour graph and the high-pass response of positions, beside scipy's cKDTree in the same run.

    Args:
        points: how many points to draw.
        neighbors: neighbours of each point.
        device: where to measure; the reference always runs on all cores of the CPU.
        distribution: what to draw; field is like a trained one, clusters and duplicates are hard for a search.
        field: take the positions of this checkpoint or .ply instead of drawing any.
        reference: false leaves cKDTree out, which takes long for many millions of points.
        repeats: timed runs, of which the median counts.
        seed: of what is drawn.
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
    """Warm up once a seed, branch, fine-tune and evaluate; peers in the same run. Stopped, the same command goes on.

    Every finished job is a file of one line in OUT/done. Parts of a plan (--shard) may run side by side, in one folder or
    in several whose results.jsonl are concatenated into one.
    """
    from sundae_ns.cli.bench.quality import run_quality

    return run_quality(options)


@app.command
def paper(options: Annotated[PaperOptions, INLINE]) -> int:
    """Measure the paper's eleven scenes at its keep ratios, into one table beside its own figures.

    Pictures are those that papers measure on: images_4 outdoors and images_2 indoors of Mip-NeRF 360, every eighth for test.
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
    """Time the frames of a finished run: splat, head and whole, each beside the error of the frames that were timed.

    Args:
        load_config: the run's folder, or its config.yml.
        factors: sizes to show, as factors on the pictures' sides; the truth is resized alike.
        precisions: arithmetic of the head; by default all three on CUDA, and fp32 on a CPU, which knows no other.
        phases: how often the head runs for a frame, over as many places of its grid; by default as the run says.
        views: measure on the first so many test views; by default on all.
        repeats: timed runs of each view, of which the median counts.
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
    """Time the rasterisers on random views, each row with its errors against the reference in float64.

    Args:
        counts: numbers of primitives.
        rasterizers: what to measure; by default everything that runs here. gsplat runs on CUDA, cpu on a CPU.
        dtypes: precisions; gsplat knows float32 only.
        size: width and height of the picture.
        channels: values that are blended beside alpha.
        pixels: standard deviation of a primitive on the screen.
        repeats: timed runs, of which the median counts; fewer where they take longer than 20 s together.
        seed: of the views.
        shard: i/n measures the i-th of n parts; what they write is merged by concatenation.
        output: append a line of JSON for every row to this file, and leave out what is in it already.
        json: print one line of JSON for every row that was measured, instead of a table.
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
