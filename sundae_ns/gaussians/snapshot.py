"""Snapshots of a field and its optimizers, their restoration, and narrower parameters."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, MutableMapping

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

from sundae_ns.gaussians.surgery import change_parameter, replace_parameter

Snapshot = dict[str, dict[str, Tensor]]
"""By parameter: its ``value`` and the tensors of its optimizer state, all on the CPU."""


def snapshot(params: Mapping[str, Tensor], optimizers: Mapping[str, Optimizer]) -> Snapshot:
    """Copy a field and the state of its optimizers, by parameter name; a parameter may have none."""
    saved = {}
    for name, value in params.items():
        state = optimizers[name].state.get(value, {}) if name in optimizers else {}
        tensors = {"value": value, **{key: held for key, held in state.items() if isinstance(held, Tensor)}}
        saved[name] = {key: held.detach().cpu().clone() for key, held in tensors.items()}
    return saved


@torch.no_grad()
def restore(
    params: MutableMapping[str, Parameter], optimizers: Mapping[str, Optimizer], saved: Mapping[str, dict[str, Tensor]]
) -> None:
    """Restore a snapshot with any number of primitives, in place on the mappings.

    Replaces the parameter objects, as :func:`sundae_ns.gaussians.surgery.keep` does.
    """
    for name, entries in saved.items():
        value = entries["value"].to(params[name].device, copy=True)
        state = _state(entries, value, optimizers[name]) if name in optimizers else {}
        replace_parameter(params, optimizers, name, value, state)


@torch.no_grad()
def narrow(params: MutableMapping[str, Parameter], optimizers: Mapping[str, Optimizer], name: str, width: int) -> None:
    """Keep the first ``width`` columns of one parameter ``[N, C, ...]`` and of its moments."""
    change_parameter(params, optimizers, name, lambda value: value[:, :width].clone())


def module_snapshot(parameters: Iterable[Tensor], optimizer: Optimizer) -> Snapshot:
    """Copy the parameters of a network and the state of its optimizer; keys are the parameters' positions."""
    named = {str(place): value for place, value in enumerate(parameters)}
    return snapshot(named, dict.fromkeys(named, optimizer))


@torch.no_grad()
def restore_module(parameters: Iterable[Tensor], optimizer: Optimizer, saved: Mapping[str, dict[str, Tensor]]) -> None:
    """Restore a :func:`module_snapshot` in place; keeps the parameter objects."""
    for place, value in enumerate(parameters):
        entries = saved[str(place)]
        value.copy_(entries["value"])
        optimizer.state.pop(value, None)
        if len(entries) > 1:
            optimizer.state[value] = _state(entries, value, optimizer)


def _state(entries: Mapping[str, Tensor], value: Tensor, optimizer: Optimizer) -> dict[str, Tensor]:
    """Optimizer state of a snapshot, on the device of ``value``."""
    # Adam keeps its step count on the CPU, unless it is fused.
    on_host = () if optimizer.param_groups[0].get("fused") else ("step",)
    return {
        key: held.to("cpu" if key in on_host else value.device, copy=True)
        for key, held in entries.items()
        if key != "value"
    }
