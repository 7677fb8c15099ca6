"""``sundae export`` and ``sundae prune``: fields as files for other programs."""

from __future__ import annotations

from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sundae_ns.cli.cleaning import Cleaning
from sundae_ns.cli.outputs import Overwrite, check_file, check_folder

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from sundae_ns.api.scene import Scene
    from sundae_ns.rendering import View


def export(
    scene: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    upright: bool = False,
    start_view: str | None = None,
    up: tuple[float, float, float] | None = None,
    data: Path | None = None,
    overwrite: Overwrite = False,
    cleaning: Annotated[Cleaning, tyro.conf.arg(name="")] = Cleaning(),  # noqa: B008
) -> int:
    """Write a scene as a web page with its head (.html or a folder), or its base colours as .ply, .spz, .sog or .glb.

    The page needs no network and no server. The other formats hold no features and no head; antialiased scenes are
    marked as such.

    Args:
        scene: a run (its folder or config.yml), a packed scene, or a .ply, .spz, .sog, .glb, .splat, .ksplat or
            gsplat's .pt.
        out: file to write; its suffix selects the format: .html, .ply or .glb (exact), .spz or .sog (quantised,
            much smaller). A name without a suffix is a folder of page and scene, for a web server.
        upright: rotate the scene from nerfstudio's z-up axes to the -y-up axes of viewers.
            Do not use the rotated file for a warm start.
        start_view: what a page opens with: index of a stored camera, or a camera file as sundae render reads it; by
            default that of a packed scene, else the first camera.
        up: direction about which a page turns, for example 0 0 1; by default that of the scene, else of its cameras.
        data: folder of the capture, if it moved; for a page of a run.
        overwrite: replace an existing file, once the new one is complete.
    """
    from rich.console import Console

    from sundae_ns.errors import ConfigError
    from sundae_ns.storage.formats import check_format
    from sundae_ns.storage.run_folder import files_of

    page = out.suffix.lower() == ".html" or not out.suffix
    if not page:
        check_format(out)
    check = check_file if out.suffix else check_folder
    check(out, reads=[*files_of(scene), data], overwrite=overwrite)
    if page:
        if upright:
            raise ConfigError("a page turns the scene upright by itself; leave out --upright")
        from sundae_ns.api.packing import packed_bytes, stated_start
        from sundae_ns.api.page import write_page
        from sundae_ns.api.views import with_start
        from sundae_ns.storage.pack import container

        opened, packed = open_packed_file(scene, data)
        if cleaning.chosen:
            opened = cleaning.cleaned(opened)
            packed = packed_bytes(opened)
        if start_view is not None or up is not None:
            opened = with_start(opened, start_view, up)
            packed = container.restated(packed, stated_start(opened))
        size = write_page(out, opened, packed, title=out.resolve().stem)
        print(f"{out}: {size:,} bytes; {'open it in a browser' if out.suffix else 'serve it'}")
        return 0
    copies = copies_rows(scene, out)
    if copies and (upright or not cleaning.chosen):
        raise ConfigError(f"{scene} is a .ply already; give an output name that ends in .spz or .sog")
    if start_view is not None or up is not None:
        raise ConfigError(f"{out.suffix} files hold neither a start view nor an up axis; leave them out")
    from sundae_ns.api.cleaning import within
    from sundae_ns.api.files import load, load_with_mask, save_for_viewers
    from sundae_ns.storage.ply import keep_vertices

    if copies:
        found, usable = load_with_mask(scene)
        rows = within(usable, cleaning.mask(found, ()))
        keep_vertices(scene, out, rows)
        print(f"{out}: {int(rows.sum()):,} of {len(rows):,} primitives")
        return 0
    # A run's cameras are in its capture.
    found = open_packed_file(scene, data)[0] if cleaning.remove_floaters else load(scene)
    found = cleaning.cleaned(found)
    if upright and not found.in_model_frame:
        raise ConfigError(f"{scene} is not in nerfstudio's coordinates, which --upright turns; leave it out")
    with Console(stderr=True).status(f"Writing {found.num_primitives:,} primitives"):  # minutes for a .sog of a million
        written = save_for_viewers(found, out, upright=upright)
    mode = ", antialiased" if found.antialiased else ""
    print(f"{out}: {written.primitives:,} primitives, degree {written.degree}{mode}, {written.bytes:,} bytes")
    if written.clamped:
        print(f"clamped scales or colours of {written.clamped:,} primitives to the range of a .spz; a .sog has none")
    if written.cut:
        print(f"left out harmonics above SH degree {written.degree}, which {out.suffix} cannot store; .ply can")
    return 0


