"""Lines of progress, signals, the command that resumes, and which run a command opens."""

import math
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from nerfstudio.utils import writer

from sundae_ns.plugin import optimizer_configs as nerfstudio_configs
from sundae_ns.plugin.optimizer_configs import METRICS_EVENT, ProgressWriter
from sundae_ns.train.progress import Interruption, TimeLeft, duration, loaded_run, long_on_cpu, resume_command


@pytest.fixture
def line_after(monkeypatch, capsys):
    """Lines that are printed after a step, some seconds after the ones before; metrics are those of nerfstudio."""
    events, clock = [{"name": "config", "event": {}, "step": 0}], [100.0]  # a resumed run begins with its configuration
    monkeypatch.setattr(writer, "GLOBAL_BUFFER", {})
    monkeypatch.setattr(nerfstudio_configs, "GLOBAL_BUFFER", {"max_iter": 400})
    monkeypatch.setattr(nerfstudio_configs, "EVENT_STORAGE", events)
    monkeypatch.setattr(nerfstudio_configs.time, "monotonic", lambda: clock[0])
    made = ProgressWriter(SimpleNamespace(stats_to_track=(), max_log_size=10), ["Viewer at: somewhere"])

    def lines(step, seconds, **metrics):
        events[1:] = [{"name": "Train Iter (time)", "event": 0.25, "step": step}]
        events.extend({"name": METRICS_EVENT, "event": metrics} for _ in range(bool(metrics)))
        clock[0] += seconds
        made.write_stats_log(0)
        return capsys.readouterr().out.splitlines()

    return lines


def test_a_line_says_what_is_done_and_left(line_after):
    assert line_after(150, 0) == ["Viewer at: somewhere"], "nothing is measured yet"
    first = line_after(159, 0, psnr=21.456, gaussian_count=12345)
    assert first == ["160 (40.00%)  PSNR 21.46 dB  12,345 Gaussians"], "the first step compiles"
    assert line_after(160, 0) == []
    (line,) = line_after(199, 10)
    assert line == "200 (50.00%)  50 s left at 250 ms a step  PSNR 21.46 dB  12,345 Gaussians", "of the last metrics"


def test_the_time_left_does_not_jump():
    """Intervals of ten seconds in which a step takes 16 or 124 ms, which would be 8 and 62 minutes of 30,000 steps."""
    watch, total, done, now = TimeLeft(), 30000, 0, 0.0
    found = []
    while done < total:
        done, now = min(done + round(10 / (0.016 if len(found) % 2 else 0.124)), total), now + 10
        found.append((watch.update(done, total, now) or math.nan, now))
    later = [left for left, _ in found[10:-6]]
    assert all(1 / 1.5 < after / before < 1.5 for before, after in zip(later, later[1:]))
    half = len(found) // 2
    assert 0.6 < found[half][0] / (now - found[half][1]) < 1.5, "and it is right"
    watch, now = TimeLeft(), 0.0  # a lasting change is followed
    for done in range(0, 3001, 10):
        now += 10 * (0.1 if done < 500 else 1.0)
        watch.update(done, 3000, now)
    assert watch.step_s == pytest.approx(1.0, rel=0.05)


def test_a_training_of_hours_on_a_cpu_is_foretold():
    assert [duration(seconds) for seconds in (0.4, 59.6, 185, 7261)] == ["0 s", "1 min 0 s", "3 min 5 s", "2 h 1 min"]
    assert long_on_cpu(0.05, 30000) is None
    text = long_on_cpu(1.7, 30000)
    for part in ("at least 14 h 10 min", "1700 ms", "sundae-tiny", "--downscale-factor"):
        assert part in text


def test_the_first_signal_is_noted_and_the_handlers_come_back(monkeypatch):
    """Also if who read the output was killed."""

    def broken(*_):
        raise BrokenPipeError

    monkeypatch.setattr(os, "write", broken)
    before, asked = signal.getsignal(signal.SIGTERM), []
    with Interruption(lambda: asked.append(True)) as interruption:
        assert interruption.number == 0
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)  # of a scheduler that asks again
        assert (interruption.number, asked) == (signal.SIGTERM, [True])
    assert signal.getsignal(signal.SIGTERM) is before


TWICE = """
import signal
from sundae_ns.train.progress import Interruption
with Interruption(lambda: None):
    signal.raise_signal(signal.SIGINT)
    print("saving", flush=True)
    signal.raise_signal(signal.SIGINT)
    print("too late")
"""


def test_a_second_one_leaves_at_once():
    result = subprocess.run([sys.executable, "-c", TWICE], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout) == (130, "saving\n")
    assert "Left without saving" in result.stderr


@pytest.mark.parametrize(
    ("started", "expected"),
    [
        ("sundae --data a --max-num-iterations 9", "sundae --load-dir 'a run' --max-num-iterations 4 --data a"),
        ("sundae --max-num-iterations=9 --vis x", "sundae --load-dir 'a run' --max-num-iterations 4 --vis x"),
        ("sundae-1 --load-dir old --load-step 4 colmap --a s", "sundae-1 --load-dir 'a run' colmap --a s"),
        ("", "sundae --data data --load-dir 'a run'"),  # by another program
    ],
)
def test_the_command_that_resumes(started, expected):
    program = ["/usr/bin/ns-train", *started.split()] if started else ["pytest", "--load-dir", "x"]
    assert resume_command(program, Path("a run"), "sundae", "data", 4) == f"ns-train {expected}"


@pytest.mark.parametrize(
    ("command", "opens"),
    [
        ("ns-eval --load-config {}", True),
        ("/usr/bin/ns-render camera-path --load-config={}", True),
        ("ns-viewer --load_config {}", True),
        ("ns-export gaussian-splat --load-config={}", True),
        ("ns-train sundae --load-config {}", False),
        ("sundae compare {}", False),
        ("ns-eval --load-config", False),
        ("ns-eval --output-path {}", False),
        ("", False),
    ],
)
def test_the_folder_of_the_run_that_a_command_opens(tmp_path, command, opens):
    words = command.format(tmp_path / "config.yml").split()
    assert loaded_run(words) is None, "there is no such file"
    (tmp_path / "config.yml").touch()
    assert loaded_run(words) == (tmp_path if opens else None)
