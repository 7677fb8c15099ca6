"""What commands read: a scene, its cameras, and what to cut from it before anything else."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import torch
from rich.console import Console
from torch import Tensor

from sundae_ns.cli.options import SceneDetails, Wishes
from sundae_ns.cli.refusals import check_file, check_least, check_suffix
from sundae_ns.core.camera import Camera
from sundae_ns.core.errors import ConfigError, DataError, SundaeError
from sundae_ns.core.files import write_bytes
from sundae_ns.core.tables import MEGABYTE
from sundae_ns.cuda.kernels import naming_full_memory
from sundae_ns.io.config_file import check_run, config_of, find_config
from sundae_ns.io.formats import UPRIGHT, kind_of
from sundae_ns.io.pack import container
from sundae_ns.io.ply import has_own_columns, keep_vertices
from sundae_ns.pruning.rule import PruneRule
from sundae_ns.rasterize.interface import fastest_device
from sundae_ns.report.measure import cost_line
from sundae_ns.scene.cameras import opening, read_cameras, spread, with_start
from sundae_ns.scene.compose import crop_mask, floater_mask, transform
from sundae_ns.scene.describe import write_preview
from sundae_ns.scene.load_save import load, load_with_mask, save
from sundae_ns.scene.page import Shown, shown_as, write_page
from sundae_ns.scene.prune_scene import Form, PrunedScene, count_for_drop, prune_to_bytes, prune_with_mask
from sundae_ns.scene.scene import Scene, within
from sundae_ns.scene.virtual_cameras import VIEWS, virtual_cameras


class Edit(NamedTuple):
    """A scene, the options of a command for it, and the result so far."""

    source: Path
    wishes: Wishes
    details: SceneDetails
    scene: Scene
    rows: Tensor  # True for the Gaussians of the file that are left, bool [N]
    cameras: Sequence[Camera]  # those given or stored; of a pruned scene, those that decided
    speed: float | None = None  # of a camera path, frames per second
    form: Form = Form()  # of a file of a given size
    pruned: PrunedScene | None = None
    file: bytes | None = None  # what a search for a size has written

    @property
    def stated(self) -> Scene:
        """The scene, on the CPU, as its form states it."""
        return self.form.of(self.scene.to("cpu"))

    def copies_rows(self, out: Path) -> bool:
        """Whether a .ply keeps the rows, properties and comments of another one."""
        return kind_of(self.source) == "ply" and out.suffix.lower() == ".ply" and has_own_columns(self.source)

    def write(self, out: Path, *, upright: bool = False) -> None:
        """Write the scene, ``upright`` from nerfstudio's axes; a .ply of a .ply keeps its properties and comments."""
        if self.file is not None:
            write_bytes(out, self.file)
        elif self.copies_rows(out):
            moved = (self.pruned and self.pruned.moved) or self.form.degree < self.scene.gaussians.sh_degree
            keep_vertices(self.source, out, self.rows, self.stated.gaussians if moved else None, self.scene.up)
        else:
            if kind_of(self.source) == "ply" and out.suffix.lower() == ".ply":
                print(f"{self.source} is text or has no SH colours; columns of its own are left out", file=sys.stderr)
            save(self.stated, out, upright=upright, config=self.form.precision)

    def cut(self, mask: Tensor) -> Edit:
        """With the Gaussians of a mask."""
        return self._replace(scene=self.scene[mask], rows=within(self.rows, mask.cpu()))

    def cleaned(self) -> Edit:
        """The scene without a head, Gaussians outside the box and floaters, as the options ask."""
        edit = self._replace(scene=replace(self.scene, head=None)) if self.details.no_head else self
        if not self.wishes.cleans:
            return edit
        with naming_full_memory(lambda: len(self.rows)):
            edit = edit._replace(scene=edit.scene.to(fastest_device()))
            if (crop := self.wishes.crop) is not None:
                mask = crop_mask(edit.scene, crop[:3], crop[3:])
                print(f"{int(mask.sum()):,} of {len(mask):,} Gaussians are in the box", file=sys.stderr)
                edit = edit.cut(mask)
            if self.wishes.remove_floaters is not None:
                mask = ~floater_mask(edit.scene, edit.cameras, self.wishes.remove_floaters, Console(stderr=True))
                why = "" if edit.cameras else ", by their neighbours alone: no camera of the photographs is known"
                print(f"removed {int((~mask).sum()):,} floaters of {len(mask):,} Gaussians{why}", file=sys.stderr)
                if not bool(mask.any()):
                    raise DataError("all Gaussians float; leave out --remove-floaters")
                if self.details.preview is not None:
                    write_preview(self.details.preview, edit.scene, edit.scene[mask], edit.cameras)
                edit = edit.cut(mask)
        return edit

    def reduced(
        self,
        out: Path,
        *,
        rule: PruneRule | None = None,
        num_cameras: int | None = None,
        target_drop: float | None = None,
        rounds: bool = True,
        write: Callable[[Edit, Path], object] | None = None,
    ) -> Edit:
        """The scene that the options leave; ``out`` is the file, or one like it, to be written.

        ``rounds`` says whether a size also decides how it is rounded; ``write`` makes what has the size, if not a file.
        """
        edit, wishes = self.cleaned(), self.wishes
        if not wishes.reduces and target_drop is None:
            return edit
        with naming_full_memory(lambda: len(self.rows)):
            scene, cameras, count = edit.scene.to(fastest_device()), edit.cameras, wishes.count
            scene = opening(scene) if out.suffix.lower() in (".html", "") else scene  # once, not for each file
            rule = replace(rule or PruneRule(), seed=self.details.seed or 0)
            if rule.uses_contribution or wishes.max_mb is not None or target_drop is not None:
                cameras = cameras or virtual_cameras(scene, num_cameras, seed=rule.seed)
            if target_drop is not None:
                count, curve = count_for_drop(scene, target_drop, cameras, rule)
                for number, psnr in curve:
                    print(f"{number:12,} Gaussians: {psnr:.2f} dB against the full scene, on held-out cameras")

            def after(pruned: PrunedScene, form: Form = edit.form) -> Edit:
                rows = within(edit.rows, pruned.mask.cpu())
                return edit._replace(scene=pruned.scene, rows=rows, form=form, cameras=cameras, pruned=pruned)

            if wishes.max_mb is None:
                return after(prune_with_mask(scene, wishes.keep, count, cameras, rule, progress=True))
            forms = Form.choices(scene, out.suffix.lower())[: None if rounds else 1]
            warnings: dict[bytes, str] = {}  # by the file whose writing they are of

            def file_of(pruned: PrunedScene, form: Form) -> bytes:
                with redirect_stderr(StringIO()) as messages:
                    (write or Edit.write)(after(pruned, form), Path(folder, out.name))
                file = b"".join(part.read_bytes() for part in Path(folder).rglob("*") if part.is_file())
                warnings[file] = messages.getvalue().replace(folder, str(out.parent))
                return file

            with TemporaryDirectory() as folder:
                pruned, form, file = prune_to_bytes(scene, int(wishes.max_mb * MEGABYTE), file_of, forms, cameras, rule)
            print(warnings[file], end="", file=sys.stderr)
            return after(pruned, form)._replace(file=file)

    def for_page(self, out: Path = Path("page.html"), write: Callable[[Path, Shown], object] = write_page) -> Shown:
        """Name, scene and packed file of what a page shows, which ``write`` makes; a packed scene does not change."""
        source = self.source.resolve()
        name = (source.parent if source.name == "scene.sundae" else source).stem  # sundae run names all packs so
        if is_run(self.source):  # its file is CAPTURE/METHOD/TIME/config.yml
            name = config_of(self.source).resolve().parents[2].name
        left = self.reduced(out, write=lambda edit, path: write(path, shown_as(name, edit.stated, edit.form.precision)))
        same = kind_of(self.source) == "packed" and not (self.wishes.cleans or self.wishes.reduces)
        if not same or self.details.no_head or self.details.cameras is not None:
            return shown_as(name, left.stated, left.form.precision)
        packed = self.source.read_bytes()
        if self.details.start_view is not None or self.details.up is not None:
            from sundae_ns.scene.packing import stated_start  # its encoder needs a compiler, which other files do not

            packed = container.restated(packed, stated_start(left.scene))
        return name, left.scene, packed

    def print_cost(self, file: Path, *, upright: bool = False) -> None:
        """Print what a finished file costs, against the scene as it was opened; of a box, within it."""
        reference, name = replace(self.scene, cameras=tuple(self.cameras)), "the whole scene"
        if (crop := self.wishes.crop) is not None:
            reference, name = reference[crop_mask(reference, crop[:3], crop[3:])], "the scene in the box"
        if upright:
            reference = transform(reference, UPRIGHT[:, :3])
        logging.disable()  # of what reading the file warns, writing it has
        try:
            with Console(stderr=True).status("Measuring what it costs"):
                line = cost_line(file, self.source, reference.to(fastest_device()), name, seed=self.details.seed or 0)
        except SundaeError as error:
            line = f"what this costs is not measured: {error}"
        finally:
            logging.disable(logging.NOTSET)
        print(line)


