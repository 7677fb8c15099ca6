"""Plots are read back from matplotlib's own objects."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image

from sundae_ns.evaluation import Measured
from sundae_ns.evaluation.curves import Curve, Curves
from sundae_ns.evaluation.plots import (
    MOST_SERIES,
    Cost,
    CostPoint,
    colors_of,
    plot_curves,
    plot_gain,
    plot_quality,
    plot_views,
    points_of,
    printed_point,
)
from sundae_ns.evaluation.published import NOTE, SCENES, printed_of


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


def names(figure: Figure, panel: int) -> list[str]:
    return [text.get_text() for text in figure.axes[panel].texts]


def all_points(runs: list[Measured]) -> list[CostPoint]:
    return [point for run in runs for point in points_of(run)]


def test_quality_against_each_cost(measured: Callable[..., Measured], figures: list[Figure], tmp_path: Path) -> None:
    runs = all_points([measured("ours"), measured("theirs", head=False, psnr=26.0)])
    colors = colors_of(["ours", "theirs"])
    costs: tuple[Cost, ...] = ("time", "size", "primitives")
    for cost in costs:
        assert plot_quality(tmp_path / f"{cost}.png", runs, cost, colors, title="a scene")
    with Image.open(tmp_path / "size.png") as image:
        assert min(image.size) > 400
    time, size, primitives = figures
    assert points(time, 0) == {(3.5, 25.5), (2.0, 25.0), (2.0, 26.0)}
    assert points(size, 0) == {(3.0, 25.5), (1.0, 25.0), (1.0, 26.0)}
    assert points(primitives, 0) == {(4000, 25.5), (4000, 25.0), (4000, 26.0)}
    assert points(time, 1) == {(3.5, 0.85), (2.0, 0.8)}
    for figure in figures:
        assert names(figure, 0) == names(figure, 1) == ["ours", "theirs"]
        assert legend(figure) == "with the head without the head"
        for panel in figure.axes:
            assert "smaller is better" in panel.get_xlabel()
            assert "higher is better" in panel.get_ylabel()


def test_what_was_not_measured_is_not_drawn(figures: list[Figure], tmp_path: Path) -> None:
    runs = [CostPoint("a", 30.0, megabytes=2.0), CostPoint("b", 31.0), CostPoint("c", None, megabytes=3.0)]
    assert not plot_quality(tmp_path / "a.png", runs, "time", colors_of("abc"), title="")
    assert not list(tmp_path.iterdir())
    assert plot_quality(tmp_path / "a.png", runs, "size", colors_of("abc"), title="")
    assert len(figures[0].axes) == 1  # no SSIM
    assert names(figures[0], 0) == ["a"]
    assert not figures[0].legends  # nothing to tell apart


@pytest.mark.parametrize("count", [6, 12])
def test_names_cover_neither_each_other_nor_a_point(count: int, figures: list[Figure], tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    runs = [
        CostPoint(f"method {i}", 30 + generator.normal(), megabytes=50 + 10 * generator.normal()) for i in range(count)
    ]
    labels = [run.label for run in runs]
    plot_quality(tmp_path / "a.png", runs, "size", colors_of(labels), title="")
    (panel,) = figures[0].axes
    assert names(figures[0], 0) == labels
    boxes = [Text.get_window_extent(text) for text in panel.texts]
    dots = panel.transData.transform([(run.megabytes, run.psnr) for run in runs])
    area = panel.get_window_extent()
    for i, box in enumerate(boxes):
        assert area.contains(*box.min)
        assert area.contains(*box.max)
        assert not any(box.overlaps(other) for other in boxes[:i])
        assert not any(box.contains(*dot) for dot in dots)


def test_printed_figures_are_drawn_apart_and_named(
    measured: Callable[..., Measured], figures: list[Figure], tmp_path: Path
) -> None:
    printed = [printed_point(row) for row in printed_of("bicycle", "1237x822")]
    both = all_points([measured("ours")]) + printed
    plot_quality(tmp_path / "a.png", both, "size", colors_of(["ours"]), title="")
    plot_quality(tmp_path / "b.png", both, "time", colors_of(["ours"]), title="")
    size, time = figures
    assert points(size, 0) == {(3.0, 25.5), (1.0, 25.0), (43.6, 23.23), (141, 24.36), (447, 24.4), (710, 24.46)}
    assert names(size, 0) == ["ours", "paper, 1%", "paper, 10%", "paper, 30%", "paper, 50%"]
    assert NOTE in legend(size)
    # Printed times come from another machine and were not synchronised.
    assert points(time, 0) == {(3.5, 25.5), (2.0, 25.0)}
    assert NOTE not in legend(time)


def test_only_images_of_the_same_size_compare_with_printed_figures() -> None:
    assert [row.keep_ratio for row in printed_of("garden", "1297x840")] == [0.01, 0.1, 0.3]
    assert printed_of("garden", "648x420") == []
    assert printed_of("fox", "1061x1893") == []
    assert {row.where for row in SCENES} == {"bicycle", "garden", "counter"}


def test_gain(measured: Callable[..., Measured], figures: list[Figure], tmp_path: Path) -> None:
    assert not plot_gain(tmp_path / "a.png", [measured("theirs", head=False)], colors_of(["theirs"]))
    assert not list(tmp_path.iterdir())
    runs = [measured("theirs", head=False), measured("ours")]
    assert plot_gain(tmp_path / "a.png", runs, colors_of(["theirs", "ours"]))
    assert points(figures[0], 0) == {(1.5, 0.5)}
    assert points(figures[0], 1) == {(1.5, 0.05)}
    assert names(figures[0], 0) == names(figures[0], 1) == ["ours"]


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
