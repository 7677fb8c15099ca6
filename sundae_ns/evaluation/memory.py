"""Peak memory of this process."""

from __future__ import annotations

import sys

import torch


def peak_memory(device: torch.device) -> int:
    """Peak memory so far in bytes: allocated by torch on a CUDA device, else resident on the host; 0 if unknown."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    try:
        import resource
    except ImportError:  # not on Windows
        return 0
    # Linux reports kibibytes, macOS bytes.
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
