"""Plots are read back from matplotlib's own objects."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from matplotlib.figure import Figure
from PIL import Image

from sundae_ns.evaluation import Measured, ViewQuality
from sundae_ns.evaluation.curves import Curve, Curves
from sundae_ns.evaluation.plots import (
    MOST_SERIES,
    Cost,
    colors_of,
    plot_curves,
    plot_quality,
    plot_views,
)


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    saved: list[Figure] = []
    real = Figure.savefig

    def savefig(self: Figure, *arguments: object, **options: object) -> None:
        saved.append(self)
        real(self, *arguments, **options)

    monkeypatch.setattr(Figure, "savefig", savefig)
    return saved


def points(figure: Figure, panel: int) -> set[tuple[float, float]]:
    scattered = [tuple(xy) for dots in figure.axes[panel].collections for xy in dots.get_offsets().tolist()]
    return {(round(x, 4), round(y, 4)) for x, y in scattered}


def legend(figure: Figure) -> str:
    return " ".join(text.get_text() for legend in figure.legends for text in legend.get_texts())


def test_quality_against_each_cost(measured: Callable[..., Measured], figures: list[Figure], tmp_path: Path) -> None:
    runs = [measured("ours"), measured("theirs", head=False, psnr=26.0)]
    colors = colors_of(["ours", "theirs"])
    costs: tuple[Cost, ...] = ("time", "size", "primitives")
    for cost in costs:
        assert plot_quality(tmp_path / f"{cost}.png", runs, cost, colors)
    with Image.open(tmp_path / "size.png") as image:
        assert min(image.size) > 400
    time, size, primitives = figures
    assert points(time, 0) == {(3.5, 25.5), (2.0, 25.0), (2.0, 26.0)}
    assert points(size, 0) == {(3.0, 25.5), (1.0, 25.0), (1.0, 26.0)}
    assert points(primitives, 0) == {(4000, 25.5), (4000, 25.0), (4000, 26.0)}
    assert points(time, 1) == {(3.5, 0.85), (2.0, 0.8)}
    for figure in figures:
        assert legend(figure) == "ours theirs filled: with the head open: without the head"
        for panel in figure.axes:
            assert "smaller is better" in panel.get_xlabel()
            assert "higher is better" in panel.get_ylabel()


def test_what_was_not_measured_is_not_drawn(
    measured: Callable[..., Measured], figures: list[Figure], tmp_path: Path
) -> None:
    timed, without_ssim = measured("a", head=False), measured("b", head=False)
    views = (ViewQuality(31.0, math.nan),)
    untimed = replace(without_ssim, configurations=(replace(without_ssim.full, ms=None, views=views),))
    colors = colors_of("ab")
    assert not plot_quality(tmp_path / "a.png", [untimed], "time", colors)
    assert not list(tmp_path.iterdir())
    assert plot_quality(tmp_path / "a.png", [timed, untimed], "time", colors)
    assert plot_quality(tmp_path / "a.png", [untimed], "size", colors)
    time, size = figures
    assert points(time, 0) == {(2.0, 25.0)}
    assert points(size, 0) == {(1.0, 31.0)}
    assert len(size.axes) == 1  # no SSIM
    assert legend(size) == "b"  # no head to explain


def test_markers_tell_runs_of_one_colour_apart(
    measured: Callable[..., Measured], figures: list[Figure], tmp_path: Path
) -> None:
    runs = [measured(f"run {i}", head=False) for i in range(12)]
    plot_quality(tmp_path / "a.png", runs, "size", colors_of([run.label for run in runs]))
    keys = [(handle.get_color(), handle.get_marker()) for handle in figures[0].legends[0].legend_handles]
    assert len(keys) == len(set(keys)) == 12


def test_colours_tell_a_plot_of_lines_apart() -> None:
    labels = [str(i) for i in range(MOST_SERIES)]
    assert len(set(colors_of(labels).values())) == MOST_SERIES
    assert colors_of([*labels, "more"])["more"] == colors_of(labels)["0"]


def test_views(measured: Callable[..., Measured], figures: list[Figure], tmp_path: Path) -> None:
    plot_views(tmp_path / "a.png", [measured("ours"), measured("theirs", head=False)], colors_of(["ours", "theirs"]))
    lines = [list(line.get_ydata()) for line in figures[0].axes[0].lines]
    assert lines == [[24.5, 25.5, 26.5], [24.0, 25.0, 26.0], [24.0, 25.0, 26.0]]


def test_curves(figures: list[Figure], tmp_path: Path) -> None:
    steps = tuple(range(100))
    curves = Curves(
        loss=Curve(steps, tuple(1 / (s + 1) for s in steps)),
        primitives=Curve(steps, tuple(1000.0 + s for s in steps)),
        psnr=Curve(steps, (20.0,) * 50 + (60.0,) + (20.0,) * 49),
        psnr_base=Curve(steps, (19.0,) * 100),
    )
    plot_curves(tmp_path / "a.png", {"ours": curves}, colors_of(["ours"]), title="a scene")
    loss, count, psnr, memory = figures[0].axes
    assert len(loss.lines) == 2
    assert list(count.lines[0].get_ydata()) == list(curves.primitives.values)
    # One outlier does not move the median.
    assert [set(map(float, line.get_ydata())) for line in psnr.lines] == [{20.0, 60.0}, {20.0}, {19.0}]
    assert "not recorded" in memory.texts[0].get_text()
