"""Noise on the centres of a Markov chain, in one kernel: PyTorch takes forty for each step of a warm-up."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from sundae_ns.gpu.nvrtc import Launch, load_kernels

THREADS = 256

SOURCE = r"""
// A thread moves the centre of one primitive by R S^2 R^T e, where e is its noise times its gate.
extern "C" __global__ void add_noise(int n, float* __restrict__ means, const float* __restrict__ scales,
                                     const float* __restrict__ quats, const float* __restrict__ opacities,
                                     const float* __restrict__ noise, double strength, double sharpness,
                                     double threshold) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= n) return;
    const float opacity = 1 / (1 + expf(-opacities[i]));
    const float factor = (float)strength / (1 + expf(-(float)sharpness * ((float)threshold - opacity)));
    const float* q = quats + 4 * (long long)i;
    const float length = fmaxf(sqrtf(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]), 1e-12f);
    const float w = q[0] / length, x = q[1] / length, y = q[2] / length, z = q[3] / length;
    const float rotation[3][3] = {
        {1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
        {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
        {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}};
    const float* e = noise + 3 * (long long)i;
    float moved[3] = {0, 0, 0};
    for (int axis = 0; axis < 3; ++axis) {
        const float width = expf(scales[3 * (long long)i + axis]);
        const float along = rotation[0][axis] * e[0] + rotation[1][axis] * e[1] + rotation[2][axis] * e[2];
        for (int row = 0; row < 3; ++row) moved[row] += rotation[row][axis] * width * width * along;
    }
    for (int row = 0; row < 3; ++row) means[3 * (long long)i + row] += factor * moved[row];
}
"""


def noise_kernels(device: torch.device) -> dict[str, Launch]:
    """The kernel for a CUDA device, compiled on the first call.

    Raises:
        BackendError: it cannot be compiled or loaded.
    """
    return load_kernels(SOURCE, ("add_noise",), (), device, THREADS)


@torch.no_grad()
def add_noise(
    launches: Mapping[str, Launch],
    means: Tensor,
    scales: Tensor,
    quats: Tensor,
    opacities: Tensor,
    noise: Tensor,
    strength: float,
    gate: tuple[float, float],
) -> None:
    """Move centres by noise with the shape of their primitives, the less the more opaque these are, in place.

    Args:
        launches: from :func:`noise_kernels`.
        means: centres, float32 on a CUDA device, contiguous like all others ``[N, 3]``.
        scales: log-scales ``[N, 3]``.
        quats: wxyz quaternions of any length ``[N, 4]``.
        opacities: logits ``[N, 1]``.
        noise: standard normal ``[N, 3]``.
        strength: factor of the noise.
        gate: sharpness and threshold: noise is times ``sigmoid(sharpness * (threshold - opacity))``.
    """
    count = len(means)
    launches["add_noise"](count, [count, means, scales, quats, opacities, noise, strength, *gate])
