"""Correlations between the patches of one image and those of other images warped through planes, in one GPU kernel.

PyTorch's operations write and read the warped image of a plane dozens of times. In ``csrc/sweep.cu`` a block of threads
samples another image for one tile and one plane into shared memory, and sums the patches there by rows and columns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import NamedTuple

import torch
from torch import Tensor

from sundae_ns.cuda.kernels import Launch, load_kernels

WINDOW = 7  # Side of the square patches, pixels

_TILE_WIDTH, _TILE_HEIGHT, _THREADS = 32, 16, 256

OPTIONS = (f"-DWINDOW={WINDOW}", f"-DTILE_WIDTH={_TILE_WIDTH}", f"-DTILE_HEIGHT={_TILE_HEIGHT}")
"""Compiler options of ``sweep.cu``."""


class Patches(NamedTuple):
    """The patches around the pixels of an image, float32 ``[H, W]`` each."""

    grey: Tensor  # of the central pixel
    size: Tensor  # number of pixels inside the image
    mean: Tensor
    deviation: Tensor


def sweep_kernels(device: torch.device) -> dict[str, Launch]:
    """The kernel for a CUDA device; see :func:`.load_kernels`."""
    return load_kernels("sweep.cu", ("correlate",), OPTIONS, device, _THREADS)


def fused_correlations(
    kernels: dict[str, Launch],
    patches: Patches,
    others: Sequence[Tensor],
    maps: Tensor,
    inverses: tuple[float, float],
    least_variance: float,
) -> Callable[[Tensor, Tensor], Tensor]:
    """A function that correlates the patches of one image with those of other images ``[H', W']``.

    ``maps`` are projections into the others ``[V, 3, 4]``: a pixel ``(x, y)`` at inverse depth d projects to the
    homogeneous ``map @ (x, y, 1, d)``. ``inverses`` are the lowest and highest inverse depth, ``least_variance`` limits
    that of a patch. For ``facing``, dot products of a normal and the points at depth 1 behind the pixel centres ``[H,
    W]``, and inverse distances ``s`` ``[S]``, the function returns the highest correlation over the others, for planes
    ``normal . X = 1 / s``, float32 ``[S, H, W]``; -1 outside of the images or of the limits.
    """
    ends = list(accumulate(image.numel() for image in others))
    starts = [(end - image.numel(), *image.shape) for end, image in zip(ends, others)]
    shapes = torch.tensor(starts, dtype=torch.int32, device=maps.device)
    inputs = [value.contiguous() for value in patches]
    images = (maps.contiguous(), shapes, torch.cat([image.flatten() for image in others]))

    def correlate(facing: Tensor, s: Tensor) -> Tensor:
        height, width = facing.shape
        tiles = -(-height // _TILE_HEIGHT) * -(-width // _TILE_WIDTH)
        scores = facing.new_empty(len(s), height, width)
        numbers = (height, width, len(s), len(others), *inverses, least_variance)
        arrays = (*inputs, facing.contiguous(), s.contiguous(), *images, scores)
        kernels["correlate"](len(s) * tiles * _THREADS, (*numbers, *arrays))
        return scores

    return correlate
