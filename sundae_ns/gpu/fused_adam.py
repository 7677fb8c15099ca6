"""Adam for one parameter in one kernel, with the learning rate in memory, so that a CUDA graph can record it.

torch's fused Adam gives each block of threads 65,536 numbers. A pruned field has a few such pieces for a parameter, and most
of the GPU waits; here a block has 1,024.
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

from sundae_ns.gpu.nvrtc import Kernel, Launch

THREADS = 256
PER_THREAD = 4

SOURCE = r"""
// A thread updates PER_THREAD numbers. `step` is the number of this update, from 1 on. Nothing changes where `skip` is not 0.
// All reads are sent before the first is used, so that they wait for the memory together.
extern "C" __global__ void adam(int n, float* __restrict__ value, const float* __restrict__ gradient,
                                float* __restrict__ mean, float* __restrict__ square, const float* __restrict__ step,
                                const float* __restrict__ rate, const float* __restrict__ skip, double beta1,
                                double beta2, double log_beta1, double log_beta2, double eps) {
    const long long first = blockIdx.x * (long long)blockDim.x * PER_THREAD + threadIdx.x;
    float v[PER_THREAD], g[PER_THREAD], m[PER_THREAD], s[PER_THREAD];
#pragma unroll
    for (int k = 0; k < PER_THREAD; ++k) {
        const long long i = first + k * (long long)blockDim.x;
        const bool inside = i < n;
        v[k] = inside ? value[i] : 0;
        g[k] = inside ? gradient[i] : 0;
        m[k] = inside ? mean[i] : 0;
        s[k] = inside ? square[i] : 0;
    }
    if (skip && skip[0] != 0) return;
    // 1 - beta^step, without the cancellation of a difference.
    const float size = rate[0] / -expm1f(step[0] * (float)log_beta1);
    const float root = sqrtf(-expm1f(step[0] * (float)log_beta2));
    const float keep1 = (float)beta1, keep2 = (float)beta2, add1 = (float)(1 - beta1), add2 = (float)(1 - beta2);
#pragma unroll
    for (int k = 0; k < PER_THREAD; ++k) {
        const long long i = first + k * (long long)blockDim.x;
        if (i >= n) return;
        m[k] = keep1 * m[k] + add1 * g[k];
        s[k] = keep2 * s[k] + add2 * g[k] * g[k];
        mean[i] = m[k];
        square[i] = s[k];
        value[i] = v[k] - size * m[k] / (sqrtf(s[k]) / root + (float)eps);
    }
}
"""


def definitions() -> tuple[str, ...]:
    """Compiler options of :data:`SOURCE`."""
    return (f"-DPER_THREAD={PER_THREAD}",)


@torch.no_grad()
def adam(
    value: Tensor,
    gradient: Tensor,
    mean: Tensor,
    square: Tensor,
    step: Tensor,
    rate: Tensor,
    skip: Tensor | None,
    *,
    betas: tuple[float, float],
    eps: float,
    launch: Launch | None = None,
) -> None:
    """Update a parameter in place (Kingma & Ba 2015), as ``torch.optim.Adam`` does without weight decay.

    Args:
        value: the parameter; float32 on a CUDA device, contiguous, fewer than 2^31 numbers.
        gradient: its gradient, with the shape and layout of ``value``.
        mean: running mean of gradients (``exp_avg``), likewise.
        square: running mean of their squares (``exp_avg_sq``), likewise.
        step: number of this update, from 1 on ``[]``.
        rate: learning rate ``[]``.
        skip: not 0 to change nothing ``[]``; None for 0.
        betas: decay rates of both means.
        eps: added to the root of the mean of squares.
        launch: kernel to use instead of the one compiled for the device.

    Raises:
        BackendError: the kernel cannot be compiled or loaded.
    """
    launch = _compiled(value.device) if launch is None else launch
    logs = [math.log(beta) if beta > 0 else -math.inf for beta in betas]
    tensors = [value, gradient, mean, square, step, rate, skip]
    launch(-(-value.numel() // PER_THREAD), [value.numel(), *tensors, *betas, *logs, eps])


@functools.cache
def _compiled(device: torch.device) -> Kernel:
    return Kernel(SOURCE, "adam", device, definitions(), THREADS)
