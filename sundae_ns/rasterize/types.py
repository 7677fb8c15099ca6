"""Arguments and result of a rasterisation, the interface of a backend, and helpers of all backends."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from mmap import PAGESIZE
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from sundae_ns.core.camera import Camera
from sundae_ns.core.errors import MemoryExhaustedError


@dataclass(frozen=True)
class Inputs:
    """N Gaussians after activation and a pinhole camera. All tensors are float32 or float64, on one device."""

    means: Tensor  # Centres, world units ``[N, 3]``
    quats: Tensor  # Rotations as wxyz quaternions of any length; all-zero ones are the identity ``[N, 4]``
    scales: Tensor  # Standard deviations, world units ``[N, 3]``
    opacities: Tensor  # Opacities in [0, 1] ``[N]``
    colors: Tensor  # Vectors to blend, such as colours and features ``[N, C]`` with C >= 1
    camera: Camera
    near_plane: float = 0.01  # Gaussians with a smaller camera z are culled, world units
    far_plane: float = 1e10
    antialiased: bool = False  # Scale opacities by the ratio of screen areas without and with blur (Mip-Splatting)
    absgrad: bool = False
    """Let the backward pass set ``info["means2d"].absgrad``: absolute gradients of each pixel, summed (AbsGS)."""
    render_depth: bool = False  # Also blend camera z


@dataclass(frozen=True)
class Rasterization:
    """One rendered view; all tensors have the dtype and device of the Gaussians, except ``radii``."""

    colors: Tensor  # Blended colours ``[H, W, C]``, without background
    depth: Tensor | None
    """Expected camera z ``[H, W, 1]``, world units, 0 where nothing was blended; None unless requested."""
    alpha: Tensor  # Accumulated opacity ``[H, W, 1]`` in [0, 1]
    radii: Tensor  # Screen radius ``[N]`` in whole pixels, int32, 0 where the Gaussian was culled; not differentiable
    info: dict[str, Any]
    """Statistics that the ``DefaultStrategy`` of the installed gsplat reads, in the shapes it expects.

    ``means2d`` ``[1, N, 2]`` in pixels is part of the graph: ``retain_grad()`` works, and the backward pass sets
    ``.absgrad`` if requested. ``radii`` is ``[1, N]`` under gsplat 1.4 and ``[1, N, 2]`` from 1.5. ``width``,
    ``height`` and ``n_cameras`` are ints. ``gaussian_ids`` is None, because nothing is packed.
    """


class Backend(Protocol):
    """A rasteriser. Call it through :mod:`sundae_ns.rasterize.interface`, which checks the arguments."""

    @property
    def name(self) -> str:
        """``"gsplat"``, ``"cpu"`` or ``"reference"``."""

    def rasterize(self, inputs: Inputs) -> Rasterization:
        """Render one view."""

    def spherical_harmonics(self, degree: int, directions: Tensor, first: Tensor, rest: Tensor) -> Tensor:
        """Sum ``[N, 3]`` for directions ``[N, 3]`` (not zero) and coefficients ``[N, 3]``, ``[N, K - 1, 3]``."""


def result_of(image: Tensor, alpha: Tensor, means2d: Tensor, radii: Tensor, inputs: Inputs) -> Rasterization:
    """The result of a backend: channels ``[H, W, C]``, the last is camera z if depth was requested; alpha
    ``[H, W, 1]``; centres ``[1, N, 2]``; radii ``[N]``, or those of gsplat.
    """
    depth = None
    if inputs.render_depth:
        image, depth = image[..., :-1], image[..., -1:] / alpha.clamp(min=1e-10)  # less than any blended alpha
    if radii.dim() == 1:
        radii = (radii[:, None].expand(-1, 2) if is_gsplat_1_5() else radii)[None]
    size = {"width": inputs.camera.width, "height": inputs.camera.height}
    info = {"means2d": means2d, "radii": radii, **size, "n_cameras": 1, "gaussian_ids": None}
    return Rasterization(image, depth, alpha, radii[0] if radii.dim() == 2 else radii[0].amax(dim=-1), info)


@cache
def is_gsplat_1_5() -> bool:
    """Whether gsplat 1.5 or newer is installed: a radius for each axis, fitted to the opacity."""
    with suppress(PackageNotFoundError):
        return tuple(map(int, version("gsplat").split(".")[:2])) >= (1, 5)
    return False


@cache
def constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """A cached, read-only tensor of numbers; a new one would be copied to the GPU, and waited for, at each use."""
    with torch.inference_mode(False):  # autograd refuses tensors created in inference mode
        return torch.tensor(values, dtype=dtype, device=device)


# Bounds of a view on a CPU, checked before memory and time are taken: a small file can describe a view of terabytes.
MOST_PER_TILE = 8192
"""Most Gaussians in a tile, on average over the image; a scene of 504,143 has at most 400 in tiles of 8 x 8 pixels."""
ALWAYS = 1 << 22  # Pairs of a tile and a Gaussian beside these that any view may have
_NEGLIGIBLE = 1 << 28  # bytes that are taken without a look at the memory
_CONTROL_GROUP, _PROCESS = Path("/sys/fs/cgroup"), Path("/proc")


def check_pairs(pairs: int, gaussians: int, tiles: int) -> None:
    """Raise ``MemoryExhaustedError`` for more pairs of a tile and a visible Gaussian than any scene needs."""
    if pairs > MOST_PER_TILE * tiles + 4 * gaussians + ALWAYS:  # a small Gaussian lies in up to four tiles
        raise MemoryExhaustedError(
            f"the view has {pairs // tiles:,} Gaussians in each tile of its image, but a real scene has less than "
            f"{MOST_PER_TILE:,}; choose another camera"
        )


def check_memory(size: int, what: str) -> None:
    """Raise ``MemoryExhaustedError``, which names ``what``, for more bytes than are available."""
    available = None if size < _NEGLIGIBLE else available_memory()
    if available is not None and size > available:
        raise MemoryExhaustedError(
            f"{what} take {size / 1e9:,.1f} GB, but {available / 1e9:,.1f} GB are available; give a smaller image"
        )


def available_memory() -> int | None:
    """Bytes that this process can still take: of the machine, its control group, its own limit; None if unknown."""
    available = []
    with suppress(OSError, KeyError, ValueError):
        lines = (_PROCESS / "meminfo").read_text(encoding="utf-8").splitlines()
        available.append(1024 * int(dict(line.split(":", 1) for line in lines)["MemAvailable"].split()[0]))
    with suppress(OSError, KeyError, ValueError):  # no control group, one of another kind, or no limit
        most, used, parts = (
            (_CONTROL_GROUP / f"memory.{name}").read_text(encoding="utf-8") for name in ("max", "current", "stat")
        )
        # The cache of files is given back when memory is needed.
        sizes = dict(line.split() for line in parts.splitlines())
        cached = int(sizes["active_file"]) + int(sizes["inactive_file"])
        available.append(max(int(most) - int(used) + cached, 0))
    with suppress(OSError, KeyError, ValueError):  # no limit
        lines = (_PROCESS / "self" / "limits").read_text(encoding="utf-8").splitlines()
        most = next(line.split()[3] for line in lines if line.startswith("Max address space"))
        pages = int((_PROCESS / "self" / "statm").read_text(encoding="utf-8").split()[0])
        available.append(max(int(most) - PAGESIZE * pages, 0))
    return min(available, default=None)
