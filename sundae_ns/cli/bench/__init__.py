"""``sundae bench``: one command and one module a measurement. Modules are imported when their command runs."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import tyro

app = tyro.extras.SubcommandApp()


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
def frame(
    load_config: Path,
    factors: tuple[float, ...] = (1.0,),
    precisions: tuple[Literal["fp32", "bf16", "fp16"], ...] = (),
    views: int | None = None,
    repeats: int = 5,
    json: bool = False,
) -> int:
    """Time the frames of a finished run: splat, head and whole, each beside the error of the frames that were timed.

    Args:
        load_config: the run's config.yml.
        factors: sizes to show, as factors on the pictures' sides; the truth is resized alike.
        precisions: arithmetic of the head; by default all three on CUDA, and fp32 on a CPU, which knows no other.
        views: measure on the first so many test views; by default on all.
        repeats: timed runs of each view, of which the median counts.
        json: print one line of JSON for each size and precision, instead of a table.
    """
    from sundae_ns.cli.bench.frame import run_frame

    return run_frame(load_config, factors=factors, precisions=precisions, views=views, repeats=repeats, json=json)


__all__ = ["app"]
