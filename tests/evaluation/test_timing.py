import time

import pytest
import torch

from sundae_ns.errors import ConfigError
from sundae_ns.evaluation import median_ms
from sundae_ns.evaluation import timing as timing_module


def test_statistics_of_a_fake_clock(monkeypatch):
    seconds = iter([0.010, 0.030, 0.020, 0.500, 0.040])
    now, calls = [0.0], []

    def work():
        calls.append(None)
        if len(calls) > 2:
            now[0] += next(seconds)

    monkeypatch.setattr(timing_module.time, "perf_counter", lambda: now[0])
    result = median_ms(work, device="cpu", warmup=2, repeats=5)
    assert len(calls) == 7
    assert result == pytest.approx(30)


def test_waits_for_the_device_on_both_sides(monkeypatch):
    events = []
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: events.append("wait"))
    clock = time.perf_counter
    monkeypatch.setattr(timing_module.time, "perf_counter", lambda: events.append("clock") or clock())
    median_ms(lambda: events.append("work"), device="cuda", warmup=0, repeats=2)
    assert events == ["wait", "clock", "work", "wait", "clock"] * 2


@pytest.mark.parametrize("wrong", [{"warmup": -1}, {"repeats": 0}])
def test_impossible_options(wrong):
    with pytest.raises(ConfigError):
        median_ms(lambda: None, device="cpu", **wrong)
