"""Adam for one parameter in one kernel, with the learning rate in memory, so that a CUDA graph can record it.

torch's fused Adam gives each block of threads 65,536 numbers. A pruned field has a few such pieces for a parameter, and most
of the GPU waits; here a block has 1,024.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from sundae_ns.gpu.nvrtc import Kernel, Launch

THREADS = 256
PER_THREAD = 4

SOURCE = r"""
// A thread updates PER_THREAD numbers. `step` is the number of this update, from 1 on. Nothing changes where `skip` is not 0.
extern "C" __global__ void adam(int n, float* __restrict__ value, const float* __restrict__ gradient,
                                float* __restrict__ mean, float* __restrict__ square, const float* __restrict__ step,
                                const float* __restrict__ rate, const float* __restrict__ skip, double beta1,
                                double beta2, double eps) {
    __shared__ float size, root;
    if (skip && skip[0] != 0) return;
    if (threadIdx.x == 0) {
        size = (float)(rate[0] / (1 - pow(beta1, (double)step[0])));
        root = (float)sqrt(1 - pow(beta2, (double)step[0]));
    }
    __syncthreads();
    const float keep1 = (float)beta1, keep2 = (float)beta2, add1 = (float)(1 - beta1), add2 = (float)(1 - beta2);
    const long long first = blockIdx.x * (long long)blockDim.x * PER_THREAD + threadIdx.x;
#pragma unroll
    for (int k = 0; k < PER_THREAD; ++k) {
        const long long i = first + k * (long long)blockDim.x;
        if (i >= n) return;
        const float g = gradient[i], m = keep1 * mean[i] + add1 * g, s = keep2 * square[i] + add2 * g * g;
        mean[i] = m;
        square[i] = s;
        value[i] -= size * m / (sqrtf(s) / root + (float)eps);
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
    launch(
        -(-value.numel() // PER_THREAD), [value.numel(), value, gradient, mean, square, step, rate, skip, *betas, eps]
    )


@functools.cache
def _compiled(device: torch.device) -> Kernel:
    return Kernel(SOURCE, "adam", device, definitions(), THREADS)
