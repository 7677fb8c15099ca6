"""Remove primitives from a field in training: parameters, optimizer state and per-primitive state together."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

from sundae_ns.errors import DataError
from sundae_ns.gaussians.parameters import num_primitives


def check_wiring(params: Mapping[str, Tensor], optimizers: Mapping[str, Optimizer]) -> None:
    """Check that parameters share their first dimension and that the optimizers of their names hold these tensors.

    Parameters without an optimizer and optimizers of other names, such as a network's, are allowed.

    Raises:
        DataError: a parameter has another length, or an optimizer holds another tensor or more than one.
    """
    n = num_primitives(params)
    for name, value in params.items():
        if value.ndim == 0 or value.shape[0] != n:
            raise DataError(f"parameter {name!r} has shape {list(value.shape)} in a field of {n} primitives: resize it")
        if name not in optimizers:
            continue
        held = [p for group in optimizers[name].param_groups for p in group["params"]]
        if len(held) != 1 or held[0] is not value:
            raise DataError(
                f"the optimizer of {name!r} does not hold exactly the field's tensor: build it from params[{name!r}]"
            )


def per_primitive(value: Any, n: int) -> bool:
    """Return whether a value is a tensor with a row for each of ``n`` primitives."""
    return isinstance(value, Tensor) and value.ndim > 0 and value.shape[0] == n


def replace_parameter(
    params: MutableMapping[str, Parameter],
    optimizers: Mapping[str, Optimizer],
    name: str,
    new: Parameter,
    state: Mapping[str, Any] | None,
) -> None:
    """Replace one parameter, in the field and in its optimizer.

    Args:
        params: the field.
        optimizers: by parameter name, with one parameter each; may lack ``name``.
        name: name of the parameter.
        new: the new parameter.
        state: optimizer state of the new parameter; None or empty resets it.
    """
    optimizer = optimizers.get(name)
    if optimizer is not None:
        optimizer.state.pop(params[name], None)
        if state:
            optimizer.state[new] = dict(state)
        optimizer.param_groups[0]["params"] = [new]
    params[name] = new


@torch.no_grad()
def keep(
    params: MutableMapping[str, Parameter],
    optimizers: Mapping[str, Optimizer],
    state: MutableMapping[str, Any],
    mask: Tensor,
) -> None:
    """Keep the primitives under a mask and remove all others, in place on the mappings.

    Replaces every parameter by a new, shorter ``Parameter`` with the same ``requires_grad`` and without a gradient. The
    optimizer of the same name holds the new one, with its per-primitive state (Adam's moments) sliced and its step
    count kept. New objects are needed: after resizing through ``.data``, the backward pass of a live graph fails on the
    old shape. The caller must refresh other holders of the old objects, such as nerfstudio's ``Optimizers.parameters``.

    Checks and slices everything before it replaces anything, so an error leaves all arguments unchanged.

    Args:
        params: the field, name to parameter ``[N, ...]``.
        optimizers: optimizers with one parameter each; names that are not in ``params`` are ignored.
        state: running state; its tensors with first dimension N are sliced, all else stays.
        mask: True for primitives to keep, bool, any device ``[N]``.

    Raises:
        DataError: the mask has a wrong shape or dtype or keeps nothing, or the optimizers do not hold the parameters.
    """
    n = num_primitives(params)
    if mask.dtype != torch.bool or mask.shape != (n,):
        raise DataError(f"mask is {mask.dtype} {list(mask.shape)} for {n} primitives: pass torch.bool [{n}]")
    if not mask.any():
        raise DataError(f"the mask removes all {n} primitives: keep at least one")
    check_wiring(params, optimizers)

    new_params = {
        name: Parameter(_slice(value.detach(), mask), requires_grad=value.requires_grad)
        for name, value in params.items()
    }
    held = {name: optimizers[name].state.get(params[name], {}) for name in new_params if name in optimizers}
    new_held = {name: {**state, **_sliced_entries(state, mask, skip="step")} for name, state in held.items()}
    new_state = _sliced_entries(state, mask)

    for name, new in new_params.items():
        replace_parameter(params, optimizers, name, new, new_held.get(name))
    state.update(new_state)


@torch.no_grad()
def keep_state(state: MutableMapping[str, Any], mask: Tensor) -> None:
    """Slice the tensors with N rows of a state mapping in place, by a mask bool ``[N]``."""
    state.update(_sliced_entries(state, mask))


def _slice(value: Tensor, mask: Tensor) -> Tensor:
    return value[mask.to(value.device)]


def _sliced_entries(entries: Mapping[str, Any], mask: Tensor, skip: str | None = None) -> dict[str, Tensor]:
    """Sliced copies of the per-primitive tensors of a mapping."""
    n = mask.shape[0]
    return {name: _slice(value, mask) for name, value in entries.items() if name != skip and per_primitive(value, n)}
