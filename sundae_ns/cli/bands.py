"""``sundae bands``: what the high-pass, the low-pass and the combined rule of the paper keep of a field."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import Progress
from torch import Tensor

from sundae_ns.errors import ConfigError, DataError, SundaeError
from sundae_ns.evaluation import Look, look_along_axes, look_through, points_sheet, response_histogram
from sundae_ns.gaussians import finite_mask
from sundae_ns.gaussians.parameters import sh_to_rgb
from sundae_ns.graphs import NeighborGraph
from sundae_ns.pruning import PruningConfig, band_rule, decide, field_graph, response
from sundae_ns.storage import replacing, write_point_cloud, write_text
from sundae_ns.storage.atomic import writing
from sundae_ns.storage.kinds import kind_of
from sundae_ns.storage.runs.checkpoint import read_field
from sundae_ns.storage.runs.folder import find_config, read_config, training_cameras

RULES = {"high": "high-pass", "low": "low-pass", "combined": "combined"}
"""Captions of the rules, by their names."""
QUANTILES = (0.0, 0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99, 1.0)
SIDE = 720
"""Longer side of a panel that shows a camera's view, pixels."""
SAMPLED = 20_000
"""Primitives by which the training view that sees most of the field is found."""


def base_colors(params: Mapping[str, Tensor], *, logits: bool) -> Tensor:
    """Colours of primitives as seen from nowhere in particular: uint8 ``[N, 3]``.

    Args:
        params: a field.
        logits: whether a field without bands of spherical harmonics stores logits of colours, as splatfacto's
            checkpoints do; in .ply files it is always the harmonics' first band.
    """
    colors = params["features_dc"].detach()
    harmonic = not logits or params["features_rest"].shape[1] > 0
    shown = sh_to_rgb(colors) if harmonic else torch.sigmoid(colors)
    return (255 * shown.clamp(0, 1)).round().to(torch.uint8)


def band_masks(
    params: Mapping[str, Tensor], config: PruningConfig, graph: NeighborGraph, keep_ratio: float
) -> dict[str, Tensor]:
    """Which primitives each rule keeps, bool ``[N]`` by the names of :data:`RULES`.

    The paper takes both ends of one ranking, that of the high-pass response: what responds most passes the high-pass
    filter, what responds least the low-pass filter, and the combined rule takes ``gamma`` of the first.

    Args:
        params: the field, all finite.
        config: signal and gamma.
        graph: of the field, on which the response is taken.
        keep_ratio: share that each rule keeps.
    """
    shares = {"high": 1.0, "low": 0.0, "combined": config.gamma}
    return {name: decide(params, band_rule(config, keep_ratio, shares[name]), graph=graph).mask for name in RULES}