def open_packed_file(path: Path, data: Path | None) -> tuple[Scene, bytes]:
    """A scene, and the packed file that holds it; a run, whose capture may have moved, is packed in memory."""
    from sundae_ns.storage.config_file import check_run
    from sundae_ns.storage.formats import kind_of, kind_of_primitives

    if kind_of(path) == "packed" or kind_of_primitives(path) is not None or path.suffix == ".sundae":
        from sundae_ns.api.files import packed_file

        return packed_file(path)
    check_run(path)  # before nerfstudio is imported, which takes seconds
    from sundae_ns.api.packing import packed_bytes
    from sundae_ns.scenes.models import load_run

    with redirect_stdout(StringIO()):  # nerfstudio prints messages while it reads a capture
        scene = load_run(path, data=data)
    return scene, packed_bytes(scene)


def copies_rows(source: Path, out: Path) -> bool:
    """Whether a .ply is written with the rows of another one, its properties and comments."""
    from sundae_ns.storage.formats import kind_of
    from sundae_ns.storage.ply import has_own_columns

    return kind_of(source) == "ply" and out.suffix.lower() == ".ply" and has_own_columns(source)


def check_one(amounts: Mapping[str, float | None]) -> None:
    """Raise ``ConfigError`` if more than one of the options that say how many to keep is given."""
    from sundae_ns.errors import ConfigError

    given = [name for name, value in amounts.items() if value is not None]
    if len(given) > 1:
        raise ConfigError(f"{given[0]} and {given[1]} exclude each other; give one")


def cameras_for(scene: Scene, cameras: Path | None, views: int | None, seed: int) -> Sequence[View]:
    """Cameras that preserve a scene: of a file or a run, else those stored with the scene, else virtual ones."""
    from sundae_ns.api.virtual import virtual_views

    return cameras_of(scene, cameras, views) or virtual_views(scene, views, seed=seed)


def cameras_of(scene: Scene, cameras: Path | None, most: int | None) -> Sequence[View]:
    """Cameras of a file or a run, else those stored with the scene; none if there are none.

    Args:
        scene: whose cameras are the default.
        cameras: the file or the run.
        most: largest number of cameras that are taken from a run.
    """
    from sundae_ns.api.files import load
    from sundae_ns.api.views import views_of
    from sundae_ns.storage.config_file import find_config
    from sundae_ns.storage.formats import kind_of

    if cameras is None:
        return scene.views
    if kind_of(cameras) == "packed":
        return load(cameras).views
    is_run = (cameras.is_dir() or cameras.name == "config.yml") and find_config(cameras) is not None
    if not is_run:
        return views_of(cameras, scene)
    from sundae_ns.storage.config_file import check_run

    check_run(cameras)  # before nerfstudio is imported, which takes seconds
    from sundae_ns.api.virtual import VIEWS
    from sundae_ns.scenes.models import load_run

    with redirect_stdout(StringIO()):  # nerfstudio prints messages while it reads a capture
        return load_run(cameras, max_cameras=most or VIEWS["cpu"]).views


