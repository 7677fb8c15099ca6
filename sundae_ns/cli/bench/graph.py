"""``sundae bench graph``: time of the neighbour graph and the high-pass response, compared with scipy's k-d tree."""

from __future__ import annotations

import ctypes
import json as jsonlib
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sundae_ns.cli.bench.figures import significant
from sundae_ns.cli.bench.points import Distribution, draw
from sundae_ns.errors import BackendError, ConfigError
from sundae_ns.evaluation.timing import now
from sundae_ns.filters import high_pass
from sundae_ns.graphs import NeighborGraph, build_graph
from sundae_ns.graphs.threads import cores

ROUNDING = 1e-12
"""Relative difference up to which two float64 distances are a tie."""


def run_graph(
    *,
    points: int,
    neighbors: int,
    device: str,
    distribution: Distribution,
    field: Path | None,
    reference: bool,
    repeats: int,
    seed: int,
    json: bool,
) -> int:
    """Measure and print; options are those of the command.

    Raises:
        BackendError: no CUDA device is found, or memory cannot be measured.
        CheckpointError: the field cannot be read.
        ConfigError: an option is invalid.
    """
    if repeats < 1:
        raise ConfigError(f"cannot measure {repeats} timed runs: use at least 1")
    if device == "cuda" and not torch.cuda.is_available():
        raise BackendError("no CUDA device is found: use --device cpu")
    if field is None:
        positions = draw(distribution, points, seed)
    else:
        from sundae_ns.storage.runs.checkpoint import read_field

        positions = read_field(field)[0]["means"]
        positions = positions[torch.isfinite(positions).all(dim=1)]
    result: dict[str, Any] = {
        "benchmark": "graph",
        "points": len(positions),
        "neighbors": neighbors,
        "device": device,
        "device_name": torch.cuda.get_device_name() if device == "cuda" else _threads(),
        "distribution": distribution if field is None else str(field),
        **measure(positions, neighbors, device, repeats, reference),
        "torch": torch.__version__,
    }
    if json:
        print(jsonlib.dumps(result))
    else:
        for name, value in result.items():
            print(f"{name:20} {value}")
    return 0


def measure(positions: Tensor, neighbors: int, device: str, repeats: int, reference: bool) -> dict[str, Any]:
    """Times in seconds, memory in MiB, and errors; figures of the reference are None without it.

    Args:
        positions: positions, float32 on the CPU ``[N, 3]``.
        neighbors: number of neighbours of each point.
        device: device to measure on.
        repeats: number of timed runs, after one untimed run.
        reference: whether to run cKDTree.

    Raises:
        BackendError: memory cannot be measured.
    """
    placed = positions.to(device)
    stages: dict[str, float] = {}

    def run() -> tuple[NeighborGraph, Tensor]:
        started = now(device)
        found = build_graph(placed, num_neighbors=neighbors)
        built = now(device)
        response = high_pass(found, placed)
        stages.update(graph=built - started, response=now(device) - built)
        return found, response

    run()
    times, graphs, responses = [], [], []
    for _ in range(repeats):
        run()
        times.append(sum(stages.values()))
        graphs.append(stages["graph"])
        responses.append(stages["response"])
    (found, response), peak = _with_peak(run, device)
    error, differing = compare_with_float64(placed, neighbors, response)
    result: dict[str, Any] = {
        "seconds": significant(statistics.median(times)),
        "graph_seconds": significant(statistics.median(graphs)),
        "response_seconds": significant(statistics.median(responses)),
        "reference_seconds": None,
        "speedup": None,
        "index_mismatches": None,
        "response_rel_error": significant(error, 3),
        "isolation_mismatches": differing,
        "peak_mib": round(peak / 2**20, 1),
    }
    if reference:
        seconds, distances = _reference(positions, neighbors)
        result["reference_seconds"] = significant(seconds)
        result["speedup"] = significant(seconds / statistics.median(times))
        result["index_mismatches"] = count_mismatches(positions, found.indices.cpu(), distances)
    return result


