"""Show the primitives that the paper's high-pass, low-pass and combined rules keep: point clouds, images, figures.

python benchmarks/bands.py RUN -o DIR
python benchmarks/bands.py RUN -o DIR --keep-ratio 0.05 0.2 --view 12
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import torch
import tyro
from PIL.Image import Image
from rich.console import Console
from rich.progress import Progress
from torch import Tensor

from harness.points import (
    Projection,
    points_sheet,
    project_along_axes,
    project_through_camera,
    response_histogram,
    write_points,
)
from harness.script import run_script
from sundae_ns.cli.options import Flag, check_folder
from sundae_ns.errors import ConfigError, DataError, SundaeError
from sundae_ns.gaussians.gaussians import sh_to_rgb
from sundae_ns.graphs import NeighborGraph
from sundae_ns.pruning import PruneRule, band_rule, check_share, decide, field_graph, kept_count, response
from sundae_ns.storage.atomic import replacing, write_text, writing
from sundae_ns.storage.config_file import find_config
from sundae_ns.storage.formats import kind_of, read_field

if TYPE_CHECKING:
    from nerfstudio.cameras.cameras import Cameras

RULES = {"high": "high-pass", "low": "low-pass", "combined": "combined"}
"""Captions of the rules by name."""
QUANTILES = (0.0, 0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99, 1.0)
SIDE = 720
"""Longer side of a camera's panel, pixels."""
SAMPLED = 20_000
"""Number of primitives that are projected to find the training view with the most primitives."""


def base_colors(features_dc: Tensor) -> Tensor:
    """View-independent colours, uint8 ``[N, 3]``, from the SH coefficients of degree 0 ``[N, 3]``."""
    return (255 * sh_to_rgb(features_dc).clamp(0, 1)).round().to(torch.uint8)


def band_masks(params: Mapping[str, Tensor], rule: PruneRule, graph: NeighborGraph, count: int) -> dict[str, Tensor]:
    """The primitives that each rule keeps, bool ``[N]`` by the names of :data:`RULES`.

    All rules rank the primitives by the magnitude of their high-pass response, as the paper does. The high-pass rule
    keeps the largest, the low-pass rule the smallest, and the combined rule a share ``gamma`` of the largest and the
    rest of the smallest.

    Args:
        params: the field, all finite.
        rule: signal and gamma.
        graph: neighbour graph of the field.
        count: number of primitives that each rule keeps.
    """
    gammas = {"high": 1.0, "low": 0.0, "combined": rule.gamma}
    return {name: decide(params, band_rule(rule, gamma), count, graph=graph).mask for name, gamma in gammas.items()}


def band_figures(magnitude: Tensor, masks: Mapping[str, Tensor], share: float) -> dict[str, Any]:
    """Counts, thresholds and overlaps of the masks, as plain numbers for JSON.

    Args:
        magnitude: response magnitudes ``[N]``, NaN where undefined.
        masks: from :func:`band_masks`.
        share: keep ratio of the masks.
    """
    ends = {name: magnitude[mask & magnitude.isfinite()] for name, mask in masks.items()}
    both = masks["combined"]
    return {
        "keep_ratio": share,
        "kept": {name: int(mask.sum()) for name, mask in masks.items()},
        "high_from": float(ends["high"].min()) if len(ends["high"]) else None,
        "low_to": float(ends["low"].max()) if len(ends["low"]) else None,
        "unknown_kept": {name: int((mask & ~magnitude.isfinite()).sum()) for name, mask in masks.items()},
        "overlap": {
            "high and low": int((masks["high"] & masks["low"]).sum()),
            "combined and high": int((both & masks["high"]).sum()),
            "combined and low": int((both & masks["low"]).sum()),
        },
    }


def response_figures(magnitude: Tensor) -> dict[str, Any]:
    """Quantiles of the defined response magnitudes ``[N]``, and the number of those that are 0."""
    known = magnitude[magnitude.isfinite()].sort().values
    places = [round(share * (len(known) - 1)) for share in QUANTILES] if len(known) else []
    return {
        "known": len(known),
        "zero": int((known == 0).sum()),
        "quantiles": {f"{share:g}": float(known[place]) for share, place in zip(QUANTILES, places)},
    }


def _cameras_of_run(source: Path) -> Cameras:
    """Training cameras of the run that a path belongs to.

    Raises:
        CheckpointError: the run's ``config.yml`` cannot be read.
        DataError: the path belongs to no run, or the run's capture cannot be used.
    """
    config = find_config(source) if kind_of(source) != "ply" else None
    if config is None:
        raise DataError("the field has no run, and so no cameras")
    from harness.cameras import training_cameras  # loads nerfstudio, which fields without a run do not need

    return training_cameras(config)


