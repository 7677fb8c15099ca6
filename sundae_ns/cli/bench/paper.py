"""The paper's eleven scenes, from their folders as published."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sundae_ns.cli.bench.plan import Arm, Job, parser_of, plan_scene
from sundae_ns.errors import ConfigError, DataError
from sundae_ns.evaluation.published import MEMBERS

OUTDOORS, INDOORS = 4, 2
"""Divisors of the image sides that papers use on Mip-NeRF 360: images_4 and images_2."""


@dataclass(frozen=True)
class PaperScene:
    """One scene as published."""

    scene: str
    """Name of its folder."""
    dataset: str
    downscale: int


PAPER_SCENES = tuple(
    PaperScene(scene, dataset, (OUTDOORS if scene in ("bicycle", "garden", "stump") else INDOORS) if mip else 1)
    for dataset, scenes in MEMBERS.items()
    for mip in (dataset == "Mip-NeRF 360",)
    for scene in scenes
)


def find_scene(root: Path, scene: str) -> Path | None:
    """Folder of a scene: in ``root``, or one or two folders below, as archives unpack (``360_v2/``, ``tandt_db/db/``).

    Raises:
        DataError: there are several.
    """
    found = [
        path
        for pattern in (scene, f"*/{scene}", f"*/*/{scene}")
        for path in sorted(root.glob(pattern))
        if (path / "sparse" / "0").is_dir()
    ]
    if len(found) > 1:
        shown = ", ".join(str(path) for path in found)
        raise DataError(f"{scene} is there more than once ({shown}); give a folder that holds it once")
    return found[0] if found else None


def plan_paper(
    root: Path, arms: Sequence[Arm], *, scenes: Sequence[str], keep_ratios: Sequence[float], seed: int
) -> tuple[list[Job], list[str]]:
    """Jobs on the paper's scenes, and the names of missing scenes.

    Args:
        root: folder with the unpacked archives.
        arms, keep_ratios: as in :func:`plan_scene`.
        scenes: some of the eleven; empty for all.
        seed: of every job.

    Raises:
        ConfigError: a name that is none of the eleven.
        DataError: the folder has none of the scenes, or a scene lacks its images.
    """
    names = [paper_scene.scene for paper_scene in PAPER_SCENES]
    odd = [scene for scene in scenes if scene not in names]
    if odd:
        raise ConfigError(f"{', '.join(odd)} is none of the paper's scenes: {', '.join(names)}")
    jobs: list[Job] = []
    missing: list[str] = []
    for paper_scene in PAPER_SCENES:
        scene = paper_scene.scene
        if scenes and scene not in scenes:
            continue
        data = find_scene(root, scene)
        if data is None:
            missing.append(scene)
            continue
        parser = parser_of(data, paper_scene.downscale)
        jobs += plan_scene(scene, data, parser, arms, keep_ratios=keep_ratios, seeds=[seed], repeat_at=[])
    if not jobs:
        raise DataError(f"{root} holds none of the scenes {', '.join(missing)}; give the folder of the archives")
    return jobs, missing
