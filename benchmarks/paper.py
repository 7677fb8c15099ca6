"""Measure the paper's eleven scenes at its keep ratios, in one table with the figures that the paper prints.

    python benchmarks/paper.py ARCHIVES -o DIR

ARCHIVES holds the unpacked archives (360_v2, tandt, db), or the scenes themselves. Images as in papers: images_4
outdoors and images_2 indoors of Mip-NeRF 360, every eighth for test.

Yang et al., "Spectrally Pruned Gaussian Fields with Neural Compensation", 2024. Times are omitted: they come from
another machine and were taken without synchronisation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from harness.arms import choose_arms
from harness.plan import Arm, Job, parser_of, plan_scene
from harness.results import Result, group, mean_of, percent, quality_page, spread
from harness.run import Options, Runner, check_out, compare, run_script
from sundae_ns.core.errors import ConfigError, DataError
from sundae_ns.core.tables import number, table
from sundae_ns.report.measured import METRICS

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
    """Folder of a scene: in ``root``, or one or two folders below, as archives unpack (``tandt_db/db/``)."""
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


@dataclass(frozen=True, kw_only=True)
class PaperOptions(Options):
    """Options of the script; its folder is that of the archives."""

    script = "paper.py"
    arms: tuple[str, ...] = ("sundae", "sundae-no-head", "splatfacto")
    """files of arms (.yaml), and names of default arms, as of quality.py."""
    keep_ratios: tuple[float, ...] = (0.01, 0.1, 0.3, 0.5)
    scenes: tuple[str, ...] = ()
    """some of the eleven; by default all that the folder has."""


def run_paper(options: PaperOptions, runner: Runner | None = None, console: Console | None = None) -> int:
    """Measure the paper's scenes; as ``run_quality``."""
    console, arms = console or Console(), choose_arms(options.arms, options.method, options.steps_scale)
    plan, missing = plan_paper(options, arms)
    check_out(options.out, reads=[Path(job.data) for job in plan])
    if missing:
        console.print(f"[yellow]Scenes that are missing and left out: {escape(', '.join(missing))}", highlight=False)

    def page(results: Sequence[Result], failed: Mapping[str, str]) -> str:
        return paper_page(results, arms, missing, options.command())

    return compare(plan, options, page, runner, console)


def plan_paper(options: PaperOptions, arms: Sequence[Arm]) -> tuple[list[Job], list[str]]:
    """Jobs on the paper's scenes, and the names of missing scenes; ``DataError`` if all are missing."""
    divisors = {scene: divisor for members in DATASETS.values() for scene, divisor in members.items()}
    odd = [scene for scene in options.scenes if scene not in divisors]
    if odd:
        raise ConfigError(f"{', '.join(odd)} is none of the paper's scenes: {', '.join(divisors)}")
    jobs: list[Job] = []
    missing: list[str] = []
    for scene in options.scenes or divisors:
        data = find_scene(options.folder.resolve(), scene)
        if data is None:
            missing.append(scene)
            continue
        shares = {"keep_ratios": options.keep_ratios, "repeat_at": options.repeat_at}
        jobs += plan_scene(data, parser_of(data, divisors[scene]), arms, seeds=options.seeds, **shares)
    if not jobs:
        raise DataError(
            f"{options.folder} holds none of the scenes {', '.join(missing)}; give the folder of the archives"
        )
    return jobs, missing


def paper_page(results: Sequence[Result], arms: Sequence[Arm], missing: Sequence[str], command: str) -> str:
    """The paper's scenes at its keep ratios: measured figures beside printed ones, then :func:`quality_page`."""
    groups = group([result for result in results if result["job"]["kind"] != "warm-up"], arms)
    lines = ["# The paper's scenes", ""]
    lines += [
        "Figures in italics are printed in the paper, not measured by us: it may resize images otherwise, and use",
        "another variant of SSIM. Measured: means over the test views, head enabled. A data set has a mean only if all",
        "its scenes are measured; the paper's 3DGS rows of Mip-NeRF 360 are means over nine scenes, not seven.",
    ]
    for place, title in enumerate(("PSNR, dB", "SSIM")):
        lines += ["", f"## {title}", "", *_beside_printed(groups, place)]
    if missing:
        lines += ["", f"Missing: {', '.join(missing)}."]
    return "\n".join([*lines, "", quality_page(results, arms, command)])


def _beside_printed(groups: Mapping[tuple[str, str, float | None], Sequence[Result]], place: int) -> list[str]:
    """Table of one metric, PSNR (place 0) or SSIM (1): our columns, then the paper's."""
    metric, digits = METRICS[place]
    columns = list(dict.fromkeys((arm, ratio) for _, arm, ratio in groups))
    shares = (0.01, 0.1, 0.3, 0.5)

    def printed(where: str) -> list[str]:
        own = PRINTED.get(where, {})
        return [f"*{number(own[share][place], min(digits, 3))}*" if share in own else "-" for share in shares]

    rows = []
    for dataset, members in DATASETS.items():
        means: list[list[float | None]] = [[] for _ in columns]
        for scene in members:
            cells = []
            for column, own_means in zip(columns, means, strict=True):
                results = groups.get((scene, *column), [])
                values = [result["measured"]["configurations"][0]["mean"][metric] for result in results]
                own_means.append(mean_of(values))
                cells.append(spread(values, digits))
            rows.append([scene, *cells, *printed(scene)])
        rows.append([f"**{dataset}**", *(spread([mean_of(own)], digits) for own in means), *printed(dataset)])
    heads = ["scene", *(f"{arm} {percent(ratio)}".rstrip() for arm, ratio in columns)]
    return table([*heads, *(f"*paper {share:.0%}*" for share in shares)], rows, words=1)


if __name__ == "__main__":
    run_script(PaperOptions, __doc__, run_paper)
