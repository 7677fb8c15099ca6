"""Spherical harmonics and their gradients, on torch's current stream.

gsplat 1.4 launches its own kernels on CUDA's default stream. A CUDA graph records another stream, so recorded work would
lack the colours. The formulas are those of :mod:`sundae_ns.rasterization.harmonics`.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from sundae_ns.errors import SundaeError
from sundae_ns.gpu.nvrtc import Kernel, Launch

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

// One coefficient of a primitive: its gradient, and its part of the gradient of the unit direction.
#define TERM(K, VALUE, DX, DY, DZ)                                              \
    {                                                                           \
        const float value = VALUE;                                              \
        g[3 * K] = value * red;                                                 \
        g[3 * K + 1] = value * green;                                           \
        g[3 * K + 2] = value * blue;                                            \
        const float weight = c[3 * K] * red + c[3 * K + 1] * green + c[3 * K + 2] * blue; \
        dx += weight * (DX);                                                    \
        dy += weight * (DY);                                                    \
        dz += weight * (DZ);                                                    \
    }

// One thread computes one primitive: gradients of its coefficients and of its direction, which is not normalised.
extern "C" __global__ void harmonics_backward(int n, int degree, const float* __restrict__ directions,
                                              const float* __restrict__ coeffs, int num_coeffs,
                                              const float* __restrict__ gradient, float* __restrict__ grad_directions,
                                              float* __restrict__ grad_coeffs) {
    const long long i = blockIdx.x * (long long)blockDim.x + threadIdx.x;
    if (i >= n) return;
    const float* c = coeffs + i * num_coeffs * 3;
    float* g = grad_coeffs + i * num_coeffs * 3;
    const float red = gradient[3 * i], green = gradient[3 * i + 1], blue = gradient[3 * i + 2];
    float x = directions[3 * i], y = directions[3 * i + 1], z = directions[3 * i + 2];
    const float scale = rsqrtf(x * x + y * y + z * z);
    x *= scale;
    y *= scale;
    z *= scale;
    const float xx = x * x, yy = y * y, zz = z * z, xy = x * y, cos2 = xx - yy;
    const float sin3 = y * (3 * xx - yy), cos3 = x * (xx - 3 * yy);
    float dx = 0, dy = 0, dz = 0;
    TERM(0, 0.28209479177387814f, 0, 0, 0)
    if (degree > 0) {
        const float c1 = 0.48860251190291992f;
        TERM(1, -c1 * y, 0, -c1, 0)
        TERM(2, c1 * z, 0, 0, c1)
        TERM(3, -c1 * x, -c1, 0, 0)
    }
    if (degree > 1) {
        const float c1 = 1.0925484305920792f, c0 = 0.31539156525252005f;
        TERM(4, c1 * xy, c1 * y, c1 * x, 0)
        TERM(5, -c1 * y * z, 0, -c1 * z, -c1 * y)
        TERM(6, c0 * (3 * zz - 1), 0, 0, 6 * c0 * z)
        TERM(7, -c1 * x * z, -c1 * z, 0, -c1 * x)
        TERM(8, 0.5f * c1 * cos2, c1 * x, -c1 * y, 0)
    }
    if (degree > 2) {
        const float c3 = 0.59004358992664352f, c2 = 1.4453057213202769f, c1 = 0.45704579946446574f;
        const float c0 = 0.37317633259011546f, inner = 5 * zz - 1;
        TERM(9, -c3 * sin3, -6 * c3 * xy, -3 * c3 * cos2, 0)
        TERM(10, 2 * c2 * xy * z, 2 * c2 * y * z, 2 * c2 * x * z, 2 * c2 * xy)
        TERM(11, -c1 * y * inner, 0, -c1 * inner, -10 * c1 * y * z)
        TERM(12, c0 * z * (5 * zz - 3), 0, 0, c0 * (15 * zz - 3))
        TERM(13, -c1 * x * inner, -c1 * inner, 0, -10 * c1 * x * z)
        TERM(14, c2 * z * cos2, 2 * c2 * x * z, -2 * c2 * y * z, c2 * cos2)
        TERM(15, -c3 * cos3, -3 * c3 * cos2, 6 * c3 * xy, 0)
    }
    if (degree > 3) {
        const float c4 = 0.62583573544917614f, c3 = 1.7701307697799304f, c2 = 0.47308734787878004f;
        const float c1 = 0.66904654355728921f, c0 = 0.10578554691520431f;
        const float inner1 = z * (7 * zz - 3), inner2 = 7 * zz - 1, slope1 = 21 * zz - 3;
        TERM(16, 4 * c4 * xy * cos2, 4 * c4 * sin3, 4 * c4 * cos3, 0)
        TERM(17, -c3 * z * sin3, -6 * c3 * xy * z, -3 * c3 * z * cos2, -c3 * sin3)
        TERM(18, 2 * c2 * xy * inner2, 2 * c2 * y * inner2, 2 * c2 * x * inner2, 28 * c2 * xy * z)
        TERM(19, -c1 * y * inner1, 0, -c1 * inner1, -c1 * y * slope1)
        TERM(20, c0 * (zz * (35 * zz - 30) + 3), 0, 0, c0 * z * (140 * zz - 60))
        TERM(21, -c1 * x * inner1, -c1 * inner1, 0, -c1 * x * slope1)
        TERM(22, c2 * cos2 * inner2, 2 * c2 * x * inner2, -2 * c2 * y * inner2, 14 * c2 * z * cos2)
        TERM(23, -c3 * z * cos3, -3 * c3 * z * cos2, 6 * c3 * xy * z, -c3 * cos3)
        TERM(24, c4 * (x * cos3 - y * sin3), 4 * c4 * cos3, -4 * c4 * sin3, 0)
    }
    for (int k = 3 * (degree + 1) * (degree + 1); k < 3 * num_coeffs; ++k) g[k] = 0;
    const float along = dx * x + dy * y + dz * z;  // length has no effect
    grad_directions[3 * i] = scale * (dx - along * x);
    grad_directions[3 * i + 1] = scale * (dy - along * y);
    grad_directions[3 * i + 2] = scale * (dz - along * z);
}
"""


