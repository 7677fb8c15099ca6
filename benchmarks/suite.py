"""Measure all methods on every capture of a folder: quality, frames, training times, packed bytes. It resumes.

    python benchmarks/suite.py CAPTURES -o DIR
    python benchmarks/suite.py ARCHIVES -o DIR --paper

Whole methods train from scratch, one job at a time, so that their times are those of their commands. A job that shares
its GPU with another one has no times. Several commands may share DIR: its tables are of all their jobs.

A capture that is missing, damaged or too large for the GPU is named and left out; the exit code is then 1.

With ``--paper`` ARCHIVES holds the unpacked archives (360_v2, tandt, db) of the paper's eleven scenes, or the scenes
themselves. Arms start from a shared warm-up at the paper's keep ratios, and the page has its figures beside ours (Yang
et al., "Spectrally Pruned Gaussian Fields with Neural Compensation", 2024), but not its times: they come from another
machine and were taken without synchronisation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.markup import escape

from harness.arms import choose_arms
from harness.plan import Arm, Job, parser_of, plan_scene
from harness.results import Groups, Result, group, mean_of, percent, quality_page, spread
from harness.rows import read_rows
from harness.run import Options, Runner, check_out, compare, first_jobs, run_script
from sundae_ns.core.errors import ConfigError, DataError
from sundae_ns.core.tables import MEGABYTE, number, table
from sundae_ns.io.pack.config import FINETUNE_STEPS
from sundae_ns.report.measure import METRICS

DATASETS: Mapping[str, Mapping[str, int]] = {
    "Mip-NeRF 360": {"bicycle": 4, "bonsai": 2, "counter": 2, "garden": 4, "kitchen": 2, "room": 2, "stump": 4},
    "Tanks and Temples": {"train": 1, "truck": 1},
    "Deep Blending": {"drjohnson": 1, "playroom": 1},
}
"""Scenes of each data set, with the divisor of the image sides that papers use: ``images_4`` outdoors, ``images_2``
indoors."""
PRINTED = {
    (row["scene"], float(row["keep"])): (float(row["psnr"]), float(row["ssim"]))
    for row in read_rows(Path(__file__).parent / "results" / "paper.csv")
}
"""PSNR in dB and SSIM that the paper prints, by scene or data set and by keep ratio: its ablations and main table."""
ARMS = tuple(
    "splatfacto sundae sundae-with-head sundae-no-head sundae-no-head-bytes band sundae-fast sundae-auto".split()
)
PAPER_ARMS, PAPER_RATIOS = ("sundae", "sundae-no-head", "splatfacto"), (0.01, 0.1, 0.3, 0.5)


@dataclass(frozen=True, kw_only=True)
class SuiteOptions(Options):
    """Options of the script; its folder is that of the captures."""

    arms: tuple[str, ...] = ()
    """files of arms (.yaml), and names of default arms, as of quality.py; those without options train from scratch."""
    keep_ratios: tuple[float, ...] = ()
    """shares of the Gaussians to keep; by default 0.1, with --paper 0.01, 0.1, 0.3 and 0.5."""
    scenes: tuple[str, ...] = ()
    """names of captures to measure; by default every folder in it."""
    paper: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """measure the paper's scenes, on the images of the sizes that papers use."""


def run_suite(options: SuiteOptions, runner: Runner | None = None) -> int:
    """Measure all methods on every capture of a folder; as ``run_quality``, and 1 if a capture is left out."""
    defaults = (PAPER_ARMS, PAPER_RATIOS) if options.paper else (ARMS, (0.1,))
    options = replace(options, arms=options.arms or defaults[0], keep_ratios=options.keep_ratios or defaults[1])
    arms = choose_arms(options.arms, options.method, options.steps_scale, from_scratch=not options.paper)
    check_out(options.out, reads=[path for path, _ in find_captures(options)] if options.paper else [options.folder])
    plan, left_out = plan_suite(options, arms)
    for scene, reason in left_out.items():
        Console().print(f"[yellow]Left out: {escape(f'{scene}: {reason}')}", highlight=False, soft_wrap=True)
    captures = {key: scene for scene, key in first_jobs(plan).items()}

    def page(results: Sequence[Result], failed: Mapping[str, str]) -> str:
        reasons = {captures.get(key, key): reason for key, reason in failed.items()}
        make = paper_page if options.paper else suite_page
        return make(results, arms, {**left_out, **reasons})

    code = compare(plan, options.out, page, runner, whole=not options.paper)
    return code or int(bool(left_out) and not options.paper)


