"""Snapshots of a field and its optimizers, their restoration, and narrower parameters."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, MutableMapping

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

from sundae_ns.gaussians.surgery import replace_parameter

Snapshot = dict[str, dict[str, Tensor]]
"""By parameter: its ``value`` and the tensors of its optimizer state, all on the CPU."""


def _moments(optimizer: Optimizer | None, parameter: Tensor) -> dict[str, Tensor]:
    state = {} if optimizer is None else optimizer.state.get(parameter, {})
    return {name: value for name, value in state.items() if isinstance(value, Tensor)}


def _copy(value: Tensor) -> Tensor:
    return value.detach().cpu().clone()


def snapshot(params: Mapping[str, Tensor], optimizers: Mapping[str, Optimizer]) -> Snapshot:
    """Copy a field and the state of its optimizers.

    Args:
        params: the field, name to parameter ``[N, ...]``.
        optimizers: by parameter name, with one parameter each; a parameter may have none.
    """
    return {
        name: {
            "value": _copy(value),
            **{key: _copy(moment) for key, moment in _moments(optimizers.get(name), value).items()},
        }
        for name, value in params.items()
    }


@torch.no_grad()
def restore(
    params: MutableMapping[str, Parameter], optimizers: Mapping[str, Optimizer], saved: Mapping[str, dict[str, Tensor]]
) -> None:
    """Restore a snapshot with any number of primitives, in place on the mappings.

    Replaces the parameter objects, as :func:`sundae_ns.gaussians.surgery.keep` does.
    """
    for name, entries in saved.items():
        old = params[name]
        new = Parameter(entries["value"].to(old.device, copy=True), requires_grad=old.requires_grad)
        moments = {key: value for key, value in entries.items() if key != "value"}
        _replace(params, optimizers, name, new, moments)


@torch.no_grad()
def narrow(params: MutableMapping[str, Parameter], optimizers: Mapping[str, Optimizer], name: str, width: int) -> None:
    """Keep the first ``width`` columns of one parameter ``[N, C, ...]`` and of its moments."""
    old = params[name]
    moments = {
        key: value[:, :width].clone() if value.shape == old.shape else value
        for key, value in _moments(optimizers.get(name), old).items()
    }
    _replace(params, optimizers, name, Parameter(old.detach()[:, :width].clone(), old.requires_grad), moments)


def _replace(
    params: MutableMapping[str, Parameter],
    optimizers: Mapping[str, Optimizer],
    name: str,
    new: Parameter,
    moments: Mapping[str, Tensor],
) -> None:
    optimizer = optimizers.get(name)
    placed = None if optimizer is None else _placed(moments, new, optimizer)
    replace_parameter(params, optimizers, name, new, placed)


def _placed(moments: Mapping[str, Tensor], parameter: Tensor, optimizer: Optimizer) -> dict[str, Tensor]:
    # Adam keeps its step count on the CPU, unless it is fused.
    fused = bool(optimizer.param_groups[0].get("fused"))
    return {
        key: value.to(parameter.device if key != "step" or fused else "cpu", copy=True)
        for key, value in moments.items()
    }


def module_snapshot(parameters: Iterable[Tensor], optimizer: Optimizer) -> Snapshot:
    """Copy the parameters of a network and the state of its optimizer; keys are the parameters' positions."""
    return {
        str(place): {
            "value": _copy(value),
            **{key: _copy(moment) for key, moment in _moments(optimizer, value).items()},
        }
        for place, value in enumerate(parameters)
    }


@torch.no_grad()
def restore_module(parameters: Iterable[Tensor], optimizer: Optimizer, saved: Mapping[str, dict[str, Tensor]]) -> None:
    """Restore a :func:`module_snapshot` in place; keeps the parameter objects."""
    for place, value in enumerate(parameters):
        entries = saved[str(place)]
        value.copy_(entries["value"])
        optimizer.state.pop(value, None)
        moments = {key: moment for key, moment in entries.items() if key != "value"}
        if moments:
            optimizer.state[value] = _placed(moments, value, optimizer)
