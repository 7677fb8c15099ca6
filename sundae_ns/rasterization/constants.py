"""Small constant tensors, created once."""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor


@cache
def constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """A cached, read-only tensor of numbers; a new one would be copied to the GPU, and waited for, at each use."""
    with torch.inference_mode(False):  # autograd refuses tensors created in inference mode
        return torch.tensor(values, dtype=dtype, device=device)
