"""The CPU backend: the stages of the reference, in compiled loops."""

from __future__ import annotations

import torch
from torch import Tensor

from sundae_ns.errors import BackendError
from sundae_ns.rasterization.cpu.compositing import composite
from sundae_ns.rasterization.cpu.harmonics import evaluate_harmonics
from sundae_ns.rasterization.cpu.projection import project
from sundae_ns.rasterization.cpu.tiles import build_lists
from sundae_ns.rasterization.reference import ReferenceBackend
from sundae_ns.rasterization.types import Inputs, Rasterization


class CpuBackend(ReferenceBackend):
    """The reference in compiled loops, for float32 and float64 on a CPU; independent of the number of threads."""

    name = "cpu"
    _project = staticmethod(project)
    _build_lists = staticmethod(build_lists)
    _composite = staticmethod(composite)

    def rasterize(self, inputs: Inputs) -> Rasterization:
        """Render one view.

        Raises:
            BackendError: The tensors are not float32 or float64 on a CPU.
        """
        _check(inputs.means)
        return super().rasterize(inputs)

    def spherical_harmonics(self, degree: int, directions: Tensor, coeffs: Tensor) -> Tensor:
        """Sum of harmonics ``[N, 3]`` for directions ``[N, 3]`` (not zero) and coefficients ``[N, K, 3]``.

        Raises:
            BackendError: The tensors are not float32 or float64 on a CPU.
        """
        _check(directions)
        return evaluate_harmonics(degree, directions, coeffs)


def _check(tensor: Tensor) -> None:
    if tensor.dtype not in (torch.float32, torch.float64) or tensor.device.type != "cpu":
        raise BackendError(
            f"the cpu rasterizer takes float32 or float64 on a CPU, not {tensor.dtype} on {tensor.device}; "
            "convert, or use 'reference'"
        )