def _project(points: Tensor, source: Path, view: int | None) -> tuple[list[Projection], str]:
    """Projections of the points and their description: through a training camera if the run and its capture exist.

    Args:
        points: centres ``[N, 3]``.
        source: the path that the user gave.
        view: index of the training view; None chooses the view with the most primitives.
    """
    try:
        cameras = _cameras_of_run(source)
    except SundaeError as error:
        if view is not None:
            raise ConfigError(f"there is no training view {view}: {error}") from error
        return project_along_axes(points), f"three orthogonal views, because {str(error).partition(';')[0]}"
    if view is not None and not 0 <= view < len(cameras):
        raise ConfigError(f"there is no training view {view}: the run has {len(cameras)}, from 0 on")
    from sundae_ns.rendering.views import view_of

    def project(index: int, centres: Tensor) -> Projection:
        camera = view_of(cameras[index], "cpu")
        camera = camera.zoomed(SIDE / max(camera.width, camera.height))
        return project_through_camera(centres, camera.viewmat, camera.K, camera.width, camera.height)

    if view is None:
        sample = points[:: max(1, len(points) // SAMPLED)]
        view = max(range(len(cameras)), key=lambda index: _visible(project(index, sample)))
    return [project(view, points)], f"training view {view}"


def _visible(projection: Projection) -> int:
    """Number of points inside the image."""
    x, y = projection.pixels.T
    inside = (x >= 0) & (y >= 0) & (x < projection.width) & (y < projection.height)
    return int(((projection.depth > 0) & inside).sum())


def bands(
    run: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    keep_ratio: tuple[float, ...] = (0.01, 0.1, 0.3),
    signal: Literal["positions", "attributes"] = "positions",
    gamma: float = 0.5,
    neighbors: int = 16,
    view: int | None = None,
    overwrite: Flag = False,
) -> int:
    """Write point clouds, images and ``bands.json`` of a field; the exit code.

    Args:
        run: a run of sundae or splatfacto (its folder, config.yml or a checkpoint), or a 3DGS .ply file.
        out: folder to write; created if missing.
        keep_ratio: shares of the primitives to keep, each in (0, 1].
        signal: graph signal to filter: positions, as in the paper, or position, colour, opacity and size.
        gamma: share of the kept primitives that the combined rule takes from the largest responses.
        neighbors: maximum number of neighbours of a primitive in the graph.
        view: index of the training view to draw; by default the one with the most primitives.
        overwrite: replace the files of an earlier command in the folder.
    """
    check_folder(out, reads=[run], overwrite=overwrite)
    rule = PruneRule(signal=signal, gamma=gamma, num_neighbors=neighbors)
    return run_bands(run, out, shares=keep_ratio, rule=rule, view=view)


def run_bands(
    source: Path,
    out: Path,
    *,
    shares: Sequence[float],
    rule: PruneRule,
    view: int | None,
    console: Console | None = None,
) -> int:
    """Write point clouds, images and ``bands.json`` of a field to a folder; the options are those of the command.

    Raises:
        CheckpointError: the source holds no field, or none of its primitives is finite.
        ConfigError: an option is out of range.
        DataError: the field has too few primitives for a graph.
        StorageError: the folder cannot be written to.
    """
    console = console or Console()
    if not shares:
        raise ConfigError("there is nothing to keep: give --keep-ratio one or more shares in (0, 1]")
    for share in shares:
        check_share(share)
    rule.validate()
    shares = sorted(set(shares))
    run = source.parent if source.name == "config.yml" else source
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("Reading the field", total=3 + len(shares))

        def next_is(description: str) -> None:
            progress.update(task, advance=1, description=description)

        params, _, dropped = read_field(run)
        colors = base_colors(params["features_dc"])
        next_is("Graph and response")
        rule = band_rule(rule, rule.gamma)
        graph = field_graph(params, rule)
        magnitude = response(params, rule, graph)
        next_is("Cameras")
        projections, seen_from = _project(params["means"], source, view)
        next_is("Rules")
        with writing(f"cannot write {out}"):
            out.mkdir(parents=True, exist_ok=True)
        scalar = torch.nan_to_num(magnitude, nan=-1.0)
        figures, thresholds, files = [], {}, []

        def cloud(name: str, mask: Tensor | None = None) -> None:
            rows = slice(None) if mask is None else mask
            write_points(out / name, params["means"][rows], colors[rows], scalar[rows])
            files.append(name)

        def save_png(name: str, image: Image) -> None:
            with replacing(out / name) as partial:
                image.save(partial, format="png")
            files.append(name)

        cloud("all.ply")
        for share in shares:
            masks = band_masks(params, rule, graph, kept_count(share, len(magnitude)))
            figures.append(band_figures(magnitude, masks, share))
            thresholds[f"{share:g}"] = (figures[-1]["low_to"], figures[-1]["high_from"])
            for name, mask in masks.items():
                cloud(f"{name}-{share:g}.ply", mask)
            everything = torch.ones_like(masks["high"])
            sets = {f"all: {len(everything):,} primitives": everything}
            sets |= {f"{RULES[name]}: {int(mask.sum()):,}": mask for name, mask in masks.items()}
            title = f"Centres of the primitives that each rule keeps: keep ratio {share:g}, signal {rule.signal}, "
            title += seen_from.partition(",")[0]
            save_png(f"bands-{share:g}.png", points_sheet(projections, colors, sets, title=title))
            next_is(f"Keep ratio {share:g}")
        save_png("response.png", response_histogram(magnitude, thresholds=thresholds))

    result = {
        "field": str(run),
        "primitives": len(params["means"]) + dropped,
        "not_finite": dropped,
        "isolated": int(graph.isolated.sum()),
        "signal": rule.signal,
        "num_neighbors": rule.num_neighbors,
        "tau": graph.tau,
        "sigma": graph.sigma,
        "gamma": rule.gamma,
        "response": response_figures(magnitude),
        "bands": figures,
        "seen_from": seen_from,
        "files": files,
    }
    write_text(out / "bands.json", json.dumps(result, indent=2, allow_nan=False) + "\n")
    console.print(f"{len(params['means']):,} primitives, sigma {graph.sigma:.3g}, {seen_from}", highlight=False)
    for figure in figures:
        kept, overlap = figure["kept"]["combined"], figure["overlap"]
        shared = f"{overlap['combined and high']:,} with high-pass and {overlap['combined and low']:,} with low-pass"
        console.print(
            f"keep ratio {figure['keep_ratio']:g}: {kept:,} primitives by each rule; combined shares {shared}",
            highlight=False,
        )
    console.print(f"wrote bands.json and {len(files)} files to {out}", highlight=False)
    return 0


if __name__ == "__main__":
    run_script(bands, __doc__)
