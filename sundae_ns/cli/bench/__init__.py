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


__all__ = ["app"]
