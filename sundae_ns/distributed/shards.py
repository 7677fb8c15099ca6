"""Shards of a field: which rank holds which primitives, and the collectives that move them.

Collectives are those of ``torch.distributed`` on the default process group. All ranks must call a function that says
"collective", in the same order.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, MutableMapping, Sequence
from itertools import pairwise
from typing import Any, TypeVar, cast

import torch
import torch.distributed as dist
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

from sundae_ns.gaussians.parameters import num_primitives
from sundae_ns.gaussians.surgery import change_parameter, check_wiring, per_primitive
from sundae_ns.rasterization.sharded import swap

T = TypeVar("T")

DRIFT = 1.1
"""Rows move between ranks when the largest shard has more than this times the mean."""


def bounds(total: int, ranks: int) -> list[int]:
    """Starts of the blocks of ``total`` rows, and the end of the last: ``ranks + 1`` numbers.

    Blocks differ by at most one row.
    """
    return [total * rank // ranks for rank in range(ranks + 1)]


def moves(counts: Sequence[int], rank: int) -> tuple[list[int], list[int]]:
    """Numbers of rows that a rank sends to and receives from each rank to balance the blocks in their order."""
    ranks, new = len(counts), bounds(sum(counts), len(counts))
    old = [sum(counts[:r]) for r in range(ranks + 1)]

    def shared(holder: int, taker: int) -> int:
        return max(0, min(old[holder + 1], new[taker + 1]) - max(old[holder], new[taker]))

    return [shared(rank, other) for other in range(ranks)], [shared(other, rank) for other in range(ranks)]


class Shards:
    """The ranks, and the number of primitives of each; collectives move tensors of ``device``."""

    def __init__(self, device: torch.device | str) -> None:
        self.rank, self.ranks = dist.get_rank(), dist.get_world_size()
        self.device = torch.device(device)
        self.counts = [0] * self.ranks
        """Primitives of each rank."""
        self.changed: Callable[[], None] = lambda: None
        """Called on all ranks alike whenever primitives move between ranks, appear or disappear."""

    @property
    def total(self) -> int:
        """Primitives of all ranks."""
        return sum(self.counts)

    def numbers(self, *own: int) -> list[list[int]]:
        """Integers of each rank, by rank. Collective."""
        mine = torch.tensor(own, device=self.device)
        every = [torch.empty_like(mine) for _ in range(self.ranks)]
        dist.all_gather(every, mine)
        return [row.tolist() for row in every]

    def recount(self, params: Mapping[str, Tensor]) -> None:
        """Share the number of primitives of each rank. Collective."""
        self.changed()
        self.counts = [count for (count,) in self.numbers(num_primitives(params))]

    def announce(self, thing: Any) -> Any:
        """A plain value of rank 0, on every rank. Collective."""
        box = [thing]
        dist.broadcast_object_list(box, src=0, device=self.device)
        return box[0]

    def by_first(self, compute: Callable[[], T]) -> T:
        """Compute a value in host memory on rank 0, and return it on every rank. Collective."""
        return cast(T, self.announce(compute() if self.rank == 0 else None))

    def gather(self, rows: Tensor, *, host: bool = False) -> Tensor | None:
        """Rows of all ranks, in order, on rank 0; None on the others. Collective.

        Args:
            rows: per-primitive values of this rank ``[N_r, ...]``.
            host: gather in host memory, so that the GPU holds the rows of one other rank at a time.
        """
        rows = rows.detach().contiguous()
        if self.rank != 0:
            if len(rows):
                dist.send(rows, 0)
            return None
        parts = [rows.cpu() if host else rows]
        for other, count in enumerate(self.counts[1:], start=1):
            part = rows.new_empty(count, *rows.shape[1:])
            if count:
                dist.recv(part, other)
            parts.append(part.cpu() if host else part)
        return torch.cat(parts)

    @torch.no_grad()
    def level(
        self,
        params: MutableMapping[str, Parameter],
        optimizers: Mapping[str, Optimizer],
        states: Iterable[MutableMapping[str, Any]],
        mask: Tensor | None = None,
    ) -> None:
        """Balance the ranks in the order of the rows; with a mask, keep the rows under it. Collective.

        Parameters are replaced as by :func:`sundae_ns.gaussians.surgery.keep`: gradients are dropped, moments are kept,
        and other holders of the old parameters must be refreshed.

        Args:
            params: this rank's primitives ``[N_r, ...]``.
            optimizers: by name, one parameter each; others are left alone.
            states: running states; their tensors of N_r rows move too.
            mask: True for primitives to keep, bool ``[N_r]``; None for all.
        """
        self.changed()
        check_wiring(params, optimizers)
        n = num_primitives(params)
        kept = [count for (count,) in self.numbers(n if mask is None else int(mask.sum()))]
        sent, received = moves(kept, self.rank)

        def moved(value: Tensor) -> Tensor:
            return swap(value if mask is None else value[mask], sent, received)

        for name in list(params):
            change_parameter(params, optimizers, name, moved)
        for state in states:
            state.update({key: moved(value) for key, value in state.items() if per_primitive(value, n)})
        self.counts = [end - start for start, end in pairwise(bounds(sum(kept), self.ranks))]

    @torch.no_grad()
    def apart(self, copies: Iterable[Tensor]) -> float:
        """Largest difference between ranks of tensors that should be equal; 0 without any. Collective."""
        numbers = [copy.detach().flatten() for copy in copies]
        if not numbers:
            return 0.0
        own = torch.cat(numbers)
        ends = torch.stack([own, -own])
        dist.all_reduce(ends, dist.ReduceOp.MAX)
        return float(ends.sum(dim=0).max())

    @torch.no_grad()
    def widest(self, span: tuple[float, float] | None) -> tuple[float, float] | None:
        """The span that covers those of all ranks; None if no rank has one. Collective."""
        low, high = span or (math.inf, -math.inf)
        ends = torch.tensor([low, -high], device=self.device, dtype=torch.float64)
        dist.all_reduce(ends, dist.ReduceOp.MIN)
        low, high = ends.tolist()
        return None if math.isinf(low) else (low, -high)

    def summed(self, values: Tensor) -> Tensor:
        """The sum of the tensors of all ranks, in place. Collective."""
        dist.all_reduce(values)
        return values
