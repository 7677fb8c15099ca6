"""Plots of a report. Functions take plain figures and write one file each; nothing is shown, and no global state is set."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from sundae_ns.evaluation.measured import MEGABYTE
from sundae_ns.evaluation.published import NOTE, Printed

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from sundae_ns.evaluation.curves import Curve, Curves
    from sundae_ns.evaluation.measured import Configuration, Measured

DPI = 110
_GRID = {"alpha": 0.3, "linewidth": 0.6}
_PRINTED: Mapping[str, Any] = {"marker": "X", "color": "0.35", "s": 55, "linewidths": 0, "zorder": 4}
_SMOOTHING = 30
"""A running median reaches over this share of the run to both sides, as one in so many."""
_FAINT_RUNS = 2
"""Most runs whose single steps are shown faintly behind their medians; more would hide each other."""


def colors_of(labels: Sequence[str]) -> dict[str, Any]:
    """One colour a label, the same in all plots of a report."""
    palette = colormaps["tab10" if len(labels) <= 10 else "tab20"]
    return {label: palette(i % palette.N) for i, label in enumerate(labels)}


def _figure(rows: int, columns: int, *, width: float = 4.6, height: float = 3.6) -> tuple[Figure, np.ndarray]:
    figure = Figure(figsize=(width * columns, height * rows + 0.6), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, columns, squeeze=False)
    for panel in panels.flat:
        panel.grid(**_GRID)
        panel.spines[["top", "right"]].set_visible(False)
    return figure, panels


def _legend(figure: Figure, handles: Sequence[Any]) -> None:
    # Below the panels, where it hides nothing.
    figure.legend(handles=handles, loc="outside lower center", ncols=min(len(handles), 3), fontsize=8, frameon=False)


def _dots(labels: Sequence[str], colors: Mapping[str, Any]) -> list[Any]:
    return [Line2D([], [], color=colors[label], marker="o", linestyle="none", label=label) for label in labels]


def _number(value: float, _: object = None) -> str:
    """``350k``, ``1.5M``; short labels of an axis."""
    for unit, letter in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= unit:
            return f"{value / unit:g}{letter}"
    return f"{value:g}"


def _log_axis(panel: Axes, values: Sequence[float]) -> None:
    """A logarithmic axis where values span much, with labels that can be read."""
    if not values or min(values) <= 0 or max(values) / min(values) < 4:
        panel.margins(x=0.15)
        panel.xaxis.set_major_locator(MaxNLocator(6))
        panel.xaxis.set_major_formatter(FuncFormatter(_number))
        return
    panel.set_xscale("log")
    span = max(values) / min(values)
    panel.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if span < 100 else (1, 3) if span < 10_000 else (1,)))
    panel.xaxis.set_major_formatter(FuncFormatter(_number))
    panel.xaxis.set_minor_formatter(NullFormatter())


def _cost(run: Measured, configuration: Configuration, axis: str) -> float | None:
    if axis == "ms":
        return configuration.ms
    return configuration.bytes / MEGABYTE if axis == "MB" else float(run.primitives)


def _printed_cost(row: Printed, axis: str) -> float | None:
    if axis == "ms":  # of another machine, taken without waiting for it
        return None
    return row.megabytes if axis == "MB" else row.primitives


def plot_costs(path: Path, runs: Sequence[Measured], colors: Mapping[str, Any], printed: Sequence[Printed]) -> None:
    """PSNR and SSIM against milliseconds, megabytes and primitives: filled with the head, hollow without.

    Args:
        path: the file to write.
        runs: all of one scene.
        colors: from :func:`colors_of`.
        printed: the paper's rows of that scene.
    """
    axes = (("ms", "ms a frame"), ("MB", "MB"), ("primitives", "primitives"))
    figure, panels = _figure(2, 3)
    shown = False
    for line, (metric, unit) in zip(panels, (("psnr", "PSNR, dB"), ("ssim", "SSIM")), strict=True):
        for panel, (axis, title) in zip(line, axes, strict=True):
            values = []
            for run in runs:
                points = []
                for configuration in run.configurations:
                    cost, quality = _cost(run, configuration, axis), configuration.mean(metric)
                    if cost is None or quality is None:
                        continue
                    points.append((cost, quality))
                    with_head = run.has_head and configuration is run.full
                    style = {"facecolor": colors[run.label] if with_head else "none", "edgecolor": colors[run.label]}
                    panel.scatter(cost, quality, marker="o", s=48, linewidths=1.6, zorder=3, **style)
                if len(points) == 2:
                    panel.plot(*zip(*points, strict=True), color=colors[run.label], linewidth=1, alpha=0.6)
                values += [cost for cost, _ in points]
            for row in printed:
                cost, quality = _printed_cost(row, axis), getattr(row, metric)
                if cost is None:
                    continue
                shown = True
                values.append(cost)
                panel.scatter(cost, quality, **_PRINTED)
                panel.annotate(
                    f"{row.keep_ratio:.0%}",
                    (cost, quality),
                    (6, -3),
                    textcoords="offset points",
                    fontsize=7,
                    color="0.35",
                )
            _log_axis(panel, values)
            panel.set_xlabel(title)
            panel.set_ylabel(unit)
            if not values:
                panel.text(0.5, 0.5, "not measured", transform=panel.transAxes, ha="center", color="0.5")
    handles = [
        *_dots([run.label for run in runs], colors),
        Line2D([], [], color="0.2", marker="o", linestyle="none", label="with its head"),
        Line2D([], [], color="0.2", marker="o", linestyle="none", markerfacecolor="white", label="without a head"),
    ]
    if shown:
        handles.append(Line2D([], [], color="0.35", marker="X", linestyle="none", label=f"SUNDAE, {NOTE}"))
    _legend(figure, handles)
    _save(figure, path, f"{runs[0].scene}: quality against cost, means over the test views")


def plot_gain(path: Path, runs: Sequence[Measured], colors: Mapping[str, Any]) -> bool:
    """What the head adds to PSNR and SSIM against the milliseconds it adds.

    Args:
        path: the file to write.
        runs: all of one scene.
        colors: from :func:`colors_of`.

    Returns:
        Whether there was something to plot; without a timed run with a head there is no file.
    """
    compensated = [run for run in runs if run.has_head and run.full.ms is not None and run.bare.ms is not None]
    if not compensated:
        return False
    figure, panels = _figure(1, 2)
    for panel, metric, title in zip(panels[0], ("psnr", "ssim"), ("gain in PSNR, dB", "gain in SSIM"), strict=True):
        for run in compensated:
            with_head, without = run.full.mean(metric), run.bare.mean(metric)
            if with_head is None or without is None:
                continue
            assert run.full.ms is not None
            assert run.bare.ms is not None
            panel.scatter(run.full.ms - run.bare.ms, with_head - without, s=55, color=colors[run.label], zorder=3)
        panel.axhline(0, color="0.4", linewidth=0.8)
        panel.axvline(0, color="0.4", linewidth=0.8)
        panel.margins(0.2)
        panel.set_xlabel("ms a frame more (features and head)")
        panel.set_ylabel(title)
    _legend(figure, _dots([run.label for run in compensated], colors))
    _save(figure, path, "The head's gain over the same field's base colours, against its time")
    return True


def plot_views(path: Path, runs: Sequence[Measured], colors: Mapping[str, Any]) -> None:
    """PSNR of every test view: solid with the head, dashed without.

    Args:
        path: the file to write.
        runs: all of one scene.
        colors: from :func:`colors_of`.
    """
    count = max(len(run.full.views) for run in runs)
    figure, panels = _figure(1, 1, width=min(7 + 0.12 * count, 16), height=3.8)
    panel = panels[0, 0]
    for run in runs:
        for configuration in run.configurations:
            whole = configuration is run.full
            panel.plot(
                range(len(configuration.views)),
                [view.psnr for view in configuration.views],
                color=colors[run.label],
                linestyle="-" if whole else "--",
                marker="o" if whole else None,
                markersize=4,
                linewidth=1.3 if whole else 1,
                alpha=1 if whole else 0.6,
            )
    panel.xaxis.set_major_locator(MaxNLocator(integer=True))
    panel.set_xlabel("test view")
    panel.set_ylabel("PSNR, dB")
    handles: list[Any] = [
        Line2D([], [], color=colors[run.label], marker="o", markersize=4, label=run.label) for run in runs
    ]
    if any(run.has_head for run in runs):
        handles.append(Line2D([], [], color="0.4", linestyle="--", label="the same field, its head off"))
    _legend(figure, handles)
    _save(figure, path, f"{runs[0].scene}: PSNR view by view")


def plot_curves(path: Path, curves: Mapping[str, Curves], colors: Mapping[str, Any]) -> None:
    """Loss, primitives, PSNR of training views with and without the head, and peak memory over training.

    Args:
        path: the file to write.
        curves: by label; at least one.
        colors: from :func:`colors_of`.
    """
    figure, panels = _figure(2, 2, width=5.6, height=3.2)
    titles = ("training loss", "primitives", "PSNR of training views, dB", "peak device memory, MiB")
    for panel, title in zip(panels.flat, titles, strict=True):
        panel.set_ylabel(title)
        panel.set_xlabel("step")
        panel.xaxis.set_major_formatter(FuncFormatter(_number))
    loss, count, psnr, memory = panels.flat
    faint = len(curves) <= _FAINT_RUNS
    for label, run in curves.items():
        _noisy(loss, run.loss, colors[label], faint)
        # Steps, not slopes: a prune happens at once.
        style = {"color": colors[label], "linewidth": 1.3, "drawstyle": "steps-post"}
        count.plot(run.primitives.steps, run.primitives.values, **style)
        _noisy(psnr, run.psnr, colors[label], faint)
        if run.psnr_base.values != run.psnr.values:
            _noisy(psnr, run.psnr_base, colors[label], False, linestyle="--")
        if any(run.memory.values):
            memory.plot(run.memory.steps, run.memory.values, color=colors[label], linewidth=1.3)
    loss.set_yscale("log")
    loss.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    loss.yaxis.set_major_formatter(FuncFormatter(_number))
    loss.yaxis.set_minor_formatter(NullFormatter())
    count.yaxis.set_major_formatter(FuncFormatter(_number))
    count.set_ylim(bottom=0)
    if memory.lines:
        memory.set_ylim(bottom=0)
    else:
        memory.text(0.5, 0.5, "not recorded (no CUDA device)", transform=memory.transAxes, ha="center", color="0.5")
        memory.set(xticks=[], yticks=[])
    handles: list[Any] = [Line2D([], [], color=colors[label], label=label) for label in curves]
    handles.append(Line2D([], [], color="0.4", linestyle="--", label="PSNR without the head"))
    _legend(figure, handles)
    _save(figure, path, "Over training: loss and PSNR as running medians over steps, each step another view")


def _noisy(panel: Axes, curve: Curve, color: Any, faint: bool, linestyle: str = "-") -> None:
    """A curve of single views, each another picture: its running median, and if wanted itself, faintly."""
    if not curve:
        return
    steps, values = np.asarray(curve.steps), np.asarray(curve.values)
    reach = max(len(values) // _SMOOTHING, 1)
    smooth = [np.median(values[max(i - reach, 0) : i + reach + 1]) for i in range(len(values))]
    if faint:
        panel.plot(steps, values, color=color, alpha=0.2, linewidth=0.7)
    panel.plot(steps, smooth, color=color, linestyle=linestyle, linewidth=1.4)


def _save(figure: Figure, path: Path, title: str) -> None:
    figure.suptitle(title, fontsize=11)
    figure.savefig(path, dpi=DPI)
