"""The figures of one run as a table for people."""

from __future__ import annotations

from dataclasses import dataclass
from io import StringIO

from rich.console import Console, Group
from rich.table import Table

_NONE = "-"


@dataclass(frozen=True)
class Quality:
    """Means over all test views; None where a metric was not taken."""

    psnr: float | None
    """dB."""
    ssim: float | None
    lpips: float | None = None


@dataclass(frozen=True)
class RunFigures:
    """What one run did to a field. Stages that did not take place are None."""

    primitives_before: int
    primitives_after: int
    warm_up: Quality | None
    """Just before the prune."""
    after_prune: Quality | None
    """Just after it, nothing optimised yet."""
    base: Quality | None
    """At the end, base colours: what viewers show of the .ply."""
    compensated: Quality | None
    """At the end, through the head."""
    bytes_primitives: int
    bytes_head: int
    ms_frame: float | None = None
    """Splatting and head."""
    ms_splat: float | None = None
    ms_head: float | None = None
    title: str = "SUNDAE"

    @property
    def bytes_total(self) -> int:
        """Everything that has to be stored."""
        return self.bytes_primitives + self.bytes_head


def _number(value: float | None, digits: int) -> str:
    return _NONE if value is None or value != value else f"{value:.{digits}f}"


def _quality_table(figures: RunFigures) -> Table:
    table = Table(title=f"{figures.title}: quality on the test views", title_justify="left")
    table.add_column("stage")
    for column in ("primitives", "PSNR dB", "SSIM", "LPIPS"):
        table.add_column(column, justify="right")
    stages = (
        ("warm-up", figures.primitives_before, figures.warm_up),
        ("after the prune", figures.primitives_after, figures.after_prune),
        ("final, base colours", figures.primitives_after, figures.base),
        ("final, compensated", figures.primitives_after, figures.compensated),
    )
    for stage, primitives, quality in stages:
        if quality is not None:
            cells = (_number(quality.psnr, 2), _number(quality.ssim, 4), _number(quality.lpips, 4))
            table.add_row(stage, f"{primitives:,}", *cells)
    return table


def _cost_table(figures: RunFigures) -> Table:
    kept = figures.primitives_after / max(figures.primitives_before, 1)
    table = Table(title=f"Cost ({100 * kept:.1f} % of the primitives kept)", title_justify="left")
    table.add_column("")
    for column in ("primitives", "head", "total"):
        table.add_column(column, justify="right")
    sizes = (figures.bytes_primitives, figures.bytes_head, figures.bytes_total)
    table.add_row("size, MB of 1e6 bytes", *(f"{size / 1e6:.2f}" for size in sizes))
    times = (figures.ms_splat, figures.ms_head, figures.ms_frame)
    if any(value is not None for value in times):
        table.add_row("time, ms a frame", *(_number(value, 2) for value in times))
    return table


def report_tables(figures: RunFigures) -> Group:
    """Two tables, quality and cost, that a rich console prints."""
    return Group(_quality_table(figures), _cost_table(figures))


def report_text(figures: RunFigures, *, width: int = 100) -> str:
    """The same as plain text, ``width`` columns wide at most."""
    console = Console(file=StringIO(), width=width, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(report_tables(figures))
    return "\n".join(line.rstrip() for line in capture.get().splitlines())
