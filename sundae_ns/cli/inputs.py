"""What commands read: a scene, its cameras, and what to cut from it before anything else."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from torch import Tensor

from sundae_ns.cli.options import SceneDetails, Wishes
from sundae_ns.core.camera import Camera
from sundae_ns.core.errors import DataError, SundaeError
from sundae_ns.core.tables import MEGABYTE
from sundae_ns.cuda.kernels import naming_full_memory
from sundae_ns.io.config_file import check_run, find_config
from sundae_ns.io.formats import UPRIGHT, kind_of
from sundae_ns.io.pack import container
from sundae_ns.io.pack.config import PackConfig
from sundae_ns.io.ply import has_own_columns, keep_vertices
from sundae_ns.pruning.rule import PruneRule
from sundae_ns.rasterize.interface import fastest_device
from sundae_ns.scene.cameras import cameras_of, with_start
from sundae_ns.scene.compose import transform
from sundae_ns.scene.load_save import load, load_with_mask, write_scene
from sundae_ns.scene.page import packed_of
from sundae_ns.scene.prune_scene import PrunedScene, count_for_drop, crop_mask, floater_mask, prune_with_mask, within
from sundae_ns.scene.scene import Scene
from sundae_ns.scene.sizes import Form, forms_of, prune_to_bytes, stated
from sundae_ns.scene.virtual_cameras import VIEWS, virtual_cameras


class Left(NamedTuple):
    """What options leave of a scene, and how a file states it."""

    scene: Scene
    rows: Tensor | None  # True for the rows of a file of Gaussians that are left, bool [N]
    total: int  # Gaussians of the file
    form: Form | None = None  # of a file of a given size
    pruned: PrunedScene | None = None
    cameras: Sequence[Camera] = ()  # those given or stored; of a pruned scene, those that decided

    @property
    def stated(self) -> Scene:
        """The scene, on the CPU, as its form states it."""
        scene = self.scene.to("cpu")
        return scene if self.form is None else stated(scene, self.form)

    @property
    def precision(self) -> PackConfig | None:
        """That of a packed file; None for the default."""
        return None if self.form is None else self.form.precision

    def write(self, source: Path, out: Path) -> int:
        """Write the scene; a .ply of a .ply keeps its properties and comments. Returns the bytes."""
        if copies_rows(source, out):
            assert self.rows is not None
            moved = self.pruned is not None and self.pruned.moved
            keep_vertices(source, out, self.rows.cpu(), self.stated.gaussians if moved else None)
        else:
            write_scene(self.stated, out, config=self.precision)
        return out.stat().st_size


def opened(
    source: Path, wishes: Wishes, details: SceneDetails, *, capture: bool = False, num_cameras: int | None = None
) -> Left:
    """A scene before its wishes, upright and started as its details say; ``capture`` asks for cameras of a run."""
    rows = None
    if is_run(source) and (capture or wishes.remove_floaters is not None or details.data is not None):
        scene = open_run(source, data=details.data)
    else:
        scene, rows = load_with_mask(source)
    scene = with_start(scene, details.start_view, details.up)
    cameras = chosen_cameras(scene, details.cameras, num_cameras)
    return Left(scene, rows, scene.num_gaussians if rows is None else len(rows), cameras=cameras)


def reduced(
    left: Left,
    source: Path,
    wishes: Wishes,
    details: SceneDetails,
    *,
    out: Path,
    rule: PruneRule | None = None,
    num_cameras: int | None = None,
    target_drop: float | None = None,
    rounds: bool = True,
) -> Left:
    """What the options leave of a scene; ``out`` is the file, or one like it, to be written.

    ``rounds`` says whether a size also decides how it is rounded.
    """
    scene, rows, cameras = left.scene, left.rows, left.cameras
    if details.no_head:
        scene = replace(scene, head=None)
    reduces = wishes.reduces or target_drop is not None
    if not wishes.cleans and not reduces:
        return left._replace(scene=scene)
    with naming_full_memory(lambda: left.total):
        scene, rule = scene.to(fastest_device()), rule or PruneRule()
        rule = replace(rule, seed=details.seed or 0)
        if wishes.crop is not None:
            mask = crop_mask(scene, wishes.crop[:3], wishes.crop[3:])
            print(f"{int(mask.sum()):,} of {len(mask):,} Gaussians are in the box", file=sys.stderr)
            scene, rows = scene[mask], None if rows is None else within(rows, mask.cpu())
        if wishes.remove_floaters is not None:
            mask = ~floater_mask(scene, cameras, wishes.remove_floaters, Console(stderr=True))
            why = "" if cameras else ", by their neighbours alone: no camera of the photographs is known"
            print(f"removed {int((~mask).sum()):,} floaters of {len(mask):,} Gaussians{why}", file=sys.stderr)
            if not bool(mask.any()):
                raise DataError("all Gaussians float; leave out --remove-floaters")
            scene, rows = scene[mask], None if rows is None else within(rows, mask.cpu())
        left = left._replace(scene=scene, rows=rows)
        if not reduces:
            return left
        warn_if_few(wishes.count, scene.num_gaussians)
        if rule.uses_contribution or wishes.max_mb is not None or target_drop is not None:
            cameras = cameras or virtual_cameras(scene, num_cameras, seed=rule.seed)
        if target_drop is not None:
            count, curve = count_for_drop(scene, target_drop, cameras, rule, progress=True)
            for number, psnr in curve:
                print(f"{number:12,} Gaussians: {psnr:.2f} dB against the full scene, on held-out cameras")
            wishes = replace(wishes, count=count)

        def after(pruned: PrunedScene, form: Form | None) -> Left:
            kept = None if rows is None else within(rows, pruned.mask.cpu())
            return Left(pruned.scene, kept, left.total, form, pruned, cameras)

        if wishes.max_mb is None:
            pruned = prune_with_mask(scene, wishes.keep, wishes.count, cameras, rule, progress=True)
            return after(pruned, None)
        most, suffix = int(wishes.max_mb * MEGABYTE), out.suffix.lower()
        # All columns of a .ply stay.
        forms = forms_of(scene, suffix)[: 1 if copies_rows(source, out) or not rounds else None]

        def write(pruned: PrunedScene, form: Form, folder: Path) -> int:
            return after(pruned, form).write(source, folder / out.name)

        return after(*prune_to_bytes(scene, most, write, forms, cameras, rule, progress=True))


def open_run(run: Path, **options: Any) -> Scene:
    """The scene of a run with cameras of its capture; options as :func:`.finished_runs.load_run`."""
    check_run(run)  # before nerfstudio is imported, which takes seconds
    from sundae_ns.plugin.finished_runs import load_run

    # nerfstudio prints messages while it reads a capture.
    with Console(file=sys.stderr).status("Reading the run"), redirect_stdout(StringIO()):
        return load_run(run, **options)


def prepared_page(
    source: Path, wishes: Wishes, details: SceneDetails, before: Left | None = None
) -> tuple[Scene, bytes]:
    """What the options leave of a scene, and the packed file that a page of it shows; a packed one stays as it is."""
    before = before or opened(source, wishes, details, capture=True)
    left = reduced(before, source, wishes, details, out=Path("page.html"))
    if kind_of(source) != "packed" or wishes.cleans or wishes.reduces or details.no_head:
        return left.stated, packed_of(left.stated, left.precision)
    packed = source.read_bytes()
    if details.start_view is not None or details.up is not None:
        from sundae_ns.scene.packing import stated_start  # its encoder needs a compiler, which other files do not

        packed = container.restated(packed, stated_start(left.scene))
    return left.scene, packed


def print_cost(
    file: Path, before: Left, source: Path, wishes: Wishes, details: SceneDetails, *, upright: bool = False
) -> None:
    """Print what a finished file costs, against the scene before its changes; of a box, within it."""
    from sundae_ns.report.measure import cost_line

    whole, name = replace(before.scene, cameras=tuple(before.cameras)), "the whole scene"
    if wishes.crop is not None:
        whole, name = whole[crop_mask(whole, wishes.crop[:3], wishes.crop[3:])], "the scene in the box"
    if upright:
        whole = transform(whole, UPRIGHT[:, :3])
    logging.disable()  # of what reading the file warns, writing it has
    try:
        with Console(stderr=True).status("Measuring what it costs"):
            line = cost_line(file, source, whole.to(fastest_device()), name, seed=details.seed or 0)
    except SundaeError as error:
        line = f"what this costs is not measured: {error}"
    finally:
        logging.disable(logging.NOTSET)
    print(line)


def name_of(path: Path) -> str:
    """The name of a scene: that of its file; of a run, whose folder is CAPTURE/METHOD/TIME, that of its capture."""
    folder = path.resolve() if path.is_dir() else path.resolve().parent
    return (folder.parents[1].name or folder.name) if is_run(path) else path.resolve().stem


def is_run(path: Path) -> bool:
    """Whether a path is the folder of a run, or its ``config.yml``."""
    return (path.is_dir() or path.name == "config.yml") and find_config(path) is not None


def chosen_cameras(scene: Scene, cameras: Path | None, most: int | None) -> Sequence[Camera]:
    """Cameras of a file, or at most ``most`` of a run; by default those stored with the scene, which may be none."""
    if cameras is None:
        return scene.cameras
    if kind_of(cameras) == "packed":
        return load(cameras).cameras
    if is_run(cameras):
        return open_run(cameras, max_cameras=most or VIEWS["cpu"]).cameras
    return cameras_of(cameras, scene)


def warn_if_few(count: int | None, total: int) -> None:
    """Say on stderr that a scene has fewer Gaussians than it should keep."""
    if count is not None and count > total:
        print(f"warning: the scene has {total:,} Gaussians, fewer than {count:,}; all are kept", file=sys.stderr)


def copies_rows(source: Path, out: Path) -> bool:
    """Whether a .ply keeps the rows, properties and comments of another one."""
    return kind_of(source) == "ply" and out.suffix.lower() == ".ply" and has_own_columns(source)