def count_mismatches(positions: Tensor, indices: Tensor, reference: np.ndarray) -> int:
    """Number of rows of neighbours that are wrong beyond ties.

    A row is correct if its points are distinct, do not include the point itself, and have the distances of the reference:
    then the two sets differ only in points of equal distance.

    Args:
        positions: positions ``[N, 3]``.
        indices: found neighbours, int64 ``[N, K]``.
        reference: ascending distances to the true neighbours, float64 ``[N, K]``.
    """
    wrong = 0
    coordinates = positions.double()
    for start in range(0, len(positions), 2**18):
        rows = slice(start, start + 2**18)
        own = torch.arange(len(positions))[rows, None]
        ordered = torch.cat([indices[rows], own], dim=1).sort(dim=1).values
        repeated = (ordered[:, 1:] == ordered[:, :-1]).any(dim=1)
        differences = coordinates[indices[rows]] - coordinates[rows, None]
        distances = torch.linalg.vector_norm(differences, dim=2).sort(dim=1).values
        true = torch.from_numpy(reference[rows])
        wrong += int((repeated | ((distances - true).abs() > ROUNDING * true).any(dim=1)).sum())
    return wrong


def _reference(positions: Tensor, neighbors: int) -> tuple[float, np.ndarray]:
    """Seconds of cKDTree's build and query on all cores, and the ascending distances without the point itself."""
    from scipy.spatial import cKDTree

    coordinates = positions.double().numpy()
    started = time.perf_counter()
    distances, _ = cKDTree(coordinates).query(coordinates, k=neighbors + 1, workers=-1)
    return time.perf_counter() - started, distances[:, 1:]


def compare_with_float64(placed: Tensor, neighbors: int, response: Tensor) -> tuple[float, int]:
    """Error of a response against the response of the same positions in float64.

    Args:
        placed: positions ``[N, 3]``.
        neighbors: number of neighbours of each point.
        response: high-pass response ``[N, 3]``, NaN for isolated nodes.

    Returns:
        Norm of the difference over the norm in float64, for nodes with neighbours in both; and the number of nodes with
        neighbours in only one of the two.
    """
    double = placed.double()
    exact = high_pass(build_graph(double, num_neighbors=neighbors), double)
    known, found = ~exact.isnan().any(dim=1), ~response.isnan().any(dim=1)
    both = known & found
    norm = float(exact[both].norm())
    error = float((response.double() - exact)[both].norm()) / norm if norm > 0 else 0.0
    return error, int((known != found).sum())


def _with_peak(run: Callable[[], Any], device: str) -> tuple[Any, int]:
    """Result of a run, and the peak of its additional memory in bytes."""
    if device == "cuda":
        torch.cuda.synchronize()
        before = torch.cuda.memory_allocated()
        torch.cuda.reset_peak_memory_stats()
        result = run()
        return result, torch.cuda.max_memory_allocated() - before
    status, reset = Path("/proc/self/status"), Path("/proc/self/clear_refs")
    _give_back()
    try:
        # Linux: writing 5 resets the peak of the resident memory.
        reset.write_text("5")
        before = _resident(status, "VmRSS")
        result = run()
        return result, _resident(status, "VmHWM") - before
    except OSError as error:
        raise BackendError(f"memory cannot be measured ({error}): use Linux") from error


def _give_back() -> None:
    """Return freed memory to the system.

    Otherwise glibc keeps it resident, and the next run reuses it and seems to need almost no additional memory.
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc only
        if trim is not None:
            trim(0)


def _threads() -> str:
    """Numbers of threads of the processor: for the search, and torch's for weights and response."""
    if cores() == torch.get_num_threads():
        return f"CPU, {cores()} threads"
    return f"CPU, {cores()} threads for neighbours, {torch.get_num_threads()} for torch"


def _resident(status: Path, name: str) -> int:
    line = next(line for line in status.read_text().splitlines() if line.startswith(f"{name}:"))
    return 1024 * int(line.split()[1])
