"""Memory and time that a prune takes on a CPU, so that both are stated, and the memory checked, before it starts."""

from __future__ import annotations

import sys
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import torch

from sundae_ns.api.refit import MOST_PIXELS, STEPS, VIEWS
from sundae_ns.errors import MemoryExhaustedError
from sundae_ns.pruning import PruneRule

LONG = 60.0
"""Seconds from which the cost of a prune is stated."""
_FLOAT = 4
_EDGE, _GRAPH = 17, 160
"""Most bytes of an edge and of a primitive while the graph is built and weighted."""
_INDEX, _MERGE, _MERGED = 12, 160, 20
"""Bytes of an edge and of a primitive during the merge, and of each number of a kept primitive."""
_VIEWED = 140
"""Most bytes of a primitive while a view is rendered, or while the field is put into an order."""
_PAIR = 80
"""Most bytes of an edge while pairs are merged."""
_SECONDS, _SECONDS_OF_VIEW, _SECONDS_OF_PIXEL = 14e-6, 0.7e-6, 0.5e-6
"""Of a primitive in the graph and the merge, of one in a view, and of a pixel; the last two on one thread."""
_SECONDS_OF_FIT, _SECONDS_OF_FIT_PIXEL = 1.2e-6, 0.5e-6
"""Of a kept primitive and of a pixel in a view of the refit, on one thread."""


class PruneCost(NamedTuple):
    """What a prune takes on a CPU, about."""

    memory: int
    """Most memory in use at once, bytes: the field, and what the prune adds."""
    field: int
    """Memory of the field alone, bytes."""
    seconds: float
    """Time with the threads that torch uses now."""
    drawn: int
    """Most memory if primitives are drawn, not merged in pairs, bytes."""

    def __str__(self) -> str:
        minutes = round(self.seconds / 60)
        time = f"{minutes} minutes" if minutes > 1 else "a minute" if self.seconds > 30 else "seconds"
        return f"about {_gigabytes(self.memory)} of memory and {time}"


def prune_cost(
    primitives: int, numbers: int, rule: PruneRule, keep: float, views: int = 0, pixels: int = 0
) -> PruneCost:
    """Estimate a prune.

    Args:
        primitives: number of primitives.
        numbers: numbers of each primitive, 14 at SH degree 0 and 59 at degree 3.
        rule: of the prune.
        keep: share of the primitives to keep.
        views: number of cameras that the rule looks from; 0 if it needs none.
        pixels: number of pixels of all of them.
    """
    field = _FLOAT * numbers * primitives
    added, drawn, seconds = _VIEWED, _VIEWED, 0.0
    if rule.uses_graph:
        merge = round(_INDEX * rule.num_neighbors + _MERGE + keep * numbers * _MERGED)
        drawn = max(_EDGE * rule.num_neighbors + _GRAPH, merge)
        added = max(_PAIR * rule.num_neighbors + _GRAPH, merge) if rule.selection == "pairs" else drawn
        seconds = primitives * _SECONDS
    seen = primitives * views * _SECONDS_OF_VIEW + pixels * _SECONDS_OF_PIXEL
    if rule.refits and views:
        fitted = keep * primitives * _SECONDS_OF_FIT + min(pixels / views, MOST_PIXELS) * _SECONDS_OF_FIT_PIXEL
        seen += STEPS["cpu"] * VIEWS * fitted
    seconds += seen / torch.get_num_threads()
    return PruneCost(field + added * primitives, field, seconds, field + drawn * primitives)


def state(cost: PruneCost, primitives: int, views: int) -> None:
    """Print the cost of a prune of more than a minute on stderr."""
    if cost.seconds > LONG:
        print(f"{primitives:,} primitives, {views} cameras: {cost}", file=sys.stderr, flush=True)


def require_memory(cost: PruneCost, primitives: int, *, loaded: bool) -> None:
    """Refuse a prune that the system would end for its memory.

    Args:
        cost: of the prune.
        primitives: number of primitives.
        loaded: whether the field is in memory already.

    Raises:
        MemoryExhaustedError: less memory is free.
    """
    there, free = cost.field if loaded else 0, free_memory()
    needed = cost.memory - there
    if free is None or needed <= free:
        return
    ways = {
        "selection systematic takes": cost.drawn - there,
        "score opacity, selection top and no merge take": cost.field + _VIEWED * primitives - there,
    }
    fits = (f"; {way} {_gigabytes(size)}" for way, size in ways.items() if size <= free and size < needed)
    cheap = next(fits, "")
    raise MemoryExhaustedError(
        f"a prune of {primitives:,} primitives takes about {_gigabytes(needed)} of memory, and {_gigabytes(free)} are "
        f"free; close other programs, or use a machine with more{cheap}"
    )


def free_memory() -> int | None:
    """Memory that this process may still take, bytes, swap included; None where the system does not tell.

    The least of what the machine has, the limit of a container, and ``ulimit -v``.
    """
    found = []
    with suppress(OSError, ValueError, KeyError):
        lines = dict(line.split(":") for line in Path("/proc/meminfo").read_text(encoding="utf-8").splitlines())
        found.append(sum(int(lines[name].split()[0]) * 1024 for name in ("MemAvailable", "SwapFree")))
    with suppress(OSError, ValueError, KeyError):
        group = Path("/sys/fs/cgroup")
        limit = int((group / "memory.max").read_text(encoding="utf-8"))  # the word max without a limit
        stated = dict(line.split() for line in (group / "memory.stat").read_text(encoding="utf-8").splitlines())
        used = int((group / "memory.current").read_text(encoding="utf-8"))
        found.append(limit - used + int(stated["inactive_file"]))  # files that it would drop
    with suppress(ImportError, OSError, ValueError):
        import resource  # missing on Windows

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[0])
            found.append(limit - pages * resource.getpagesize())
    return max(min(found), 0) if found else None


def _gigabytes(size: int) -> str:
    return f"{size / 1e9:.1f} GB"