def prune_file(
    source: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    keep: float | None = None,
    count: int | None = None,
    target_drop: float | None = None,
    score: Literal["detail-contribution", "response"] = "detail-contribution",
    selection: Literal["pairs", "systematic", "band"] = "pairs",
    merge: bool = True,
    signal: Literal["attributes", "positions"] = "attributes",
    gamma: float = 0.5,
    views: int | None = None,
    cameras: Path | None = None,
    seed: int = 0,
    overwrite: Overwrite = False,
    cleaning: Annotated[Cleaning, tyro.conf.arg(name="")] = Cleaning(),  # noqa: B008
) -> int:
    """Prune a scene of any program, without its photos.

    Kept are the primitives that virtual cameras see most of; the others are merged into them, and some steps fit pairs
    to the scene's own images. On a CPU a million primitives with three bands of harmonics take about 1.7 GB.

    Args:
        source: a .ply, .spz, .sog, .glb, .splat, .ksplat or gsplat's .pt, a packed scene, or a run.
        out: file to write, in the format of its suffix: .ply, .spz, .sog, .glb or .sundae. A .ply of a .ply keeps all
            properties and comments.
        keep: share of the primitives to keep, of those that a box and the floaters leave, in (0, 1]; by default 0.1.
        count: number of primitives to keep, in place of a share.
        target_drop: keep as few as lose at most this PSNR, in dB, of a full field that shows its photos at 30 dB; by
            the images of held-out cameras.
        score: importance of a primitive: what cameras see of it where there is detail, or its high-pass response.
        selection: pairs merges the two primitives that differ least, weighted by score, until few enough are left.
            Systematic draws at random by score, evenly through space. Band keeps the highest and lowest scores (the
            paper's rule, with score response, signal positions and no merge).
        merge: merge dropped primitives into the kept ones of their groups, or nearest along the neighbour graph.
        signal: graph signal to filter: position, colour, opacity and size, or positions only.
        gamma: share of the kept primitives that the band selection takes from the highest scores.
        views: number of virtual cameras, for scenes that come without cameras; by default 128, on a GPU 256.
        cameras: a transforms.json, a COLMAP model (sparse/0), a camera path, a run or a packed scene, in place of the
            scene's own or virtual cameras.
        seed: random seed.
        overwrite: replace an existing file, once the new one is complete.
    """
    from sundae_ns.api import files, pruning
    from sundae_ns.api.cleaning import kept, within
    from sundae_ns.api.virtual import virtual_views
    from sundae_ns.errors import ConfigError
    from sundae_ns.gpu.kernels import naming_full_memory
    from sundae_ns.pruning import PruneRule
    from sundae_ns.rasterization import fastest_device
    from sundae_ns.storage.ply import keep_vertices

    amounts = {"--keep": keep, "--count": count, "--target-drop": target_drop}
    check_one(amounts)
    if target_drop is None:
        keep = 0.1 if keep is None and count is None else keep
        pruning.check_amount(keep, count)
    if out.suffix.lower() not in files.SUFFIXES:
        raise ConfigError(f"{out} has no supported suffix; name it {', '.join(files.SUFFIXES)}")
    check_file(out, reads=[source, cameras], overwrite=overwrite)
    redistribution: Literal["merge", "none"] = "merge" if merge else "none"
    rule = PruneRule(selection, score, signal, redistribution=redistribution, gamma=gamma, seed=seed)
    rule.validate()
    device = fastest_device()
    scene, usable = files.load_with_mask(source)
    total = scene.num_primitives if usable is None else len(usable)
    with naming_full_memory(lambda: total):
        scene, seen, clean = scene.to(device), None, None
        looks_around = rule.uses_contribution or target_drop is not None
        given = cameras_of(scene, cameras, views) if looks_around or cleaning.remove_floaters else ()
        if cleaning.chosen:
            clean = cleaning.mask(scene, given)
            scene = kept(scene, clean)
        if looks_around:
            seen = given or virtual_views(scene, views, seed=seed)
        if target_drop is not None:
            assert seen is not None
            count, curve = pruning.count_for_drop(scene, target_drop, seen, rule, progress=True)
            for number, psnr in curve:
                print(f"{number:12,} primitives: {psnr:.2f} dB against the full field, on held-out cameras")
        pruned = pruning.prune_with_mask(scene, keep, count, seen, rule, progress=True)
    small = pruned.scene.to("cpu")
    if copies_rows(source, out):
        rows = within(usable, within(clean, pruned.mask).cpu())
        keep_vertices(source, out, rows, small.field if merge else None)
    else:
        files.save(small, out)
    print(f"{out}: {small.num_primitives:,} of {total:,} primitives")
    if pruned.seen is not None and seen:
        print(f"{len(seen)} cameras see {pruned.seen:.1%} of the primitives")
    return 0
