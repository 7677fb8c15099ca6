"""Correlations between the patches of one image and those of other images warped through planes, in one GPU kernel.

PyTorch's operations write and read the warped image of a plane dozens of times. Here a block of threads samples another
image for one tile and one plane into shared memory, and sums the patches there by rows and columns.

The source is plain C++ except for the thread indices, so the tests compile the same source for the CPU.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

import torch
from torch import Tensor

from sundae_ns.gpu.nvrtc import Launch, load_kernels

WINDOW = 7
"""Side of the square patches, pixels."""

TILE_WIDTH, TILE_HEIGHT = 32, 16
THREADS = 256


OPTIONS = (f"-DWINDOW={WINDOW}", f"-DTILE_WIDTH={TILE_WIDTH}", f"-DTILE_HEIGHT={TILE_HEIGHT}")
"""Compiler options of ``sweep.cu``."""


class Patches(NamedTuple):
    """The patches around the pixels of an image, float32 ``[H, W]`` each."""

    grey: Tensor
    """Grey value of the central pixel."""
    size: Tensor
    """Number of pixels inside the image."""
    mean: Tensor
    deviation: Tensor


def sweep_kernels(device: torch.device) -> dict[str, Launch]:
    """The kernel for a CUDA device, compiled on the first call.

    Raises:
        BackendError: the kernel cannot be compiled or loaded.
    """
    return load_kernels("sweep.cu", ("correlate",), OPTIONS, device, THREADS)


class FusedCorrelations:
    """Correlations between the patches of one image and those of other images.

    Args:
        kernels: returned by :func:`sweep_kernels`.
        patches: of the image, on the device of the kernels.
        others: grey values of the other images, at least one, ``[H', W']`` each.
        maps: projections into the other images ``[len(others), 3, 4]``: a pixel ``(x, y)`` at inverse depth d projects
            to the homogeneous ``map @ (x, y, 1, d)``.
        inverses: lowest and highest inverse depth.
        least_variance: lower limit for the variance of a patch of another image.
    """

    def __init__(
        self,
        kernels: dict[str, Launch],
        patches: Patches,
        others: Sequence[Tensor],
        maps: Tensor,
        inverses: tuple[float, float],
        least_variance: float,
    ) -> None:
        ends = list(accumulate(image.numel() for image in others))
        shapes = [(end - image.numel(), *image.shape) for end, image in zip(ends, others)]
        self._launch, self._limits = kernels["correlate"], (*inverses, least_variance)
        self._patches = [value.contiguous() for value in patches]
        self._others = [
            maps.contiguous(),
            torch.tensor(shapes, dtype=torch.int32, device=maps.device),
            torch.cat([image.flatten() for image in others]),
        ]
        self._num_others = len(others)

    def __call__(self, facing: Tensor, s: Tensor) -> Tensor:
        """Highest correlation over the other images, for planes ``normal . X = 1 / s``: float32 ``[S, H, W]``.

        It is -1 where no other image contains the projected pixel, and where the inverse depth is outside the limits.

        Args:
            facing: dot products of the normal and the points at depth 1 behind the pixel centres ``[H, W]``.
            s: inverse distances of the planes ``[S]``.
        """
        height, width = facing.shape
        tiles = -(-height // TILE_HEIGHT) * -(-width // TILE_WIDTH)
        scores = facing.new_empty(len(s), height, width)
        numbers = (height, width, len(s), self._num_others, *self._limits)
        arrays = (*self._patches, facing.contiguous(), s.contiguous(), *self._others, scores)
        self._launch(len(s) * tiles * THREADS, (*numbers, *arrays))
        return scores
