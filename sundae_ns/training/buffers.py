"""Memory for more primitives than a field has, so that recorded work survives its growth.

A CUDA graph reads and writes fixed addresses and a fixed number of primitives. :class:`Buffers` holds the parameters of
a field, Adam's moments and the running state of densification at a capacity. The field's own tensors become the first N
rows of these buffers; the rows beyond belong to primitives that no camera sees.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from sundae_ns.gaussians import FEATURES
from sundae_ns.training.densification import STATISTICS
from sundae_ns.training.field_state import FieldState

SPARE = 1.1
"""Capacity for a field that grows, as a multiple of its number of primitives."""

MOMENTS = ("exp_avg", "exp_avg_sq")
"""Adam's moments in the state of its optimizer."""

_UNSEEN = {"means": 1e15, "scales": -30.0, "opacities": -30.0}
"""Values of the rows beyond: behind the far plane, without width, transparent. Others are zero."""


class _Rows(NamedTuple):
    """A tensor of the state with a row for each primitive."""

    name: str
    value: Tensor
    replace: Callable[[Tensor], object]
    """Puts another tensor in its place."""


class Buffers:
    """Tensors of one field at a capacity."""

    def __init__(self) -> None:
        self.tensors: dict[str, Tensor] = {}
        """By parameter name, ``NAME.exp_avg`` or the like for moments, and name for statistics ``[capacity, ...]``."""
        self.capacity = 0
        self._rows = 0

    def hold(self, state: FieldState, trained: tuple[str, ...], *, growing: bool) -> bool:
        """Let the tensors of a field be the first rows of the buffers; what was replaced since the last call is copied.

        Args:
            state: the field; its optimizers have states for the trained parameters.
            trained: names of the parameters that are trained.
            growing: whether the number of primitives will change.

        Returns:
            Whether the buffers are new, so that work on the older ones is void.
        """
        n, rows = state.field.num_primitives, list(_rows_of(state, trained))
        shapes = {row.name: row.value.shape[1:] for row in rows}
        fits = n <= self.capacity <= 2 * n if growing else n == self.capacity
        # Trials widen and narrow features.
        renewed = not fits or shapes != {name: held.shape[1:] for name, held in self.tensors.items()}
        if renewed:
            self.capacity = int(SPARE * n) if growing else n
            for name in self.tensors.keys() - shapes.keys():
                del self.tensors[name]
        for row in rows:
            held = self.tensors.get(row.name)
            if renewed or held is None:
                # One at a time: each replaces the older memory before the next is made.
                held = self.tensors[row.name] = _filled(row, self.capacity)
            elif row.value.data_ptr() == held.data_ptr() and n == self._rows:
                continue
            else:
                _fill(held, row)
            row.replace(held.detach()[:n])
        self._rows = n
        return renewed


def start_moments(state: FieldState, trained: tuple[str, ...]) -> None:
    """Make the state of Adam for parameters that have none, as its first step would."""
    for name in trained:
        for group in state.optimizers[name].param_groups:
            for value in group["params"]:
                held = state.optimizers[name].state[value]
                if not held:
                    held["step"] = torch.zeros((), dtype=torch.float32, device=value.device)
                    held.update({moment: torch.zeros_like(value) for moment in MOMENTS})


def trained_parameters(state: FieldState) -> tuple[str, ...]:
    """Names of the parameters of the field that a step trains: features are trained with the head only."""
    used = (name for name in state.field if name != FEATURES or state.head_enabled)
    return tuple(name for name in used if state.field[name].numel() > 0)


def _rows_of(state: FieldState, trained: tuple[str, ...]) -> Iterator[_Rows]:
    for name in trained:
        value = state.field[name]
        yield _Rows(name, value, partial(setattr, value, "data"))
        moments: dict[str, Any] = state.optimizers[name].state[value]
        for moment in MOMENTS:
            yield _Rows(f"{name}.{moment}", moments[moment], partial(moments.__setitem__, moment))
    if state.densifying:
        for name in STATISTICS:
            value = state.densification.get(name)
            if value is not None:
                yield _Rows(name, value, partial(state.densification.__setitem__, name))


def _filled(row: _Rows, capacity: int) -> Tensor:
    held = row.value.detach().new_empty(capacity, *row.value.shape[1:])
    _fill(held, row)
    return held.requires_grad_(row.value.requires_grad)


@torch.no_grad()
def _fill(held: Tensor, row: _Rows) -> None:
    n = len(row.value)
    held[:n].copy_(row.value)
    held[n:].fill_(_UNSEEN.get(row.name, 0.0))
