"""The curve of a search, drawn in letters."""

from __future__ import annotations

from sundae_ns.training.budget.record import curve_text
from sundae_ns.training.budget.search import Point


def test_curve_as_text() -> None:
    points = [
        Point(i, "field", count, 0, psnr, "accepted", 5) for i, (count, psnr) in enumerate([(500, 29.0), (1000, 31.0)])
    ]
    lines = curve_text(points, target=30.0).splitlines()
    assert [int(line.split()[0].replace(",", "")) for line in lines] == [1000, 500]
    assert lines[0].count("#") > lines[1].count("#")
    assert "+1.000 to the target" in lines[0]
    assert len({line.index("|") for line in lines}) == 1
    assert curve_text([], 30.0) == ""
