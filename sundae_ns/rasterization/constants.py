"""Small tensors that are made once."""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor


@cache
def constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Some numbers as a tensor that nobody changes; a fresh one would be copied to the GPU, and waited for, at each use."""
    with torch.inference_mode(False):  # one made in that mode could not take part in training later
        return torch.tensor(values, dtype=dtype, device=device)
