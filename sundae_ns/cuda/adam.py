"""Adam with the learning rates in memory, so that a CUDA graph can record it; one kernel for a parameter.

torch's fused Adam gives each block of threads 65,536 numbers of a tensor. A pruned scene has a few such pieces for a
parameter, and a head ten, so most of the GPU waits. Here a block has 1,024, and torch gets the weights in small pieces.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from sundae_ns.cuda.kernels import load_kernels

_THREADS, _PER_THREAD = 256, 4
_PIECE = 8192  # numbers

OPTIONS = (f"-DPER_THREAD={_PER_THREAD}",)  # Compiler options of ``adam.cu``


class Update(NamedTuple):
    """Tensors of one parameter that a step of Adam updates or reads. The first four have one shape and layout."""

    value: Tensor  # the parameter, float32
    gradient: Tensor
    mean: Tensor  # running mean of gradients (``exp_avg``)
    square: Tensor  # running mean of their squares (``exp_avg_sq``)
    step: Tensor  # number of updates so far []


@torch.no_grad()
def adam_step(groups: Sequence[tuple[Mapping[str, Any], Sequence[Update]]], rates: Tensor, skip: Tensor | None) -> None:
    """A step of ``torch.optim.Adam`` with ``fused``, but for rates in memory ``[G]`` and any number of optimizers.

    ``groups`` are options of each group as the optimizer holds them, and its updates; ``skip`` as for :func:`adam`.
    """
    steps = [update.step for _, updates in groups for update in updates]
    torch._foreach_add_(steps, 1)
    for rate, (options, updates) in zip(rates, groups, strict=True):
        beta1, beta2 = options["betas"]
        if len(updates) == 1 and updates[0].value.is_cuda and options["weight_decay"] == 0:
            adam(updates[0], rate, skip, betas=(beta1, beta2), eps=options["eps"])
        elif updates:
            pieces = [
                (*piece, update.step)
                for update in updates
                for piece in zip(*(each.as_strided((each.numel(),), (1,)).split(_PIECE) for each in update[:4]))
            ]
            values, gradients, means, squares, counts = map(list, zip(*pieces, strict=True))
            update = torch._fused_adamw_ if options.get("decoupled_weight_decay") else torch._fused_adam_
            update(
                *(values, gradients, means, squares, [], counts),
                lr=rate,
                beta1=beta1,
                beta2=beta2,
                weight_decay=options["weight_decay"],
                eps=options["eps"],
                amsgrad=False,
                maximize=False,
                found_inf=skip,
            )
    if skip is not None:
        torch._foreach_sub_(steps, [skip] * len(steps))


@torch.no_grad()
def adam(update: Update, rate: Tensor, skip: Tensor | None, *, betas: tuple[float, float], eps: float) -> None:
    """Update a parameter in place (Kingma & Ba 2015), as ``torch.optim.Adam`` does without weight decay.

    ``update`` is on a CUDA device, contiguous, of fewer than 2^31 numbers; its ``step`` counts from 1. ``rate`` ``[]``
    is the learning rate; ``skip`` ``[]`` is not 0 to change nothing. ``BackendError`` if the kernel cannot be loaded.
    """
    launch = load_kernels("adam.cu", ("adam",), OPTIONS, update.value.device, _THREADS)["adam"]
    logs = [math.log(beta) if beta > 0 else -math.inf for beta in betas]
    count = update.value.numel()
    launch(-(-count // _PER_THREAD), [count, *update, rate, skip, *betas, *logs, eps])
