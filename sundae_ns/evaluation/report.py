"""The results of one run as a plain-text table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from io import StringIO

from rich.console import Console
from rich.table import Table

from sundae_ns.evaluation.document import number
from sundae_ns.evaluation.measured import MEGABYTE

Stage = tuple[str, int, Mapping[str, float] | None]
"""Name of a stage of a run, number of primitives, and means over the test views by name; None for a skipped stage."""


def report_text(
    title: str,
    stages: Sequence[Stage],
    sizes: tuple[int, int],
    times: tuple[float, float, float],
    *,
    width: int = 100,
) -> str:
    """Tables of quality and cost as text.

    Args:
        title: of the tables.
        stages: from the full field to the final one.
        sizes: bytes of the primitives and of the head.
        times: milliseconds of splatting, of the head, and of the whole frame.
        width: most characters of a line.
    """
    quality = Table(title=f"{title}: quality on the test views", title_justify="left")
    quality.add_column("stage")
    for column in ("primitives", "PSNR, dB", "SSIM", "LPIPS"):
        quality.add_column(column, justify="right")
    for stage, primitives, metrics in stages:
        if metrics:
            cells = (number(metrics.get(name), digits) for name, digits in (("psnr", 2), ("ssim", 4), ("lpips", 4)))
            quality.add_row(stage, f"{primitives:,}", *cells)

    kept = stages[-1][1] / max(stages[0][1], 1)
    cost = Table(title=f"Cost ({100 * kept:.1f}% of the primitives kept)", title_justify="left")
    cost.add_column("")
    for column in ("primitives", "head", "total"):
        cost.add_column(column, justify="right")
    cost.add_row("size, MB (1e6 bytes)", *(number(size / MEGABYTE, 2) for size in (*sizes, sum(sizes))))
    cost.add_row("time per frame, ms", *(number(value, 2) for value in times))

    console = Console(file=StringIO(), width=width, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(quality, cost)
    return "\n".join(line.rstrip() for line in capture.get().splitlines())
