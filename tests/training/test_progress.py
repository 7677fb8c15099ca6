"""Lines of progress: share and time left of the whole run, quality and size."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from nerfstudio.utils import writer

from sundae_ns.cli.process import percent_of
from sundae_ns.training import progress
from sundae_ns.training.progress import METRICS, ProgressWriter, duration, long_on_cpu


def test_a_line_says_what_is_done_and_left(monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.setattr(writer, "GLOBAL_BUFFER", {})
    monkeypatch.setattr(progress, "GLOBAL_BUFFER", {"max_iter": 400})
    events: list[dict[str, Any]] = [
        # A resumed run writes its configuration first.
        {"name": "config", "event": {}, "step": 0},
        {"name": "Train Iter (time)", "event": 0.25, "step": 159},
        {"name": METRICS, "event": {"psnr": 21.456, "gaussian_count": 12345}},
    ]
    monkeypatch.setattr(progress, "EVENT_STORAGE", events)
    made = ProgressWriter(SimpleNamespace(stats_to_track=(), max_log_size=10), ["Viewer at: somewhere"])
    made.write_stats_log(0)
    made.write_stats_log(0)
    banner, line = capsys.readouterr().out.splitlines()
    assert banner == "Viewer at: somewhere"
    assert line == "160 (40.00%)  1 min 0 s left at 250 ms a step  PSNR 21.46 dB  12,345 primitives"
    assert percent_of(line) == 40, "sundae demo reads it"


def test_a_slow_step_without_metrics_shows_the_last_ones(monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.setattr(progress, "EVERY", 0.0)
    monkeypatch.setattr(progress, "GLOBAL_BUFFER", {"max_iter": 4})
    events: list[dict[str, Any]] = [{"name": "Train Iter (time)", "event": 2.0, "step": 0}]
    monkeypatch.setattr(progress, "EVENT_STORAGE", events)
    made = ProgressWriter(SimpleNamespace(stats_to_track=(), max_log_size=10))
    made.write_stats_log(0)
    assert capsys.readouterr().out == "", "nothing is measured yet"
    events.append({"name": METRICS, "event": {"psnr": 20.0, "gaussian_count": 7}})
    events[0]["step"] = 1
    made.write_stats_log(1)
    del events[1]
    events[0]["step"] = 2
    made.write_stats_log(2)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["2", "3"]
    assert lines[1].endswith("PSNR 20.00 dB  7 primitives")


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0 s"), (59.6, "1 min 0 s"), (185, "3 min 5 s"), (7261, "2 h 1 min")]
)
def test_durations(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_a_training_of_hours_on_a_cpu_is_foretold() -> None:
    assert long_on_cpu(0.05, 30000) is None
    text = long_on_cpu(1.7, 30000)
    assert text is not None
    for part in ("at least 14 h 10 min", "1700 ms", "sundae-tiny", "--downscale-factor"):
        assert part in text
