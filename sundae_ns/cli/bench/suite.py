"""The plan of ``sundae bench suite``: every capture of a folder, each checked before anything is trained."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sundae_ns.cli.bench.options import SuiteOptions
from sundae_ns.cli.bench.plan import Arm, Job, Words, parser_of, plan_scene
from sundae_ns.errors import DataError


def plan_suite(options: SuiteOptions, arms: Sequence[Arm]) -> tuple[list[Job], dict[str, str]]:
    """Jobs on the captures of a folder, capture by capture, and the reasons for which captures are left out, by name.

    Raises:
        ConfigError: a share or seed that cannot be.
        DataError: the folder is missing, is a capture itself, or holds no folder.
    """
    jobs: list[Job] = []
    left_out: dict[str, str] = {}
    for scene, data in find_captures(options.captures, options.scenes).items():
        try:
            parser = parser_of(data, options.downscale)
            check(data, parser, options.method)
        except DataError as error:
            left_out[scene] = str(error)
            continue
        jobs += plan_scene(
            scene,
            data,
            parser,
            arms,
            keep_ratios=options.keep_ratios,
            seeds=options.seeds,
            repeat_at=options.repeat_at,
        )
    return jobs, left_out


def find_captures(folder: Path, scenes: Sequence[str] = ()) -> dict[str, Path]:
    """Folders of captures by name, whether they exist or not.

    Args:
        folder: that holds them.
        scenes: their names; by default all folders that are not hidden.

    Raises:
        DataError: the folder is missing, is a capture itself, or holds no folder.
    """
    if not folder.is_dir():
        raise DataError(f"{folder} is no folder; give the folder that holds the captures")
    if (folder / "sparse").is_dir() or (folder / "transforms.json").is_file():
        raise DataError(f"{folder} is a capture itself; give the folder that holds it, or use sundae bench quality")
    names = scenes or sorted(path.name for path in folder.iterdir() if path.is_dir() and path.name[0] != ".")
    if not names:
        raise DataError(f"{folder} holds no capture; give the folder that holds the captures")
    return {name: (folder / name).resolve() for name in names}


def check(data: Path, parser: Words, method: str) -> None:
    """Check a capture as a training by a method of this package does.

    Raises:
        DataError: it cannot be used.
    """
    # Late, since it loads the trainer.
    from sundae_ns.cli.bench.job import parse
    from sundae_ns.datamanager import check_before_training

    check_before_training(parse((method, "--data", str(data), *parser)).pipeline.datamanager)
