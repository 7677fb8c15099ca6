"""``sundae export``: a scene as a web page, or as a file for other programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from sundae_ns.cli.inputs import opened
from sundae_ns.cli.options import Advanced, File, Flag, Out, Plain, Scene, SceneDetails, Wishes, progress_bar
from sundae_ns.cli.refusals import check_file, check_folder, check_suffix
from sundae_ns.core.errors import ConfigError
from sundae_ns.io.formats import FORMATS, kind_of, write_levels
from sundae_ns.io.ply import STORED_SH_DEGREE
from sundae_ns.io.run_folder import files_of
from sundae_ns.io.sog import STREAMED
from sundae_ns.rasterize.interface import fastest_device
from sundae_ns.scene.load_save import marks_of
from sundae_ns.scene.page import write_page
from sundae_ns.scene.scene import Scene as LoadedScene


@dataclass(frozen=True)
class ExportDetails(SceneDetails):
    """Options that few need."""

    upright: Flag = False
    """rotate the scene from nerfstudio's z-up axes to the -y-up axes of viewers; not for a warm start."""


def export(
    scene: Scene,
    out: Out,
    beside: Annotated[tyro.conf.Positional[File], tyro.conf.arg(metavar="[BESIDE]")] = None,
    wishes: Plain[Wishes] = Wishes(),  # noqa: B008
    views: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=LINK ...", help_behavior_hint="")] = (),
    lod: Flag = False,
    advanced: Advanced[ExportDetails] = ExportDetails(),  # noqa: B008
) -> int:
    """Write a scene as a web page with its head (.html or a folder), or its base colours as .ply, .spz, .sog or .glb.

    The page needs no network and no server. Other formats hold no features and no head, but mark antialiased scenes.

    Args:
        out: file to write; its suffix selects the format: .html, .ply or .glb (exact), .spz or .sog (quantised,
            much smaller). A name without a suffix is a folder of page and scene, for a web server.
        beside: another scene, which the page shows unchanged beside the first one, by the same camera.
        views: views that the page names, each with a link that its button Copy link gives.
        lod: write levels of detail as streamed SOG (lod-meta.json) into the folder, for PlayCanvas's viewers. Below
            the full scene are a half, a quarter and a tenth of it, pruned and trained on its images; minutes on a GPU.
    """
    suffix, upright = out.suffix.lower(), advanced.upright
    page = suffix in (".html", "") and not lod
    if lod and (suffix or wishes.max_mb is not None):
        raise ConfigError("--lod writes a folder of many files; name one without a suffix, and leave out --max-mb")
    if suffix:
        check_suffix(out, (*FORMATS, ".html"))
    reads = [*files_of(scene), beside, advanced.data, advanced.cameras]
    (check_file if suffix else check_folder)(out, reads=reads, overwrite=advanced.overwrite)
    if page and upright:
        raise ConfigError("a page turns the scene upright by itself; leave out --upright")
    if not page and (beside is not None or views or advanced.start_view is not None):
        raise ConfigError("only a page shows two scenes, views or a start view; name it .html; sn.merge joins two")
    before = opened(scene, wishes, advanced, capture=page or lod)
    changes = bool(wishes.cleans or wishes.reduces)
    if before.copies_rows(out) and (upright or not (changes or advanced.up)):
        raise ConfigError(f"{scene} is a .ply already; name another suffix, or what to change, as --up")
    if upright and not before.scene.in_model_frame:
        raise ConfigError(f"{scene} is not in nerfstudio's coordinates, which --upright turns; leave it out")
    left = before if page else before.reduced(out, write=lambda edit, path: edit.write(path, upright=upright))
    costs = True
    if page:
        second = [] if beside is None else [opened(beside, Wishes(), SceneDetails(), capture=True).for_page()]
        named = {name: link for name, _, link in (word.partition("=") for word in views)}
        first = before.for_page(out, lambda path, first: write_page(path, first, *second, views=named))
        size = write_page(out, first, *second, views=named)
        print(f"{out}: {size:,} bytes; {'open it in a browser' if suffix else f'serve it; scene: {len(first[2]):,}'}")
        costs = kind_of(scene) != "packed" or first[1] is not before.scene
    elif lod:
        _write_levels(left.scene.to(fastest_device()), out, upright=upright)
    else:
        with Console(stderr=True).status(f"Writing {left.scene.num_gaussians:,} Gaussians"):  # a .sog takes minutes
            left.write(out, upright=upright)
        stated = left.stated.gaussians.sh_degree
        degree = stated if suffix == ".ply" else min(stated, STORED_SH_DEGREE)
        mode = ", antialiased" if left.scene.antialiased else ""
        print(f"{out}: {left.scene.num_gaussians:,} Gaussians, degree {degree}{mode}, {out.stat().st_size:,} bytes")
        exact = suffix in (".ply", ".glb") and degree == before.scene.gaussians.sh_degree
        costs = not exact or before.scene.head is not None or changes
    if costs:
        before.print_cost(out if suffix else out / (STREAMED if lod else "scene.sundae"), upright=upright)
    return 0


def _write_levels(scene: LoadedScene, folder: Path, *, upright: bool) -> None:
    """Write a scene and smaller ones that are trained on its images."""
    from sundae_ns.plugin.distill import levels_of  # imports nerfstudio, which takes seconds

    levels = [scene]
    with progress_bar() as bar:
        task = bar.add_task("Levels of detail", total=None)
        for level, psnr in levels_of(scene, scene.cameras, lambda i, n: bar.update(task, completed=i, total=n)):
            print(f"{level.num_gaussians:,} Gaussians: {psnr:.2f} dB against the full scene, on held-out cameras")
            levels.append(level)
    write_levels(folder, [level.gaussians for level in levels], marks_of(scene), upright=upright)
    print(f"{folder / STREAMED}: {scene.num_gaussians:,} Gaussians and {len(levels) - 1} levels below")
