"""The results of one run as a plain-text table."""

from __future__ import annotations

from dataclasses import dataclass
from io import StringIO

from rich.console import Console, Group
from rich.table import Table

from sundae_ns.evaluation.document import number
from sundae_ns.evaluation.measured import MEGABYTE


@dataclass(frozen=True)
class Quality:
    """Means over all test views; None if a metric was not measured."""

    psnr: float | None
    """PSNR, dB."""
    ssim: float | None
    lpips: float | None = None


@dataclass(frozen=True)
class RunFigures:
    """Quality, size and speed of one run by stage; None for a stage that was skipped."""

    primitives_before: int
    primitives_after: int
    warm_up: Quality | None
    """Quality just before the prune."""
    after_prune: Quality | None
    """Quality just after the prune, before fine-tuning."""
    base: Quality | None
    """Final quality of the base colours, as viewers show the exported .ply."""
    compensated: Quality | None
    """Final quality with the head."""
    bytes_primitives: int
    bytes_head: int
    ms_frame: float | None = None
    """Milliseconds per frame: splatting and head."""
    ms_splat: float | None = None
    ms_head: float | None = None
    title: str = "SUNDAE"

    @property
    def bytes_total(self) -> int:
        """Bytes of primitives and head."""
        return self.bytes_primitives + self.bytes_head


def _quality_table(figures: RunFigures) -> Table:
    table = Table(title=f"{figures.title}: quality on the test views", title_justify="left")
    table.add_column("stage")
    for column in ("primitives", "PSNR, dB", "SSIM", "LPIPS"):
        table.add_column(column, justify="right")
    stages = (
        ("warm-up", figures.primitives_before, figures.warm_up),
        ("after the prune", figures.primitives_after, figures.after_prune),
        ("final, base colours", figures.primitives_after, figures.base),
        ("final, compensated", figures.primitives_after, figures.compensated),
    )
    for stage, primitives, quality in stages:
        if quality is not None:
            cells = (number(quality.psnr, 2), number(quality.ssim, 4), number(quality.lpips, 4))
            table.add_row(stage, f"{primitives:,}", *cells)
    return table


def _cost_table(figures: RunFigures) -> Table:
    kept = figures.primitives_after / max(figures.primitives_before, 1)
    table = Table(title=f"Cost ({100 * kept:.1f}% of the primitives kept)", title_justify="left")
    table.add_column("")
    for column in ("primitives", "head", "total"):
        table.add_column(column, justify="right")
    sizes = (figures.bytes_primitives, figures.bytes_head, figures.bytes_total)
    table.add_row("size, MB (1e6 bytes)", *(number(size / MEGABYTE, 2) for size in sizes))
    times = (figures.ms_splat, figures.ms_head, figures.ms_frame)
    if any(value is not None for value in times):
        table.add_row("time per frame, ms", *(number(value, 2) for value in times))
    return table


def report_text(figures: RunFigures, *, width: int = 100) -> str:
    """The tables of quality and cost as text, at most ``width`` characters wide."""
    console = Console(file=StringIO(), width=width, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(Group(_quality_table(figures), _cost_table(figures)))
    return "\n".join(line.rstrip() for line in capture.get().splitlines())
