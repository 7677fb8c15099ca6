import os
from pathlib import Path

import numpy as np
import pytest
import torch

from sundae_ns.core import timing as timing_module
from sundae_ns.core.timing import median_ms, peak_memory


def test_the_median_of_a_fake_clock_that_waits_for_the_device_on_both_sides(monkeypatch):
    seconds = iter([9.0, 9.0, 0.010, 0.030, 0.020, 0.500, 0.040])
    now, events = [0.0], []

    def work():
        events.append("work")
        now[0] += next(seconds)

    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: events.append("wait"))
    monkeypatch.setattr(timing_module.time, "perf_counter", lambda: events.append("clock") or now[0])
    assert median_ms(work, device="cuda", warmup=2, repeats=5) == pytest.approx(30)
    assert events == ["work"] * 2 + ["wait", "clock", "work", "wait", "clock"] * 5


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="compares with Linux's own number")
def test_the_peak_is_in_bytes_and_at_least_the_current_memory():
    held = np.ones(64 << 20, np.uint8)
    now = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    peak = peak_memory(torch.device("cpu"))
    assert held.nbytes <= now <= peak * 1.01
