from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from sundae_ns.evaluation import Measured
from sundae_ns.evaluation.document import document, number


def lines_of(text: str, start: str) -> list[list[str]]:
    return [
        [cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith(start)
    ]


def test_each_configuration_has_a_row(measured: Callable[..., Measured]) -> None:
    own = [measured("ours"), measured("theirs", head=False)]
    text = document({"bicycle": own}, {"bicycle": [("A plot", "a.png")]}, ["this and that"], "sundae report x")
    assert lines_of(text, "| ours")[0] == [
        "ours",
        "head on",
        "4,000",
        "3.00",
        "3.50",
        "25.50",
        "0.8500",
        "-",
        "0.2000",
        "-",
        "-",
    ]
    assert lines_of(text, "| ours")[1] == [
        "ours",
        "head off",
        "4,000",
        "1.00",
        "2.00",
        "25.00",
        "0.8000",
        "-",
        "0.2000",
        "-",
        "-",
    ]
    assert [line[:2] for line in lines_of(text, "| theirs")] == [["theirs", "no head"]]
    assert "![A plot](a.png)" in text
    assert "- this and that" in text
    assert "    sundae report x" in text


def test_lpips_names_its_net(measured: Callable[..., Measured]) -> None:
    run = measured(head=False)
    views = tuple(replace(view, lpips=0.25) for view in run.full.views)
    run = replace(run, lpips_net="vgg", configurations=(replace(run.full, views=views),))
    text = document({"a": [run]}, {}, [], "")
    assert "LPIPS (vgg)" in text
    assert "0.2500" in text


def test_numbers() -> None:
    assert number(None, 2) == number(float("nan"), 2) == "-"
    assert number(1234.567, 1) == "1,234.6"
