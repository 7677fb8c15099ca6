"""The CPU backend: the stages of the reference, in compiled loops."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from sundae_ns.errors import BackendError
from sundae_ns.rasterization.cpu.compositing import composite
from sundae_ns.rasterization.cpu.projection import project
from sundae_ns.rasterization.cpu.tiles import build_lists
from sundae_ns.rasterization.reference import ReferenceBackend
from sundae_ns.rasterization.types import Rasterization


class CpuBackend(ReferenceBackend):
    """The reference in compiled loops, for float32 and float64 on a CPU; independent of the number of threads."""

    name = "cpu"
    _project = staticmethod(project)
    _build_lists = staticmethod(build_lists)
    _composite = staticmethod(composite)

    def rasterize(self, means: Tensor, *args: Any, **options: Any) -> Rasterization:
        """Render one view; see :func:`sundae_ns.rasterization.rasterize`.

        Raises:
            BackendError: The tensors are not float32 or float64 on a CPU.
        """
        if means.dtype not in (torch.float32, torch.float64) or means.device.type != "cpu":
            raise BackendError(
                f"the cpu rasterizer takes float32 or float64 on a CPU, not {means.dtype} on {means.device}; "
                "convert, or use 'reference'"
            )
        return super().rasterize(means, *args, **options)
