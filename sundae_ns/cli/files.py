"""``sundae export`` and ``sundae prune``: fields as files that other people's programs read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro


def _check_out(out: Path) -> None:
    from sundae_ns.errors import ConfigError, StorageError

    if out.suffix.lower() != ".ply":
        raise ConfigError(f"{out} is not named .ply, the one format that is written; rename it")
    if not out.parent.is_dir():
        raise StorageError(f"{out.parent} is no folder; make it first, or choose another")


def export(
    scene: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
) -> int:
    """Write the base colours of a scene as a 3DGS .ply, which has no place for features or a head.

    Args:
        scene: folder of a run, its config.yml, or a file of sundae pack.
        out: the .ply; an older one is replaced once the new one is whole.
    """
    from sundae_ns.packed_run import scene_of_run
    from sundae_ns.storage import MODEL_FRAME, write_ply
    from sundae_ns.storage.packing import read_scene

    _check_out(out)
    packed = scene.suffix == ".sundae"
    found = read_scene(scene) if packed else scene_of_run(scene, max_cameras=0)
    model = found.meta.get("model")
    antialiased = isinstance(model, dict) and model.get("rasterize_mode") == "antialiased"
    write_ply(out, found.field, comments=[MODEL_FRAME, *(["SplatRenderMode: mip"] if antialiased else [])])
    print(f"{out}: {len(found.field['means']):,} primitives{', antialiased' if antialiased else ''}")
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
    from sundae_ns.pruning import PruningConfig, decide, footprint
    from sundae_ns.storage import read_ply
    from sundae_ns.storage.ply import keep_vertices

    _check_out(out)
    config = PruningConfig(keep_ratio=keep, score=score, selection=selection, signal=signal, gamma=gamma, seed=seed)
    config.validate()
    field = read_ply(source)
    decision = decide(field, config, lambda: footprint(field))
    keep_vertices(source, out, decision.mask)
    print(f"{out}: {decision.kept:,} of {len(decision.mask):,} primitives")
    if decision.dropped_nonfinite:
        print(f"{decision.dropped_nonfinite:,} were not finite (NaN or infinite) and do not count")
    return 0
