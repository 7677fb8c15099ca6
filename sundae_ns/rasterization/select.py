"""The choice of a backend. Only a CUDA device imports gsplat and builds its kernels; only a CPU imports numba."""

from __future__ import annotations

from functools import lru_cache
from typing import Literal

import torch

from sundae_ns.errors import BackendError, ConfigError
from sundae_ns.rasterization.gsplat_backend import GsplatBackend
from sundae_ns.rasterization.interface import rasterize
from sundae_ns.rasterization.reference import ReferenceBackend
from sundae_ns.rasterization.types import Backend

BackendName = Literal["auto", "gsplat", "cpu", "reference"]


def select_backend(name: BackendName, device: torch.device | str) -> Backend:
    """Choose the rasteriser for tensors on ``device``.

    ``auto`` chooses gsplat on a CUDA device where its kernels run, cpu on a CPU where numba works, and else the
    reference. Each check runs once per process; it builds gsplat's kernels if none are prebuilt.

    Raises:
        BackendError: ``gsplat`` or ``cpu`` was requested and cannot run on ``device``.
        ConfigError: The name is unknown.
    """
    device = torch.device(device)
    if name in ("auto", "gsplat"):
        problem = _gsplat_problem_on(device)
        if problem is None:
            return GsplatBackend()
        if name == "gsplat":
            raise BackendError(f"gsplat cannot rasterize: {problem}; or use the backend 'reference'")
    if name in ("auto", "cpu"):
        problem = _cpu_problem_on(device)
        if problem is None:
            return _cpu_backend()
        if name == "cpu":
            raise BackendError(f"the cpu backend cannot rasterize: {problem}; or use the backend 'reference'")
    if name in ("auto", "reference"):
        return ReferenceBackend()
    raise ConfigError(f"unknown rasterizer {name!r}; use auto, gsplat, cpu or reference")


def fastest_device() -> torch.device:
    """A CUDA device where gsplat's kernels run, else the CPU: where commands put a scene."""
    if torch.cuda.is_available() and _gsplat_problem_on(torch.device("cuda")) is None:
        return torch.device("cuda")
    return torch.device("cpu")


def _cpu_problem_on(device: torch.device) -> str | None:
    if device.type != "cpu":
        return f"the tensors are on the device '{device}'; move them to 'cpu'"
    return numba_problem()


@lru_cache(maxsize=1)
def numba_problem() -> str | None:
    """Render one pixel with the compiled loops; the cause and remedy if that fails, else None.

    This takes half a second, or some seconds if the loops were never compiled before.
    """
    try:
        ones = torch.ones(1, 4)
        camera = (torch.eye(4), torch.eye(3), 1, 1)
        rasterize(ones[:, :3], ones, ones[:, :3], ones[:, 0], ones[:, :1], *camera, backend=_cpu_backend())
    except ImportError as error:
        return f"numba does not import ({_first_line(error)}); pip install numba"
    except Exception as error:  # versions, processors and settings that numba refuses raise errors of many kinds
        mend = "pip install --force-reinstall numba, and unset NUMBA_DISABLE_JIT"
        return f"numba does not compile ({_first_line(error)}); {mend}"
    return None


def _cpu_backend() -> Backend:
    from sundae_ns.rasterization.cpu import CpuBackend

    return CpuBackend()


def _gsplat_problem_on(device: torch.device) -> str | None:
    if not torch.cuda.is_available():
        return "CUDA is not available; use a machine with an NVIDIA GPU and a CUDA build of torch"
    if device.type != "cuda":
        return f"the tensors are on the device '{device}'; move them to 'cuda'"
    return _kernel_problem()


@lru_cache(maxsize=1)
def _kernel_problem() -> str | None:
    """Run gsplat's smallest kernel; the cause and remedy if it fails, else None."""
    try:
        GsplatBackend().spherical_harmonics(
            0, torch.ones(1, 3, device="cuda"), torch.ones(1, 1, 3, device="cuda")
        ).sum().item()
    except ImportError as error:
        return f"gsplat does not import ({_first_line(error)}); install gsplat"
    except Exception as error:  # a failed build or a missing kernel image raises errors of many kinds
        return f"its kernels do not run ({_first_line(error)}); install a gsplat wheel for this torch, or nvcc"
    return None


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
