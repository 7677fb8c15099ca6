"""``sundae export`` and ``sundae prune``: fields as files for other programs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sundae_ns.cli.outputs import Overwrite, check_file, check_folder

if TYPE_CHECKING:
    from torch import Tensor


def _read_primitives(path: Path) -> dict[str, Tensor]:
    """The field of a 3DGS .ply; raises ``DataError`` if none of its primitives is finite."""
    from sundae_ns.errors import DataError
    from sundae_ns.gaussians import finite_mask
    from sundae_ns.storage import read_ply

    field = read_ply(path)
    if not finite_mask(field).any():
        raise DataError(f"{path} has {len(field['means']):,} primitives, and none is finite; export it again")
    return field


def export(
    scene: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    upright: bool = False,
    data: Path | None = None,
    overwrite: Overwrite = False,
) -> int:
    """Write a scene as a web page with its head (.html or a folder), or its base colours as .ply, .spz or .sog.

    The page needs no network and no server. The other formats hold no features and no head; antialiased scenes are
    marked as such, and primitives with NaN or infinite values are left out.

    Args:
        scene: a run (its folder or config.yml), a packed scene, or, for .spz and .sog, a 3DGS .ply of any program.
        out: file to write; its suffix selects the format: .html, .ply (exact), .spz or .sog (quantised, much smaller).
            A name without a suffix is a folder of page and scene, for a web server.
        upright: rotate the scene from nerfstudio's z-up axes to the -y-up axes of viewers.
            Do not use the rotated file for a warm start.
        data: folder of the capture, if it moved; for a page of a run.
        overwrite: replace an existing file, once the new one is complete.
    """
    from rich.console import Console

    from sundae_ns.errors import ConfigError
    from sundae_ns.storage import is_nerfstudio_ply, ply_comments
    from sundae_ns.storage.kinds import kind_of
    from sundae_ns.storage.runs.checkpoint import read_field
    from sundae_ns.storage.runs.config_file import model_options
    from sundae_ns.storage.runs.folder import config_of, files_of
    from sundae_ns.storage.viewers import ANTIALIASED, check_format, write_for_viewers

    page = out.suffix.lower() == ".html" or not out.suffix
    if not page:
        check_format(out)
    check = check_file if out.suffix else check_folder
    check(out, reads=[*files_of(scene), data], overwrite=overwrite)
    kind = kind_of(scene)
    if page:
        if upright:
            raise ConfigError("a page turns the scene upright by itself; leave out --upright")
        return _export_page(scene, out, data)
    if kind == "ply":
        if out.suffix.lower() == ".ply":
            raise ConfigError(f"{scene} is a .ply already; give an output name that ends in .spz or .sog")
        if upright and not is_nerfstudio_ply(scene):
            raise ConfigError(f"{scene} is not in nerfstudio's coordinates, which --upright turns; leave it out")
        field, antialiased, sigmoid_colors = _read_primitives(scene), ANTIALIASED in ply_comments(scene), False
    elif kind == "packed" or scene.suffix == ".sundae":
        from sundae_ns.storage.packing import read_scene  # a decoder that other files do not need

        found = read_scene(scene)
        stated = found.meta.get("model")
        model = stated if isinstance(stated, dict) else {}
        field, antialiased = found.field, model.get("rasterize_mode") == "antialiased"
        sigmoid_colors = model.get("sh_degree") == 0
    else:
        model, sigmoid_colors = model_options(config_of(scene)), False
        field, _ = read_field(config_of(scene).parent)
        antialiased = model.get("rasterize_mode") == "antialiased"
    with Console(stderr=True).status(f"Writing {len(field['means']):,} primitives"):  # minutes for a .sog of a million
        written = write_for_viewers(out, field, antialiased=antialiased, sigmoid_colors=sigmoid_colors, upright=upright)
    mode = ", antialiased" if antialiased else ""
    print(f"{out}: {written.primitives:,} primitives, degree {written.degree}{mode}, {written.bytes:,} bytes")
    if written.dropped:
        print(f"left out {written.dropped:,} primitives that were not finite (NaN or infinite)")
    if written.clamped:
        print(f"clamped scales or colours of {written.clamped:,} primitives to the range of a .spz; a .sog has none")
    if written.cut:
        print(f"left out harmonics above SH degree {written.degree}, which {out.suffix} cannot store; .ply can")
    return 0


def _export_page(scene: Path, out: Path, data: Path | None) -> int:
    with packed_scene(scene, data=data) as packed, redirect_stdout(StringIO()):
        from sundae_ns.scenes.page import write_folder, write_page

        write = write_page if out.suffix else write_folder
        written = write(packed, out, title=out.resolve().stem)
    print(f"{out}: {written:,} bytes; open it in a browser" if out.suffix else f"{out}: {written:,} bytes; serve it")
    return 0


@contextmanager
def packed_scene(scene: Path, *, data: Path | None = None) -> Iterator[Path]:
    """A packed scene as it is, or a run, whose capture may have moved, packed into a temporary file."""
    from sundae_ns.storage.kinds import kind_of
    from sundae_ns.storage.packing import write_scene
    from sundae_ns.storage.runs.config_file import check_run

    if kind_of(scene) == "packed" or scene.suffix == ".sundae":
        yield scene
        return
    check_run(scene)
    from sundae_ns.scenes.packed import scene_of_run

    with TemporaryDirectory() as folder:
        path = Path(folder) / "scene.sundae"
        with redirect_stdout(StringIO()):  # nerfstudio prints messages while it reads a capture
            write_scene(path, scene_of_run(scene, data=data))
        yield path


def prune(
    source: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    keep: float = 0.1,
    score: Literal["response-contribution", "response", "contribution", "opacity", "random"] = "response-contribution",
    selection: Literal["systematic", "sampled", "band", "top"] = "systematic",
    signal: Literal["attributes", "positions"] = "attributes",
    gamma: float = 0.5,
    seed: int = 0,
    overwrite: Overwrite = False,
) -> int:
    """Prune a 3DGS .ply of any program, without training and without cameras.

    The kept primitives are unchanged. Without cameras, contributions are estimated from opacity and size.

    Args:
        source: binary 3DGS .ply file.
        out: .ply file to write; it keeps all properties and comments of the source.
        keep: share of the primitives to keep, in (0, 1].
        score: importance of a primitive: high-pass response, contribution, their product, opacity, or a random number.
        selection: systematic and sampled draw at random by score, evenly through space or independently.
            Band keeps the highest and lowest scores (the paper's rule, with score response and signal positions).
            Top keeps the highest scores.
        signal: graph signal to filter: position, colour, opacity and size, or positions only.
        gamma: share of the kept primitives that the band selection takes from the highest scores.
        seed: random seed.
        overwrite: replace an existing file, once the new one is complete.
    """
    from rich.console import Console

    from sundae_ns.errors import ConfigError
    from sundae_ns.gaussians import finite_mask
    from sundae_ns.pruning import PruneRule, check_share, decide, footprint, kept_count
    from sundae_ns.storage.kinds import refuse
    from sundae_ns.storage.ply import keep_vertices

    if out.suffix.lower() != ".ply":
        raise ConfigError(f"{out} does not end in .ply, the only output format; rename it")
    check_file(out, reads=[source], overwrite=overwrite)
    check_share(keep)
    rule = PruneRule(score=score, selection=selection, signal=signal, gamma=gamma, seed=seed)
    rule.validate()
    refuse(source, packed="sundae export makes a .ply of it, which can be pruned")
    field = _read_primitives(source)
    count = kept_count(keep, int(finite_mask(field).sum()))
    with Console(stderr=True).status(f"Choosing {count:,} primitives"):
        decision = decide(field, rule, count, footprint(field))
        keep_vertices(source, out, decision.mask)
    print(f"{out}: {decision.kept:,} of {len(decision.mask):,} primitives")
    if decision.dropped_nonfinite:
        print(f"dropped {decision.dropped_nonfinite:,} primitives that were not finite (NaN or infinite)")
    return 0
