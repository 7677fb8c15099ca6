"""Exhausted GPU memory, reported with the number of primitives."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch

from sundae_ns.errors import out_of_memory


@contextmanager
def naming_full_memory(num_primitives: Callable[[], int]) -> Iterator[None]:
    """Turn CUDA's error inside the block into one that names the number of primitives and a remedy.

    Args:
        num_primitives: counts the primitives, called on an error only.

    Raises:
        MemoryExhaustedError: the memory of the GPU is full.
    """
    try:
        yield
    except torch.cuda.OutOfMemoryError as error:
        raise out_of_memory(error, num_primitives()) from error