def band_figures(magnitude: Tensor, masks: Mapping[str, Tensor], keep_ratio: float) -> dict[str, Any]:
    """Counts, thresholds and overlaps of what :func:`band_masks` chose, as plain numbers.

    Args:
        magnitude: ``[N]``, NaN where undefined.
        masks: from :func:`band_masks`.
        keep_ratio: of the masks.
    """
    ends = {name: magnitude[mask & magnitude.isfinite()] for name, mask in masks.items()}
    both = masks["combined"]
    return {
        "keep_ratio": keep_ratio,
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
    """Quantiles of the response magnitudes ``[N]``, those that are undefined left out, and how many are 0."""
    known = magnitude[magnitude.isfinite()].sort().values
    places = [round(share * (len(known) - 1)) for share in QUANTILES] if len(known) else []
    return {
        "known": len(known),
        "zero": int((known == 0).sum()),
        "quantiles": {f"{share:g}": float(known[place]) for share, place in zip(QUANTILES, places)},
    }


def _views(points: Tensor, source: Path, view: int | None) -> tuple[list[Look], str]:
    """From where to look, and in words: through a training camera if the run and its capture are there."""
    try:
        config = find_config(source) if kind_of(source) != "ply" else None
        if config is None:
            raise DataError("the field comes without a run, and so without cameras")
        cameras = training_cameras(read_config(config))
    except SundaeError as error:
        if view is not None:
            raise ConfigError(f"there is no training view {view}: {error}") from error
        return look_along_axes(points), f"three orthogonal views, since {str(error).partition(';')[0]}"
    if view is not None and not 0 <= view < len(cameras):
        raise ConfigError(f"there is no training view {view}: the run has {len(cameras)}, from 0 on")

    def look(index: int, centres: Tensor) -> Look:
        camera = cameras[index]
        size = (int(camera.width.item()), int(camera.height.item()))
        factor = SIDE / max(size)
        pose = camera.camera_to_worlds.reshape(3, 4)
        rotation = pose[:, :3] * pose.new_tensor([1.0, -1.0, -1.0])  # nerfstudio's axes are OpenGL's
        viewmat = torch.cat([rotation.T, -rotation.T @ pose[:, 3:]], dim=1)
        K = camera.get_intrinsics_matrices().reshape(3, 3).clone()
        K[:2] *= factor
        return look_through(centres, viewmat, K, round(size[0] * factor), round(size[1] * factor))

    if view is None:
        few = points[:: max(1, len(points) // SAMPLED)]
        view = max(range(len(cameras)), key=lambda index: _inside(look(index, few)))
    return [look(view, points)], f"training view {view}"


def _inside(look: Look) -> int:
    x, y = look.pixels.T
    return int(((look.depth > 0) & (x >= 0) & (y >= 0) & (x < look.width) & (y < look.height)).sum())


def run_bands(
    source: Path,
    out: Path,
    *,
    keep_ratios: Sequence[float],
    config: PruningConfig,
    view: int | None,
    console: Console | None = None,
) -> int:
    """Write clouds, pictures and figures of a field to a folder; options are those of the command.

    Raises:
        CheckpointError: there is no field.
        ConfigError: an option cannot work.
        DataError: the field cannot be filtered.
        StorageError: the folder cannot be written to.
    """
    console = console or Console()
    if not keep_ratios:
        raise ConfigError("there is nothing to keep: give --keep-ratio one or more shares in (0, 1]")
    for keep_ratio in keep_ratios:
        replace(config, keep_ratio=keep_ratio).validate()
    ratios = sorted(set(keep_ratios))
    run = source.parent if source.name == "config.yml" else source
    with writing(f"cannot write {out}"):
        out.mkdir(parents=True, exist_ok=True)

    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("Reading the field", total=3 + len(ratios))

        def next_is(description: str) -> None:
            progress.update(task, advance=1, description=description)

        field, _ = read_field(run)
        finite = finite_mask(field)
        params = {name: value[finite] for name, value in field.items()}
        if len(params["means"]) == 0:
            raise DataError(f"none of the {len(finite)} primitives in {run} is finite; give another field")
        colors = base_colors(params, logits=run.suffix != ".ply")
        next_is("Graph and response")
        config = band_rule(config, ratios[0], config.gamma)
        graph = field_graph(params, config)
        found = response(params, config, graph)
        next_is("Cameras")
        looks, looked = _views(params["means"], source, view)
        next_is("Rules")
        shown = torch.nan_to_num(found.magnitude, nan=-1.0)
        figures, thresholds, files = [], {}, []

        def cloud(name: str, mask: Tensor | None = None) -> None:
            rows = slice(None) if mask is None else mask
            scalars = {"response": shown[rows]}
            write_point_cloud(out / name, params["means"][rows], colors[rows], scalars=scalars)
            files.append(name)

        def picture(name: str, drawn: Any) -> None:
            with replacing(out / name) as partial:
                drawn.save(partial, format="png")
            files.append(name)

        cloud("all.ply")
        for keep_ratio in ratios:
            masks = band_masks(params, config, graph, keep_ratio)
            figures.append(band_figures(found.magnitude, masks, keep_ratio))
            thresholds[f"{keep_ratio:g}"] = (figures[-1]["low_to"], figures[-1]["high_from"])
            for name, mask in masks.items():
                cloud(f"{name}-{keep_ratio:g}.ply", mask)
            everything = torch.ones_like(masks["high"])
            sets = {f"all: {len(everything):,}": everything}
            sets |= {f"{RULES[name]}: {int(mask.sum()):,}": mask for name, mask in masks.items()}
            title = f"{keep_ratio:g} of the primitives' centres; signal: {config.signal}; {looked.partition(',')[0]}"
            picture(f"bands-{keep_ratio:g}.png", points_sheet(looks, colors, sets, title=title))
            next_is(f"Kept {keep_ratio:g}")
        picture("response.png", response_histogram(found.magnitude, thresholds=thresholds))

    result = {
        "field": str(run),
        "primitives": len(finite),
        "not_finite": len(finite) - len(params["means"]),
        "isolated": found.isolated,
        "signal": config.signal,
        "num_neighbors": config.num_neighbors,
        "bandwidth": config.bandwidth,
        "tau": found.tau,
        "sigma": found.sigma,
        "gamma": config.gamma,
        "response": response_figures(found.magnitude),
        "bands": figures,
        "looked_from": looked,
        "files": files,
    }
    write_text(out / "bands.json", json.dumps(result, indent=2, allow_nan=False) + "\n")
    console.print(f"{len(params['means']):,} primitives, sigma {found.sigma:.3g}, {looked}", highlight=False)
    for figure in figures:
        kept, overlap = figure["kept"]["combined"], figure["overlap"]
        ends = f"{overlap['combined and high']:,} of the high-pass and {overlap['combined and low']:,} of the low-pass"
        console.print(f"keep {figure['keep_ratio']:g}: {kept:,} each; the combined rule keeps {ends}", highlight=False)
    console.print(f"wrote bands.json and {len(files)} files to {out}", highlight=False)
    return 0
