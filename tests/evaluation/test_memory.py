"""Peak memory of this process."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from sundae_ns.evaluation.timing import peak_memory


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="compares with Linux's own number")
def test_the_peak_is_in_bytes_and_at_least_the_current_memory() -> None:
    size = 64 << 20
    held = np.ones(size, np.uint8)
    now = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    peak = peak_memory(torch.device("cpu"))
    assert held.nbytes <= now <= peak * 1.01
    del held
    assert peak_memory(torch.device("cpu")) >= peak
