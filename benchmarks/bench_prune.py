"""Time a prune by the default rule, part by part; print one JSON line.

    python benchmarks/bench_prune.py CHECKPOINT --points 500000 >> benchmarks/results/prune.jsonl

The field of a checkpoint is repeated with jitter up to ``--points``, so that clusters, flat primitives and floaters are
those of a trained field. Contributions are random; the pass over the training views is not timed. Times are processor
seconds of all threads on a CPU, and wall-clock seconds on a GPU; ``ratio`` is relative to the graph of centres in the
same run.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sundae_ns.pruning import PruningConfig, decide, field_graph
from sundae_ns.pruning.coverage import neighbor_order, select_systematic
from sundae_ns.pruning.redistribution import heirs, merged
from sundae_ns.storage.runs import checkpoint

PREFIX = "_model.gauss_params."


def field_of(path: Path, points: int, device: str) -> dict[str, Tensor]:
    """The field of a checkpoint, repeated with jitter up to a number of points."""
    entries = checkpoint.load(path)["pipeline"]
    whole = {name.removeprefix(PREFIX): v.float() for name, v in entries.items() if name.startswith(PREFIX)}
    count = len(whole["means"])
    field = {name: value[torch.arange(points) % count].clone() for name, value in whole.items()}
    # Half the size of the primitive: the distance of neighbours in a trained field.
    jitter = torch.randn(points, 3, generator=torch.Generator().manual_seed(0))
    jitter[:count] = 0
    field["means"] += 0.5 * field["scales"].exp().amax(dim=1, keepdim=True) * jitter
    return {name: value.to(device) for name, value in field.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--points", type=int, default=500_000)
    parser.add_argument("--keep", type=float, default=0.1)
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    params = field_of(options.checkpoint, options.points, options.device)
    weight = torch.rand(options.points, generator=torch.Generator().manual_seed(1)).to(options.device)
    config = PruningConfig(keep_ratio=options.keep)
    on_cpu = options.device == "cpu"
    clock = time.process_time if on_cpu else time.perf_counter
    seconds: dict[str, float] = {}

    def timed(name: str, work: Callable[[], Any]) -> Any:
        started = clock()
        result = work()
        if not on_cpu:
            torch.cuda.synchronize()
        seconds[name] = clock() - started
        return result

    if not on_cpu:
        decide(params, config, lambda: weight)  # compile the kernels
        torch.cuda.reset_peak_memory_stats()
    before = _memory(on_cpu)

    def parts() -> float:
        """Share of primitives without an heir. Frees the graph before the whole is measured."""
        timed("graph of centres", lambda: field_graph(params, replace(config, edges="centres")))
        graph = timed("graph with appearance", lambda: field_graph(params, config))
        count = round(options.keep * options.points)
        mask = timed("selection", lambda: select_systematic(weight, count, neighbor_order(params["means"]), 0))
        heir = timed("heirs", lambda: heirs(graph, mask))
        timed("heirs and merge", lambda: merged(params, graph, mask, weight))
        return float((heir < 0).double().mean())

    without_heir = parts()
    timed("decision, whole", lambda: decide(params, config, lambda: weight))
    line = {
        "points": options.points,
        "keep": options.keep,
        "device": options.device if on_cpu else torch.cuda.get_device_name(),
        "threads": torch.get_num_threads(),
        "field": options.checkpoint.name,
        "without_heir": without_heir,
        "seconds": {name: round(value, 3) for name, value in seconds.items()},
        "ratio": {name: round(value / seconds["graph of centres"], 2) for name, value in seconds.items()},
        "extra_mib": round(_memory(on_cpu) - before),
    }
    print(json.dumps(line))


def _memory(on_cpu: bool) -> float:
    """Peak memory so far, MiB."""
    if on_cpu:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return torch.cuda.max_memory_allocated() / 2**20


if __name__ == "__main__":
    main()
