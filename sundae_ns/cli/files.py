"""``sundae export`` and ``sundae prune``: fields as files that other people's programs read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro


def check_folder(out: Path) -> None:
    """Raise ``StorageError`` unless the folder of a file to write is there."""
    from sundae_ns.errors import StorageError

    if not out.parent.is_dir():
        raise StorageError(f"{out.parent} is no folder; make it first, or choose another")


def export(
    scene: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    upright: bool = False,
) -> int:
    """Write the base colours of a scene as a .ply, .spz or .sog, which have no place for features or a head.

    Antialiased scenes are marked as such. Primitives that are not finite are left out.

    Args:
        scene: folder of a run, its config.yml, a file of sundae pack, or a 3DGS .ply of any program.
        out: the file; its name says the format: .ply (exact), .spz or .sog (much smaller, rounded). An older one is
            replaced once the new one is whole.
        upright: turn the scene so that viewers show it upright: nerfstudio's z points up, their -y. For showing only; a
            warm start takes the coordinates as they were.
    """
    from sundae_ns.errors import ConfigError
    from sundae_ns.scenes.packed import scene_of_run
    from sundae_ns.storage import is_nerfstudio_ply, ply_comments, read_ply
    from sundae_ns.storage.kinds import kind_of
    from sundae_ns.storage.packing import read_scene
    from sundae_ns.storage.viewers import ANTIALIASED, check_format, write_for_viewers

    check_format(out)
    check_folder(out)
    kind = kind_of(scene)
    if kind == "ply":
        if out.suffix.lower() == ".ply":
            raise ConfigError(f"{scene} is a .ply already; give a name that ends in .spz or .sog")
        if upright and not is_nerfstudio_ply(scene):
            raise ConfigError(f"{scene} is not in nerfstudio's coordinates, which --upright turns; leave it out")
        field, antialiased, sigmoid_colors = read_ply(scene), ANTIALIASED in ply_comments(scene), False
    else:
        packed = kind == "packed" or scene.suffix == ".sundae"
        found = read_scene(scene) if packed else scene_of_run(scene, max_cameras=0)
        stated = found.meta.get("model")
        model = stated if isinstance(stated, dict) else {}
        field, antialiased = found.field, model.get("rasterize_mode") == "antialiased"
        sigmoid_colors = model.get("sh_degree") == 0
    written = write_for_viewers(out, field, antialiased=antialiased, sigmoid_colors=sigmoid_colors, upright=upright)
    mode = ", antialiased" if antialiased else ""
    print(f"{out}: {written.primitives:,} primitives, degree {written.degree}{mode}, {written.bytes:,} bytes")
    if written.dropped:
        print(f"{written.dropped:,} were not finite (NaN or infinite) and are left out")
    if written.cut:
        print(f"harmonics above degree {written.degree} are left out, for which {out.suffix} has no place; .ply has")
    return 0


def prune(
    source: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    keep: float = 0.1,
    score: Literal["response-contribution", "response", "contribution", "opacity", "random"] = "response-contribution",
    selection: Literal["systematic", "sampled", "band", "top"] = "systematic",
    signal: Literal["attributes", "positions"] = "attributes",
    gamma: float = 0.5,
    seed: int = 0,
) -> int:
    """Prune a 3DGS .ply of any program, without training and without cameras.

    What is left has its values unchanged. A contribution to pictures is estimated by opacity and size, for want of cameras.

    Args:
        source: a binary 3DGS .ply.
        out: the .ply to write; all properties and comments of the source are kept.
        keep: share of the primitives to keep, in (0, 1].
        score: importance of a primitive: high-pass response, contribution, their product, opacity, or random.
        selection: by chance in proportion to the score, evenly through space (systematic) or anywhere (sampled); its highest
            and lowest band (the paper's, with score response and signal positions); or the highest only.
        signal: what the graph filters: position, colour, opacity and size, or positions alone.
        gamma: share that the band selection takes from the high end.
        seed: of random choices.
    """
    from sundae_ns.errors import ConfigError
    from sundae_ns.pruning import PruningConfig, decide, footprint
    from sundae_ns.storage import read_ply
    from sundae_ns.storage.kinds import refuse
    from sundae_ns.storage.ply import keep_vertices

    if out.suffix.lower() != ".ply":
        raise ConfigError(f"{out} is not named .ply, the one format that is written; rename it")
    check_folder(out)
    config = PruningConfig(keep_ratio=keep, score=score, selection=selection, signal=signal, gamma=gamma, seed=seed)
    config.validate()
    refuse(source, packed="sundae export makes a .ply of it, which can be pruned")
    field = read_ply(source)
    decision = decide(field, config, lambda: footprint(field))
    keep_vertices(source, out, decision.mask)
    print(f"{out}: {decision.kept:,} of {len(decision.mask):,} primitives")
    if decision.dropped_nonfinite:
        print(f"{decision.dropped_nonfinite:,} were not finite (NaN or infinite) and do not count")
    return 0
