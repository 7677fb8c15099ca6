"""Plots are read back from matplotlib's own objects; how they look, people judge."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from matplotlib.figure import Figure
from PIL import Image

from sundae_ns.evaluation import Measured
from sundae_ns.evaluation.curves import Curve, Curves
from sundae_ns.evaluation.plots import colors_of, plot_costs, plot_curves, plot_gain, plot_views
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


def texts(figure: Figure) -> str:
    return " ".join(text.get_text() for legend in figure.legends for text in legend.get_texts())


def test_costs(measured: Callable[..., Measured], figures: list[Figure], tmp_path: Path) -> None:
    runs = [measured("ours"), measured("theirs", head=False, psnr=26.0)]
    plot_costs(tmp_path / "a.png", runs, colors_of(["ours", "theirs"]), [])
    with Image.open(tmp_path / "a.png") as picture:
        assert min(picture.size) > 400
    (figure,) = figures
    assert points(figure, 0) == {(3.5, 25.5), (2.0, 25.0), (2.0, 26.0)}
    assert points(figure, 1) == {(3.0, 25.5), (1.0, 25.0), (1.0, 26.0)}
    assert points(figure, 2) == {(4000, 25.5), (4000, 25.0), (4000, 26.0)}
    assert points(figure, 3) == {(3.5, 0.85), (2.0, 0.8)}
    assert "ours" in texts(figure)
    assert NOTE not in texts(figure)


def test_printed_figures_are_drawn_apart_and_named(
    measured: Callable[..., Measured], figures: list[Figure], tmp_path: Path
) -> None:
    plot_costs(tmp_path / "a.png", [measured("ours")], colors_of(["ours"]), printed_of("bicycle", "1237x822"))
    (figure,) = figures
    ours, printed = {(3.0, 25.5), (1.0, 25.0)}, {(43.6, 23.23), (141, 24.36), (447, 24.4), (710, 24.46)}
    assert points(figure, 1) == ours | printed
    # Printed times are of another machine and did not wait for it.
    assert points(figure, 0) == {(3.5, 25.5), (2.0, 25.0)}
    assert NOTE in texts(figure)
    assert {text.get_text() for text in figure.axes[1].texts} == {"1%", "10%", "30%", "50%"}


def test_only_the_same_pictures_compare_with_printed_figures() -> None:
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
    plot_curves(tmp_path / "a.png", {"ours": curves}, colors_of(["ours"]))
    loss, count, psnr, memory = figures[0].axes
    assert len(loss.lines) == 2
    assert list(count.lines[0].get_ydata()) == list(curves.primitives.values)
    # One odd view does not move the median.
    assert [set(map(float, line.get_ydata())) for line in psnr.lines] == [{20.0, 60.0}, {20.0}, {19.0}]
    assert "not recorded" in memory.texts[0].get_text()
