"""Spherical harmonics without gradients, on torch's current stream.

gsplat 1.4 launches its own kernel on CUDA's default stream. A CUDA graph records another stream, so the recorded frame
would lack the colours. The formulas are those of :mod:`sundae_ns.rasterization.harmonics`.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from sundae_ns.gpu.nvrtc import Kernel

SOURCE = r"""
// One thread computes one channel of one primitive.
extern "C" __global__ void harmonics(int n, int degree, const float* __restrict__ directions,
                                     const float* __restrict__ coeffs, int num_coeffs, float* __restrict__ out) {
    const long long thread = blockIdx.x * (long long)blockDim.x + threadIdx.x;
    if (thread >= 3LL * n) return;
    const long long i = thread / 3;
    const float* c = coeffs + i * num_coeffs * 3 + thread % 3;
    float x = directions[3 * i], y = directions[3 * i + 1], z = directions[3 * i + 2];
    const float scale = rsqrtf(x * x + y * y + z * z);
    x *= scale;
    y *= scale;
    z *= scale;
    const float xx = x * x, yy = y * y, zz = z * z;
    float sum = 0.28209479177387814f * c[0];
    if (degree > 0) sum += 0.48860251190291992f * (z * c[6] - y * c[3] - x * c[9]);
    if (degree > 1)
        sum += 1.0925484305920792f * (x * y * c[12] - y * z * c[15] - x * z * c[21] + 0.5f * (xx - yy) * c[24]) +
               0.31539156525252005f * (3 * zz - 1) * c[18];
    if (degree > 2)
        sum += 0.59004358992664352f * (y * (yy - 3 * xx) * c[27] + x * (3 * yy - xx) * c[45]) +
               1.4453057213202769f * z * (2 * x * y * c[30] + (xx - yy) * c[42]) -
               0.45704579946446574f * (5 * zz - 1) * (y * c[33] + x * c[39]) +
               0.37317633259011546f * z * (5 * zz - 3) * c[36];
    if (degree > 3)
        sum += 0.62583573544917614f * (4 * x * y * (xx - yy) * c[48] + (xx * xx - 6 * xx * yy + yy * yy) * c[72]) -
               1.7701307697799304f * z * (y * (3 * xx - yy) * c[51] + x * (xx - 3 * yy) * c[69]) +
               0.94617469575756008f * (7 * zz - 1) * (x * y * c[54] + 0.5f * (xx - yy) * c[66]) -
               0.66904654355728921f * z * (7 * zz - 3) * (y * c[57] + x * c[63]) +
               0.10578554691520431f * (zz * (35 * zz - 30) + 3) * c[60];
    out[thread] = sum;
}
"""


def harmonics(degree: int, directions: Tensor, coeffs: Tensor) -> Tensor:
    """Weighted sum ``[N, 3]`` of harmonics, without gradients.

    Args:
        degree: 0 to 4.
        directions: of any length except zero; float32 on a CUDA device ``[N, 3]``.
        coeffs: float32 on the same device ``[N, K, 3]``.

    Raises:
        BackendError: the kernel cannot be compiled or loaded.
    """
    out = torch.empty_like(directions, memory_format=torch.contiguous_format)
    kernel = _compiled(directions.device)
    kernel(out.numel(), [len(out), degree, directions.contiguous(), coeffs.contiguous(), coeffs.shape[1], out])
    return out


@functools.cache
def _compiled(device: torch.device) -> Kernel:
    return Kernel(SOURCE, "harmonics", device)