def plan_suite(options: SuiteOptions, arms: Sequence[Arm]) -> tuple[list[Job], dict[str, str]]:
    """Jobs on the captures of a folder, and the reasons for which captures are left out, by name."""
    # Late, since they load the trainer.
    from harness.job import parse
    from sundae_ns.plugin.dataparsers import check_capture

    jobs: list[Job] = []
    left_out: dict[str, str] = {}
    for data, downscale in find_captures(options):
        try:
            parser = parser_of(data, downscale)
            config: Any = parse((options.method, "--data", str(data), *parser)).pipeline.datamanager
            check_capture(config.dataparser, data, ("train", "val"))  # as a training does
        except DataError as error:
            left_out[data.name] = str(error)
            continue
        shares = {"keep_ratios": options.keep_ratios, "repeat_at": options.repeat_at}
        jobs += plan_scene(data, parser, arms, seeds=options.seeds, **shares)
    if options.paper and not jobs:
        raise DataError(f"{options.folder} holds none of the paper's scenes; give the folder of the archives")
    return jobs, left_out


def find_captures(options: SuiteOptions) -> list[tuple[Path, int]]:
    """Folders of captures with their downscale: all that are not hidden, or those named, whether they exist or not."""
    folder, scenes = options.folder.resolve(), options.scenes
    if options.paper:
        divisors = {scene: divisor for members in DATASETS.values() for scene, divisor in members.items()}
        odd = [scene for scene in scenes if scene not in divisors]
        if odd:
            raise ConfigError(f"{', '.join(odd)} is none of the paper's scenes: {', '.join(divisors)}")
        return [(find_scene(folder, scene), divisors[scene]) for scene in scenes or divisors]
    if not folder.is_dir():
        raise DataError(f"{folder} is no folder; give the folder that holds the captures")
    if (folder / "sparse").is_dir() or (folder / "transforms.json").is_file():
        raise DataError(f"{folder} is a capture itself; give the folder that holds it, or use benchmarks/quality.py")
    names = scenes or sorted(path.name for path in folder.iterdir() if path.is_dir() and path.name[0] != ".")
    if not names:
        raise DataError(f"{folder} holds no capture; give the folder that holds the captures")
    return [(folder / name, options.downscale) for name in names]


def find_scene(root: Path, scene: str) -> Path:
    """Folder of a scene: in ``root``, or one or two folders below, as archives unpack (``tandt_db/db/``)."""
    found = [path for pattern in (scene, f"*/{scene}", f"*/*/{scene}") for path in sorted(root.glob(pattern))]
    found = [path for path in found if (path / "sparse" / "0").is_dir()]
    if len(found) > 1:
        paths = ", ".join(str(path) for path in found)
        raise DataError(f"{scene} is there more than once ({paths}); give a folder that holds it once")
    return found[0] if found else root / scene


def suite_page(results: Sequence[Result], arms: Sequence[Arm], left_out: Mapping[str, str]) -> str:
    """All captures: packed bytes, then the page of ``quality_page``."""
    lines = ["# All methods on every capture", ""]
    if left_out:
        lines += ["## Left out", ""]
        # The output of a training that failed ends with the cause.
        lines += [*(f"- {name}: {reason.splitlines()[-1]}" for name, reason in left_out.items()), ""]
    packed, tuned = ([result for result in results if result.get(name)] for name in ("packed", "tuned"))
    lines += ["## Packing", "", "By the defaults of `sundae pack`; errors on all test views.", ""]
    lines += _packing(group(packed, arms), "packed")
    if tuned:
        lines += ["", f"With `--finetune {FINETUNE_STEPS}`, as `sundae run` packs on a GPU.", ""]
        lines += _packing(group(tuned, arms), "tuned")
    return "\n".join([*lines, "", quality_page(results, arms)])


def paper_page(results: Sequence[Result], arms: Sequence[Arm], left_out: Mapping[str, str]) -> str:
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
    if left_out:
        lines += ["", f"Missing: {', '.join(left_out)}."]
    return "\n".join([*lines, "", quality_page(results, arms)])


def _beside_printed(groups: Groups, place: int) -> list[str]:
    """Table of one metric, PSNR (place 0) or SSIM (1): our columns, then the paper's."""
    metric, digits = METRICS[place]
    columns = list(dict.fromkeys((arm, ratio) for _, arm, ratio in groups))
    shares = (0.01, 0.1, 0.3, 0.5)

    def printed(where: str) -> list[str]:
        found = (PRINTED.get((where, share)) for share in shares)
        return ["-" if own is None else f"*{number(own[place], min(digits, 3))}*" for own in found]

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


def _packing(groups: Groups, name: str) -> list[str]:
    rows = []
    for (scene, arm, ratio), own in groups.items():
        means = [result["measured"]["configurations"][0]["mean"] for result in own]
        errors = [
            spread([figures[metric] for figures in place], digits)
            for metric, digits in METRICS[:2]
            for place in (means, [result[name] for result in own])
        ]
        count = spread([result["measured"]["primitives"] for result in own], 0)
        size = spread([result[name]["bytes"] / MEGABYTE for result in own], 2)
        rows.append([scene, arm, percent(ratio), str(len(own)), count, size, *errors])
    heads = ["capture", "arm", "keep", "seeds", "Gaussians", "packed, MB", "PSNR of the run", "packed"]
    return table([*heads, "SSIM of the run", "packed"], rows)


if __name__ == "__main__":
    run_script(SuiteOptions, __doc__, run_suite)
