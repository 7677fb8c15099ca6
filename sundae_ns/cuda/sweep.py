"""Correlations between the patches of one image and those of other images warped through planes, in one GPU kernel.

PyTorch's operations write and read the warped image of a plane dozens of times. In ``csrc/sweep.cu`` a block of threads
samples another image for one tile and one plane into shared memory, and sums the patches there by rows and columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

import torch
from torch import Tensor

from sundae_ns.cuda.kernels import Launch, load_kernels

WINDOW = 7
"""Side of the square patches, pixels."""

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
    """The kernel for a CUDA device, compiled on the first call.

    Raises:
        BackendError: the kernel cannot be compiled or loaded.
    """
    return load_kernels("sweep.cu", ("correlate",), OPTIONS, device, _THREADS)


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
        tiles = -(-height // _TILE_HEIGHT) * -(-width // _TILE_WIDTH)
        scores = facing.new_empty(len(s), height, width)
        numbers = (height, width, len(s), self._num_others, *self._limits)
        arrays = (*self._patches, facing.contiguous(), s.contiguous(), *self._others, scores)
        self._launch(len(s) * tiles * _THREADS, (*numbers, *arrays))
        return scores