def opened(source: Path, wishes: Wishes, details: SceneDetails, *, capture: bool = False, most: int = 100) -> Edit:
    """A scene before its wishes, with up, start and cameras of its details; ``capture`` asks for ``most`` of a run."""
    wishes.check_wishes()
    check_least(seed=(details.seed, 0))
    if details.preview is not None:
        if wishes.remove_floaters is None:
            raise ConfigError("--preview shows what --remove-floaters changes; add it")
        check_suffix(details.preview, (".png",))
        check_file(details.preview, reads=[source, details.cameras], overwrite=details.overwrite)
    if is_run(source) and (capture or wishes.remove_floaters is not None or details.data is not None):
        scene, rows = open_run(source, max_cameras=most, data=details.data), None
    elif details.data is not None:
        raise ConfigError(f"--data is the capture of a run, and {source} is none; leave it out")
    else:
        scene, rows = load_with_mask(source)
    cameras, speed = chosen_cameras(scene, details.cameras, None)
    scene = replace(scene, cameras=tuple(cameras[i] for i in spread(len(cameras), most)))
    scene = with_start(scene, details.start_view, details.up)
    rows = torch.ones(len(scene), dtype=torch.bool) if rows is None else rows
    if wishes.count is not None and wishes.count > len(scene):
        print(f"warning: {source} has {len(scene):,} Gaussians, not {wishes.count:,}; all are kept", file=sys.stderr)
    return Edit(source, wishes, details, scene, rows, cameras, speed)


def open_run(run: Path, **options: Any) -> Scene:
    """The scene of a run with cameras of its capture; options as :func:`.finished_runs.load_run`."""
    check_run(run)  # before nerfstudio is imported, which takes seconds
    from sundae_ns.plugin.finished_runs import load_run

    # nerfstudio prints messages while it reads a capture.
    with Console(file=sys.stderr).status("Reading the run"), redirect_stdout(StringIO()):
        return load_run(run, **options)


def is_run(path: Path) -> bool:
    """Whether a path is the folder of a run, or its ``config.yml``."""
    return (path.is_dir() or path.name == "config.yml") and find_config(path) is not None


def chosen_cameras(scene: Scene, path: Path | None, most: int | None) -> tuple[Sequence[Camera], float | None]:
    """Cameras as :func:`.read_cameras`, or at most ``most`` of a run; without a path the stored ones, if any."""
    if path is None:
        return scene.cameras, None
    if kind_of(path) == "packed":
        return load(path).cameras, None
    if is_run(path):
        return open_run(path, max_cameras=most or VIEWS["cpu"]).cameras, None
    return read_cameras(path, scene)
