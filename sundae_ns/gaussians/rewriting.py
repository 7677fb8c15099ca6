"""Overwrite parameter values of a field during training."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.optim import Optimizer

from sundae_ns.errors import DataError
from sundae_ns.gaussians.surgery import check_wiring


@torch.no_grad()
def rewrite(params: Mapping[str, Tensor], optimizers: Mapping[str, Optimizer], values: Mapping[str, Tensor]) -> None:
    """Overwrite parameters in place.

    Where a value changes, the first moment of Adam becomes 0, because it averages gradients at the old value. The
    second moment stays: with a zero second moment, the next step would be over three times the learning rate in every
    direction, for any gradient (``0.1 g / sqrt(0.001 g^2)``). Adam forgets the old second moment within a thousand
    steps. Unchanged values keep both moments.

    Args:
        params: the field, changed in place; the optimizers keep the same tensors.
        optimizers: optimizers by parameter name.
        values: new values by parameter name, each with the shape of its parameter.

    Raises:
        DataError: a name is unknown, a shape differs, or the optimizers do not hold the parameters.
    """
    check_wiring(params, optimizers)
    for name, value in values.items():
        if name not in params or params[name].shape != value.shape:
            shape = list(params[name].shape) if name in params else "no such parameter"
            raise DataError(f"cannot write {list(value.shape)} to {name!r} ({shape}): pass one row per primitive")
    for name, value in values.items():
        parameter = params[name]
        value = value.to(parameter)
        if name in optimizers and "exp_avg" in optimizers[name].state.get(parameter, {}):
            optimizers[name].state[parameter]["exp_avg"].masked_fill_(parameter != value, 0)
        parameter.copy_(value)
