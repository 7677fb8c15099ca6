"""Give the primitives of a field in training other values."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.optim import Optimizer

from sundae_ns.errors import DataError
from sundae_ns.gaussians.surgery import check_wiring


@torch.no_grad()
def rewrite(params: Mapping[str, Tensor], optimizers: Mapping[str, Optimizer], values: Mapping[str, Tensor]) -> None:
    """Give parameters other values, in place.

    Where a value changes, the optimizer's first moment becomes 0: it is a mean of gradients at a place that the parameter
    has left. The second moment stays. It says how large gradients are, by which Adam divides, and without it the first
    step would be more than three times the learning rate in every direction (``0.1 g / sqrt(0.001 g^2)``), whatever
    the gradient; Adam forgets it within a thousand steps. What does not change keeps both.

    Args:
        params: the field; tensors are changed in place, and stay the ones that the optimizers hold.
        optimizers: optimizers by parameter name.
        values: new values by parameter name, each with its parameter's shape.

    Raises:
        DataError: a name is unknown or a shape does not fit, or parameters and optimizers do not.
    """
    check_wiring(params, optimizers)
    for name, value in values.items():
        if name not in params or params[name].shape != value.shape:
            shape = list(params[name].shape) if name in params else "no such parameter"
            raise DataError(f"{name!r} is to become {list(value.shape)} but there is {shape}: pass one row a primitive")
    for name, value in values.items():
        held = params[name]
        value = value.to(held)
        if name in optimizers and "exp_avg" in optimizers[name].state.get(held, {}):
            optimizers[name].state[held]["exp_avg"].masked_fill_(held != value, 0)
        held.copy_(value)
