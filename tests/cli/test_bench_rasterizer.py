"""``sundae bench rasterizer``: its rows, that its errors can see one, and that it can be cut and continued."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from sundae_ns.cli import main
from sundae_ns.cli.bench.rasterizer import Case, draw_view, measure, parse_shard, render
from sundae_ns.errors import ConfigError
from sundae_ns.rasterization import select_backend

Rows = list[dict[str, Any]]
SMALL = ("--counts", "40", "90", "--size", "20", "16", "--channels", "3", "--repeats", "1")


@pytest.fixture
def bench(capsys: pytest.CaptureFixture[str]) -> Callable[..., Rows]:
    def run(*arguments: object) -> Rows:
        with pytest.raises(SystemExit) as caught:
            main(["bench", "rasterizer", *SMALL, *map(str, arguments), "--json"])
        assert caught.value.code == 0
        return [json.loads(line) for line in capsys.readouterr().out.splitlines()]

    return run


def test_a_row_for_every_case(bench: Callable[..., Rows]) -> None:
    rows = bench("--rasterizers", "cpu", "reference")
    assert [(row["primitives"], row["rasterizer"], row["dtype"]) for row in rows] == [
        (n, name, dtype) for n in (40, 90) for name in ("cpu", "reference") for dtype in ("float32", "float64")
    ]
    for row in rows:
        assert row["forward_ms"] > 0
        assert row["forward_backward_ms"] > 0
        assert row["forward_backward_cpu_ms"] > 0
        assert row["mean_error"] <= row["max_error"]
        assert row["gradient_error"] == max(v for k, v in row.items() if k.startswith("gradient_error_"))
        limit = 1e-12 if row["dtype"] == "float64" else 1e-4
        assert row["max_error"] < limit
        assert row["gradient_error"] < limit
        oracle = row["rasterizer"] == "reference" and row["dtype"] == "float64"
        assert (row["max_error"] == 0) == (row["gradient_error"] == 0) == oracle


def test_errors_are_seen() -> None:
    case = Case("cpu", "cpu", "float64", 30, 16, 16, 2, 2.0, 0, torch.get_num_threads())
    backend = select_backend("reference", "cpu")
    pulls = torch.ones(16, 16, 2, dtype=torch.float64), torch.ones(16, 16, 1, dtype=torch.float64)
    exact = render(case, *draw_view(case), pulls, backend)
    assert measure(case, exact, 1)["gradient_error"] > 0.1  # of another loss
    assert measure(case, exact, 1)["max_error"] < 1e-12
    exact["image"][3, 4, 1] += 0.25
    found = measure(case, exact, 1)
    assert found["max_error"] == pytest.approx(0.25)
    assert found["mean_error"] == pytest.approx(0.25 / (16 * 16 * 3), rel=1e-3)


def test_primitives_are_as_large_as_asked_for() -> None:
    scene, camera = draw_view(Case("cpu", "cpu", "float32", 2000, 200, 100, 2, 3.0, 0, 1))
    on_screen = scene["scales"] / scene["means"][:, 2:] * camera["K"][0, 0]
    assert 1.49 < float(on_screen.min()) < float(on_screen.max()) < 4.51
    assert float(on_screen.mean()) == pytest.approx(3.0, rel=0.02)


def test_shards_are_the_whole_and_a_file_is_continued(bench: Callable[..., Rows], tmp_path: Path) -> None:
    common = ("--rasterizers", "cpu", "--output", tmp_path / "rows.jsonl")
    first, second = bench(*common, "--shard", "1/2"), bench(*common, "--shard", "2/2")
    assert [(row["primitives"], row["dtype"]) for row in first] == [(40, "float32"), (90, "float32")]
    assert [(row["primitives"], row["dtype"]) for row in second] == [(40, "float64"), (90, "float64")]
    assert bench(*common) == []
    assert len(bench(*common, "--seed", 1)) == 4
    lines = (tmp_path / "rows.jsonl").read_text().splitlines()
    assert [json.loads(line) for line in lines[:4]] == first + second
    assert len(lines) == 8


def test_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["bench", "rasterizer", *SMALL, "--rasterizers", "cpu"])
    out = capsys.readouterr().out
    assert out.count("float32") == out.count("float64") == 2


def test_what_cannot_be_measured() -> None:
    for shard in ("0/2", "3/2", "1", "a/b", "1/2/3", ""):
        with pytest.raises(ConfigError, match="i/n"):
            parse_shard(shard)
    assert parse_shard("2/3") == (1, 3)


def test_a_broken_file_is_not_appended_to(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "rows.jsonl").write_text('{"benchmark": "raster')
    with pytest.raises(SystemExit) as caught:
        main(["bench", "rasterizer", *SMALL, "--output", str(tmp_path / "rows.jsonl")])
    assert caught.value.code != 0
    assert "line 1 is no JSON" in capsys.readouterr().err
    assert (tmp_path / "rows.jsonl").read_text() == '{"benchmark": "raster'
