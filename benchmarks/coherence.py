"""Where the local coherence of a field lies: python benchmarks/coherence.py CHECKPOINT...

Shares of the coherence by tenths of the primitives, from the least to the greatest weighted degree in the graph: what it
would spend a budget on. A rule that spends evenly has a tenth in each. Goes to ``benchmarks/results/coherence.json``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch

from sundae_ns.pruning import PruningConfig, coherence, field_graph
from sundae_ns.storage.runs import checkpoint

RESULTS = Path(__file__).parent / "results" / "coherence.json"
PREFIX = "_model.gauss_params."


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkpoints", type=Path, nargs="+")
    parser.add_argument("--keep", type=float, nargs="+", default=[0.1, 0.01])
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args()
    lines = []
    for path in options.checkpoints:
        entries = checkpoint.load(path)["pipeline"]
        params = {name.removeprefix(PREFIX): v.float() for name, v in entries.items() if name.startswith(PREFIX)}
        config = PruningConfig(edges="centres")
        graph = field_graph(params, config)
        tenth = torch.empty(graph.N, dtype=torch.long)
        tenth[graph.dw.argsort(stable=True)] = torch.arange(graph.N) * 10 // graph.N
        for keep in options.keep:
            found = coherence(graph, round(keep * graph.N), config, graph.dw.device)
            share = found / found.sum()
            tenths = torch.zeros(10, dtype=torch.float64).index_add_(0, tenth, share)
            lines.append(
                {
                    "field": path.stem,
                    "primitives": graph.N,
                    "keep": keep,
                    "isolated": round(float(graph.isolated.double().mean()), 4),
                    "share_of_isolated": round(float(share[graph.isolated].sum()), 4),
                    "share_by_tenths_of_degree": [round(value, 4) for value in tenths.tolist()],
                }
            )
            print(json.dumps(lines[-1]))
    options.results.write_text(json.dumps(lines, indent=1) + "\n")


if __name__ == "__main__":
    main()
