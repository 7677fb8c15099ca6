"""Progress of a training in the terminal: share and time left, PSNR and number of primitives."""

from __future__ import annotations

import math
import time
from typing import Any

from nerfstudio.utils.writer import EVENT_STORAGE, GLOBAL_BUFFER, EventName, LocalWriter

from sundae_ns.training.duration import LONG, duration

METRICS_EVENT = "Train Metrics Dict"
"""Event of nerfstudio's trainer with the metrics of a training image."""
LINE_EVERY = 10.0
"""Seconds between two lines."""


class TimeLeft:
    """Smooths the time of a step: evaluations, saves and a busy machine change it by the minute.

    Intervals between two lines count by their steps, those of the last :data:`SHARE` of a run the most. A step counts
    :data:`MOST` times the usual one at most.
    """

    SHARE = 0.1
    MOST = 3.0

    def __init__(self) -> None:
        self.step_s: float | None = None
        """Seconds of a step; None before the second line, as the first step also compiles."""
        self._at: tuple[int, float] | None = None
        self._steps = 0.0

    def update(self, done: int, total: int, now: float) -> float | None:
        """Seconds left after ``done`` of ``total`` steps at the time ``now``; None if it is not known yet."""
        before, self._at = self._at, (done, now)
        if before is not None and done > before[0]:
            steps = done - before[0]
            found = (now - before[1]) / steps
            if self.step_s is None:
                self.step_s, self._steps = found, steps
            else:
                found = min(max(found, self.step_s / self.MOST), self.step_s * self.MOST)
                kept = self._steps * math.exp(-steps / max(self.SHARE * total, 1))
                self.step_s = (kept * self.step_s + steps * found) / (kept + steps)
                self._steps = kept + steps
        return None if self.step_s is None else (total - done) * self.step_s


class ProgressWriter(LocalWriter):
    """Prints a line every ten seconds. nerfstudio's table moves the cursor, even in a log file, and has no PSNR."""

    def __init__(self, config: Any, banner_messages: list[str] | None = None) -> None:
        super().__init__(config, banner_messages)
        for line in banner_messages or []:
            print(line, flush=True)
        self._printed_at = -LINE_EVERY
        self._metrics: Any = None
        self._time_left = TimeLeft()

    def write_stats_log(self, step: int) -> None:
        """Print a line if it is due.

        Args:
            step: ignored; it belongs to nerfstudio's first event, which is the configuration after a start.
        """
        events = {event["name"]: event for event in EVENT_STORAGE}
        # nerfstudio measures every few steps only, and ten steps after a prune may take a minute on a CPU.
        if METRICS_EVENT in events:
            self._metrics = events[METRICS_EVENT]["event"]
        trained = events.get(EventName.ITER_TRAIN_TIME.value)
        if trained is not None and self._metrics is not None and time.monotonic() - self._printed_at >= LINE_EVERY:
            self._printed_at = time.monotonic()
            done, total = trained["step"] + 1, GLOBAL_BUFFER["max_iter"]
            left = self._time_left.update(done, total, self._printed_at)
            speed = 1000 * (self._time_left.step_s or 0.0)
            pace = "" if left is None else f"{duration(left)} left at {speed:.0f} ms a step  "
            print(
                f"{done} ({100 * done / max(total, 1):.2f}%)  {pace}PSNR {float(self._metrics['psnr']):.2f} dB  "
                f"{self._metrics['gaussian_count']:,} primitives",
                flush=True,
            )


def long_on_cpu(seconds: float, left: int) -> str | None:
    """A warning if a training on a CPU takes more than half an hour; None otherwise.

    Args:
        seconds: time of one of the first steps, which use smaller images and fewer primitives than later ones.
        left: number of steps to come.
    """
    if seconds * left <= LONG:
        return None
    return (
        f"this training runs on a CPU and takes at least {duration(seconds * left)} more ({1000 * seconds:.0f} ms a "
        "step). sundae-tiny is made for a CPU, --max-num-iterations shortens the whole schedule, and smaller images "
        "are faster: end the command with nerfstudio-data --downscale-factor 4"
    )
