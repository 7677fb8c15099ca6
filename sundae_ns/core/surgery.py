"""Surgery on Gaussians in training, with optimizer and running states; snapshots of Gaussians or a network."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, MutableMapping
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

from sundae_ns.core.errors import DataError
from sundae_ns.core.gaussians import num_gaussians

Params = MutableMapping[str, Parameter]
Optimizers = Mapping[str, Optimizer]
Snapshot = dict[str, dict[str, Tensor]]  # by parameter: its value and its optimizer state, all on the CPU


def check_wiring(params: Mapping[str, Tensor], optimizers: Optimizers) -> None:
    """Raise ``DataError`` unless parameters have one length and the optimizers of their names, if any, hold them."""
    n = num_gaussians(params)
    for name, value in params.items():
        if not per_gaussian(value, n):
            raise DataError(f"parameter {name!r} has shape {list(value.shape)} for {n} Gaussians: resize it")
        if name in optimizers and [id(held) for held in parameters_of(optimizers[name])] != [id(value)]:
            raise DataError(f"the optimizer of {name!r} holds another tensor: build it from params[{name!r}]")


def parameters_of(optimizer: Optimizer) -> list[Parameter]:
    """The parameters that an optimizer trains."""
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]


def per_gaussian(value: Any, n: int) -> bool:
    """Whether a value is a tensor with a row for each of ``n`` Gaussians."""
    return isinstance(value, Tensor) and value.ndim > 0 and value.shape[0] == n


def replace_parameter(
    params: Params, optimizers: Optimizers, name: str, value: Tensor, state: Mapping[str, Any]
) -> None:
    """Replace a parameter, and in its optimizer if it has one, with a new ``state`` there; ``requires_grad`` stays."""
    new = Parameter(value, requires_grad=params[name].requires_grad)
    if (optimizer := optimizers.get(name)) is not None:
        optimizer.state.pop(params[name], None)
        if state:
            optimizer.state[new] = dict(state)
        optimizer.param_groups[0]["params"] = [new]
    params[name] = new


def moments_of(optimizers: Optimizers, name: str, value: Tensor) -> dict[str, Tensor]:
    """Optimizer state of a parameter that has its shape: the moments of Adam, without the step count."""
    state = optimizers[name].state.get(value, {}) if name in optimizers else {}
    return {key: held for key, held in state.items() if isinstance(held, Tensor) and held.shape == value.shape}


def change_parameter(params: Params, optimizers: Optimizers, name: str, change: Callable[[Tensor], Tensor]) -> None:
    """Replace a parameter ``[N, ...]`` and its moments by a function of them; other optimizer state stays."""
    old = params[name]
    state = optimizers[name].state.get(old, {}) if name in optimizers else {}
    moments = {key: change(held) for key, held in moments_of(optimizers, name, old).items()}
    replace_parameter(params, optimizers, name, change(old.detach()), {**state, **moments})


@torch.no_grad()
def keep(params: Params, optimizers: Optimizers, states: Iterable[MutableMapping[str, Any]], mask: Tensor) -> None:
    """Keep the Gaussians under a mask, bool ``[N]`` on any device, and remove all others, in place on the mappings.

    Replaces every parameter, also in the optimizer of its name, with Adam's moments sliced and the step count kept, and
    slices the tensors of running ``states`` that have first dimension N. New objects are needed: after resizing through
    ``.data``, the backward pass of a live graph fails on the old shape. The caller must refresh other holders of the
    old objects. ``DataError`` for a wrong mask or other optimizers; all arguments are unchanged then.
    """
    n = num_gaussians(params)
    if mask.dtype != torch.bool or mask.shape != (n,):
        raise DataError(f"mask is {mask.dtype} {list(mask.shape)} for {n} Gaussians: pass torch.bool [{n}]")
    if not mask.any():
        raise DataError(f"the mask removes all {n} Gaussians: keep at least one")
    check_wiring(params, optimizers)

    def kept(value: Tensor) -> Tensor:
        return value[mask.to(value.device)]

    for name in list(params):
        change_parameter(params, optimizers, name, kept)
    for state in states:
        state.update({key: kept(value) for key, value in state.items() if per_gaussian(value, n)})


@torch.no_grad()
def rewrite(params: Mapping[str, Tensor], optimizers: Optimizers, values: Mapping[str, Tensor]) -> None:
    """Overwrite parameters in place with values of the same shapes; ``DataError`` for other names and shapes.

    Where a value changes, Adam's first moment becomes 0, because it averages gradients at the old value. The second
    moment stays: if it were 0, the next step would be ``0.1 g / sqrt(0.001 g^2)``, three times the learning rate.
    """
    check_wiring(params, optimizers)
    for name, value in values.items():
        if name not in params or params[name].shape != value.shape:
            shape = list(params[name].shape) if name in params else "no such parameter"
            raise DataError(f"cannot write {list(value.shape)} to {name!r} ({shape}): pass one row per Gaussian")
    for name, value in values.items():
        parameter = params[name]
        value = value.to(parameter)
        if name in optimizers and "exp_avg" in optimizers[name].state.get(parameter, {}):
            optimizers[name].state[parameter]["exp_avg"].masked_fill_(parameter != value, 0)
        parameter.copy_(value)


def snapshot(params: Mapping[str, Tensor], optimizers: Optimizers) -> Snapshot:
    """Copy parameters and the tensors of their optimizers, by name; a parameter may have no optimizer."""
    saved = {}
    for name, value in params.items():
        entries = {"value": value, **(optimizers[name].state.get(value, {}) if name in optimizers else {})}
        saved[name] = {key: entry.detach().cpu().clone() for key, entry in entries.items() if isinstance(entry, Tensor)}
    return saved


@torch.no_grad()
def restore(params: Params, optimizers: Optimizers, saved: Snapshot) -> None:
    """Restore a snapshot with any number of Gaussians; replaces parameters as :func:`keep` does."""
    for name, entries in saved.items():
        value = entries["value"].to(params[name].device, copy=True)
        state = _state(entries, value, optimizers[name]) if name in optimizers else {}
        replace_parameter(params, optimizers, name, value, state)


def module_snapshot(optimizer: Optimizer) -> Snapshot:
    """Copy the parameters of an optimizer, such as those of a network, and its state; keys are their positions."""
    named = {str(i): value for i, value in enumerate(parameters_of(optimizer))}
    return snapshot(named, dict.fromkeys(named, optimizer))


@torch.no_grad()
def restore_module(optimizer: Optimizer, saved: Snapshot) -> None:
    """Restore a :func:`module_snapshot` in place; keeps the parameter objects."""
    for i, value in enumerate(parameters_of(optimizer)):
        entries = saved[str(i)]
        value.copy_(entries["value"])
        optimizer.state.pop(value, None)
        if len(entries) > 1:
            optimizer.state[value] = _state(entries, value, optimizer)


def _state(entries: Mapping[str, Tensor], value: Tensor, optimizer: Optimizer) -> dict[str, Tensor]:
    """Optimizer state of a snapshot, on the device of ``value``."""
    # Adam keeps its step count on the CPU, unless it is fused.
    count_device = value.device if optimizer.param_groups[0].get("fused") else "cpu"
    devices = {key: count_device if key == "step" else value.device for key in entries if key != "value"}
    return {key: entries[key].to(device, copy=True) for key, device in devices.items()}


@torch.no_grad()
def grow(params: Params, optimizers: Optimizers, count: int, min_opacity: float) -> None:
    """Add ``count`` Gaussians: the most opaque ones become two at one position, which render alike.

    Opacities ``o' = 1 - sqrt(1 - o)``, at least ``min_opacity``, preserve the opacity at the centre. Scales
    ``s' = s o / (2 o' - o'^2 / sqrt(2))`` preserve the integral along a ray (3DGS-MCMC, Kheradmand et al., 2024,
    equation 9 for two copies). Moments of the copies are 0. Replaces the parameter objects, as :func:`keep` does.
    """
    while count > 0:
        opacities = params["opacities"].detach().sigmoid().flatten()
        rows = opacities.sort(descending=True, stable=True).indices[:count]
        old = opacities[rows].double().clamp_min(1e-300)
        new = -torch.expm1(torch.log1p(-old) / 2)  # 1 - sqrt(1 - o), without a difference that may round to 0
        params["scales"].data[rows] += (old / (2 * new - new.square() / 2**0.5)).log().to(params["scales"])[:, None]
        limited = new.to(opacities).clamp(min_opacity, 1 - torch.finfo(opacities.dtype).eps)
        params["opacities"].data[rows] = torch.logit(limited)[:, None]
        for name in list(params):
            change_parameter(params, optimizers, name, lambda value, rows=rows: torch.cat([value, value[rows]]))  # type: ignore[misc]
            for moment in moments_of(optimizers, name, params[name]).values():
                moment[-len(rows) :] = 0
        count -= len(rows)
