"""``sundae curve``: the curve of expected quality by which a run has chosen its number of primitives."""

from __future__ import annotations

import json
from dataclasses import asdict
from io import BytesIO
from pathlib import Path
from typing import Annotated

import tyro

from sundae_ns.cli.outputs import Overwrite, check_file
from sundae_ns.cli.process import loading
from sundae_ns.errors import CheckpointError, ConfigError


def curve(
    run: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
    overwrite: Overwrite = False,
) -> int:
    """Print how many primitives trials of a run have found necessary: each tried number with what it costs and loses.

    Args:
        run: a run of sundae (its folder or config.yml).
        out: .png to plot the curve to.
        as_json: print JSON in place of the table.
        overwrite: replace an existing file.
    """
    from sundae_ns.evaluation.count_curve import CURVE, curve_table, read_count_curve
    from sundae_ns.storage.config_file import config_of

    folder = config_of(run).parent
    if out is not None:
        if out.suffix.lower() != ".png":
            raise ConfigError(f"{out} does not end in .png, the only format of plots; rename it")
        check_file(out, reads=[folder / CURVE], overwrite=overwrite)
    found = read_count_curve(folder)
    if found is None:
        raise CheckpointError(f"{folder} has no {CURVE}: no trials of counts; train it with ns-train sundae")
    if as_json:
        print(json.dumps(asdict(found), allow_nan=False))
    else:
        lines = [*curve_table(found.points), f"chosen: {found.chosen:,} of {found.full:,}, {found.reason}"]
        print("\n".join(lines))
    if out is not None:
        with loading():
            from sundae_ns.evaluation.plots import plot_counts
            from sundae_ns.storage.atomic import write_bytes

        buffer = BytesIO()
        plot_counts(buffer, found, title="Expected quality against the number of primitives, held-out training views")
        write_bytes(out, buffer.getvalue())
    return 0