class Launches(NamedTuple):
    """Both kernels on one device."""

    harmonics: Launch
    harmonics_backward: Launch


def harmonics(degree: int, directions: Tensor, coeffs: Tensor, launches: Launches | None = None) -> Tensor:
    """Weighted sum ``[N, 3]`` of harmonics, differentiable once.

    Args:
        degree: 0 to 4.
        directions: of any length except zero; float32 on a CUDA device ``[N, 3]``.
        coeffs: float32 on the same device ``[N, K, 3]``.
        launches: kernels to use instead of those compiled for the device.

    Raises:
        BackendError: the kernels cannot be compiled or loaded.
    """
    launches = _compiled(directions.device) if launches is None else launches
    return cast("Tensor", _Harmonics.apply(degree, directions, coeffs, launches))


class _Harmonics(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, degree: int, directions: Tensor, coeffs: Tensor, launches: Launches
    ) -> Tensor:
        directions, coeffs = directions.contiguous(), coeffs.contiguous()
        out = torch.empty_like(directions)
        launches.harmonics(out.numel(), [len(out), degree, directions, coeffs, coeffs.shape[1], out])
        ctx.save_for_backward(directions, coeffs)
        ctx.degree, ctx.launches = degree, launches
        return out

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        if torch.is_grad_enabled():  # create_graph=True: the kernel would be missing from that graph
            raise SundaeError("these harmonics have no second derivative; use the reference rasteriser")
        directions, coeffs = ctx.saved_tensors
        grad_directions, grad_coeffs = torch.empty_like(directions), torch.empty_like(coeffs)
        arguments = [len(coeffs), ctx.degree, directions, coeffs, coeffs.shape[1], gradient.contiguous()]
        ctx.launches.harmonics_backward(len(coeffs), [*arguments, grad_directions, grad_coeffs])
        return None, grad_directions, grad_coeffs, None


@functools.cache
def _compiled(device: torch.device) -> Launches:
    return Launches(*(Kernel(SOURCE, name, device) for name in Launches._fields))
