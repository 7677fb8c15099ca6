"""The paper's eleven scenes, from their folders as published, and the figures that the paper prints.

Yang et al., "Spectrally Pruned Gaussian Fields with Neural Compensation", 2024. Times are omitted: they come from another
machine and were taken without synchronisation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from sundae_ns.cli.bench.plan import Arm, Job, parser_of, plan_scene
from sundae_ns.errors import ConfigError, DataError

DATASETS: Mapping[str, Mapping[str, int]] = {
    "Mip-NeRF 360": {"bicycle": 4, "bonsai": 2, "counter": 2, "garden": 4, "kitchen": 2, "room": 2, "stump": 4},
    "Tanks and Temples": {"train": 1, "truck": 1},
    "Deep Blending": {"drjohnson": 1, "playroom": 1},
}
"""Scenes of each data set, with the divisor of the image sides that papers use: ``images_4`` outdoors, ``images_2``
indoors."""
PRINTED: Mapping[str, Mapping[float, tuple[float, float]]] = {
    # "Ablations of neural compensation" and "Evaluation for different pruning strategies".
    "bicycle": {0.01: (23.23, 0.579), 0.1: (24.36, 0.692), 0.3: (24.40, 0.714), 0.5: (24.46, 0.719)},
    "garden": {0.01: (24.42, 0.651), 0.1: (26.78, 0.811), 0.3: (27.36, 0.843)},
    "counter": {0.5: (28.10, 0.882)},
    # The main table, means over the scenes.
    "Mip-NeRF 360": {0.01: (24.70, 0.716), 0.1: (26.80, 0.805), 0.3: (27.24, 0.826), 0.5: (27.31, 0.827)},
    "Tanks and Temples": {0.01: (20.49, 0.703), 0.1: (22.50, 0.787), 0.3: (23.46, 0.817), 0.5: (23.70, 0.830)},
    "Deep Blending": {0.01: (26.57, 0.861), 0.1: (28.65, 0.892), 0.3: (29.40, 0.899), 0.5: (28.86, 0.900)},
}
"""PSNR in dB and SSIM that the paper prints, by scene or data set and by keep ratio."""


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
    divisors = {scene: divisor for members in DATASETS.values() for scene, divisor in members.items()}
    odd = [scene for scene in scenes if scene not in divisors]
    if odd:
        raise ConfigError(f"{', '.join(odd)} is none of the paper's scenes: {', '.join(divisors)}")
    jobs: list[Job] = []
    missing: list[str] = []
    for scene, divisor in divisors.items():
        if scenes and scene not in scenes:
            continue
        data = find_scene(root, scene)
        if data is None:
            missing.append(scene)
            continue
        parser = parser_of(data, divisor)
        jobs += plan_scene(scene, data, parser, arms, keep_ratios=keep_ratios, seeds=[seed], repeat_at=[])
    if not jobs:
        raise DataError(f"{root} holds none of the scenes {', '.join(missing)}; give the folder of the archives")
    return jobs, missing
