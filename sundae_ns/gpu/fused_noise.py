"""Noise on the centres of a Markov chain, in one kernel: PyTorch takes forty for each step of a warm-up."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from sundae_ns.gpu.nvrtc import Launch, load_kernels

THREADS = 256


def noise_kernels(device: torch.device) -> dict[str, Launch]:
    """The kernel for a CUDA device, compiled on the first call.

    Raises:
        BackendError: it cannot be compiled or loaded.
    """
    return load_kernels("noise.cu", ("add_noise",), (), device, THREADS)


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
