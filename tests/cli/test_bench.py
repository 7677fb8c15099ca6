"""``sundae bench``: what it prints, and that its counts can count."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sundae_ns.cli import main
from sundae_ns.cli.bench.graph import compare_with_float64, count_mismatches
from sundae_ns.cli.bench.points import draw
from sundae_ns.errors import ConfigError
from sundae_ns.filters import high_pass
from sundae_ns.graphs import build_graph, knn
from sundae_ns.storage import write_ply


@pytest.fixture
def bench_graph(capsys: pytest.CaptureFixture[str]) -> Callable[..., dict[str, Any]]:
    def run(*arguments: object) -> dict[str, Any]:
        with pytest.raises(SystemExit) as caught:
            main(["bench", "graph", *map(str, arguments), "--repeats", "1", "--json"])
        assert caught.value.code == 0
        (line,) = capsys.readouterr().out.splitlines()
        return json.loads(line)

    return run


@pytest.mark.parametrize("distribution", ["field", "clusters", "duplicates", "uniform"])
def test_one_line_of_json(bench_graph: Callable[..., dict[str, Any]], distribution: str) -> None:
    found = bench_graph("--points", 3000, "--neighbors", 5, "--distribution", distribution)
    assert (found["points"], found["neighbors"], found["device"]) == (3000, 5, "cpu")
    assert found["distribution"] == distribution
    assert found["index_mismatches"] == 0
    assert 0 < found["response_rel_error"] < 1e-5
    assert found["isolation_mismatches"] == 0
    assert found["seconds"] > 0
    assert found["speedup"] == pytest.approx(found["reference_seconds"] / found["seconds"], rel=0.01)
    assert found["peak_mib"] >= 0


def test_without_the_reference_its_fields_are_empty(bench_graph: Callable[..., dict[str, Any]]) -> None:
    found = bench_graph("--points", 500, "--reference", "false")
    assert found["reference_seconds"] is found["speedup"] is found["index_mismatches"] is None


def test_the_peak_holds_the_results_also_after_earlier_runs(bench_graph: Callable[..., dict[str, Any]]) -> None:
    # Indices, weights, degrees and the response of 100,000 points.
    results = 100_000 * (16 * (8 + 4) + 4 + 3 * 4)
    for _ in range(2):
        found = bench_graph("--points", 100_000, "--neighbors", 16, "--reference", "false")
        assert found["peak_mib"] >= results / 2**20


def test_positions_of_a_file(bench_graph: Callable[..., dict[str, Any]], tmp_path: Path) -> None:
    shapes = {"scales": (3,), "quats": (4,), "features_dc": (3,), "features_rest": (3, 3), "opacities": (1,)}
    field = {"means": torch.randn(400, 3), **{name: torch.zeros(400, *shape) for name, shape in shapes.items()}}
    field["means"][7] = torch.nan
    write_ply(tmp_path / "field.ply", field)
    found = bench_graph("--field", tmp_path / "field.ply")
    assert found["points"] == 399
    assert found["index_mismatches"] == 0


def test_mismatches_are_counted_and_ties_are_not() -> None:
    points = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [-1.0, 0, 0], [0, 3.0, 0], [0, 0, 9.0]])
    true = knn(points.double(), 2)
    assert count_mismatches(points, true.indices, true.distances.numpy()) == 0
    found = true.indices.clone()
    found[3, 1] = 2  # 1 and 2 are equally far from 3
    assert count_mismatches(points, found, true.distances.numpy()) == 0
    for row, neighbours in ((3, [0, 4]), (0, [1, 1]), (4, [4, 0])):
        wrong = found.clone()
        wrong[row] = torch.tensor(neighbours)
        assert count_mismatches(points, wrong, true.distances.numpy()) == 1
    assert count_mismatches(points, found, np.zeros((5, 2))) == 5


def test_a_node_that_is_isolated_in_one_precision_only_is_counted() -> None:
    # The last one has no neighbour within reach, in either.
    points = torch.cat([torch.randn(200, 3, generator=torch.Generator().manual_seed(0)), torch.full((1, 3), 1e4)])
    response = high_pass(build_graph(points, num_neighbors=5), points)
    assert response[-1].isnan().all()
    error, differing = compare_with_float64(points, 5, response)
    assert 0 < error < 1e-5
    assert differing == 0
    response[3] = torch.nan
    response[-1] = 0
    without, differing = compare_with_float64(points, 5, response)
    assert without < 1e-5
    assert differing == 2


@pytest.mark.parametrize(
    ("torchs", "printed"), [(3, "CPU, 3 threads"), (1, "CPU, 3 threads for neighbours, 1 for torch")]
)
def test_the_threads_are_those_of_the_search_and_of_torch(
    bench_graph: Callable[..., dict[str, Any]], monkeypatch: pytest.MonkeyPatch, torchs: int, printed: str
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 4, 5}, raising=False)
    monkeypatch.setattr(torch, "get_num_threads", lambda: torchs)
    assert bench_graph("--points", 100, "--reference", "false")["device_name"] == printed


def test_what_is_drawn() -> None:
    for name in ("field", "clusters", "duplicates", "uniform"):
        points = draw(name, 5000, 0)  # type: ignore[arg-type]
        assert points.shape == (5000, 3)
        assert points.dtype == torch.float32
        assert points.isfinite().all()
        assert torch.equal(points, draw(name, 5000, 0))  # type: ignore[arg-type]
        assert not torch.equal(points, draw(name, 5000, 1))  # type: ignore[arg-type]
        assert draw(name, 1, 0).shape == (1, 3)  # type: ignore[arg-type]
    clones = len(points) - len(draw("duplicates", 5000, 0).unique(dim=0))
    assert 2000 < clones < 3000
    nearest = knn(draw("field", 5000, 0), 1).distances
    assert nearest.max() / nearest[nearest > 0].min() > 1e4
    with pytest.raises(ConfigError, match="at least 1"):
        draw("field", 0, 0)
    with pytest.raises(ConfigError, match="unknown distribution"):
        draw("cubes", 10, 0)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "wrong", [["--points", "0"], ["--repeats", "0"], ["--points", "5"], ["--field", "/no/such.ply"]]
)
def test_errors_are_one_line(wrong: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["bench", "graph", *wrong])
    assert caught.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("sundae: ")


@pytest.mark.gpu
def test_on_a_gpu(bench_graph: Callable[..., dict[str, Any]]) -> None:
    found = bench_graph("--points", 50_000, "--device", "cuda", "--distribution", "duplicates")
    assert found["index_mismatches"] == 0
    assert found["peak_mib"] > 0
