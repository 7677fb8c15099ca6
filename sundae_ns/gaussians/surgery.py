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
    """Check that parameters share their first dimension and that optimizers of the same name hold these very tensors.

    Parameters without an optimizer are fine, and so are optimizers of other things, a network for one.

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
    """Whether a value is a tensor with a row for each of ``n`` primitives."""
    return isinstance(value, Tensor) and value.ndim > 0 and value.shape[0] == n


def replace_parameter(
    params: MutableMapping[str, Parameter],
    optimizers: Mapping[str, Optimizer],
    name: str,
    new: Parameter,
    state: Mapping[str, Any] | None,
) -> None:
    """Put another parameter in the place of one, in the field and in its optimizer.

    Args:
        params: the field.
        optimizers: by parameter name, of one parameter each; there may be none of this name.
        name: whose place.
        new: the parameter.
        state: what its optimizer is to hold for it; None or empty lets the optimizer begin anew.
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

    Every parameter is replaced by a new, shorter ``Parameter`` with the same ``requires_grad``; optimizers of the same
    name hold the new one, with their per-primitive state (Adam's moments) sliced and the step count kept. Gradients are
    not carried over. The parameter objects change on purpose: resizing through ``.data`` would keep them, but a graph
    that is still alive remembers the old shape and the next backward pass fails. Other holders of the old objects, such
    as ``nerfstudio``'s ``Optimizers.parameters``, must be refreshed by the caller.

    Everything is checked and sliced before anything is replaced, so an error leaves all as it was.

    Args:
        params: the field, name to parameter ``[N, ...]``.
        optimizers: optimizers with one parameter each; names that are not in ``params`` are left alone.
        state: running state; its tensors with first dimension N are sliced, the rest is left alone.
        mask: True for primitives to keep, bool, any device ``[N]``.

    Raises:
        DataError: the mask has a wrong shape or dtype or keeps nothing, or parameters and optimizers do not fit.
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
    """Slice the per-primitive tensors of a state mapping in place: those with as many rows as ``mask`` ``[N]``."""
    state.update(_sliced_entries(state, mask))


def _slice(value: Tensor, mask: Tensor) -> Tensor:
    return value[mask.to(value.device)]


def _sliced_entries(entries: Mapping[str, Any], mask: Tensor, skip: str | None = None) -> dict[str, Tensor]:
    """The per-primitive tensors of a mapping, sliced; the mapping itself is not changed."""
    n = mask.shape[0]
    return {name: _slice(value, mask) for name, value in entries.items() if name != skip and per_primitive(value, n)}
