"""Progress of a training in the terminal: share and time left, PSNR and number of primitives."""

from __future__ import annotations

import time
from typing import Any

from nerfstudio.utils.writer import EVENT_STORAGE, GLOBAL_BUFFER, EventName, LocalWriter

METRICS_EVENT = "Train Metrics Dict"
"""Event of nerfstudio's trainer with the metrics of a training image."""
LINE_EVERY = 10.0
"""Seconds between two lines."""

LONG = 1800.0
"""Seconds of a training on a CPU that are worth a warning."""


class ProgressWriter(LocalWriter):
    """Prints a line every ten seconds. nerfstudio's table moves the cursor, even in a log file, and has no PSNR."""

    def __init__(self, config: Any, banner_messages: list[str] | None = None) -> None:
        super().__init__(config, banner_messages)
        for line in banner_messages or []:
            print(line, flush=True)
        self._printed_at = -LINE_EVERY
        self._metrics: Any = None

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
            done, seconds, total = trained["step"] + 1, float(trained["event"]), GLOBAL_BUFFER["max_iter"]
            left = duration((total - done) * seconds)
            print(
                f"{done} ({100 * done / max(total, 1):.2f}%)  {left} left at {1000 * seconds:.0f} ms a step  "
                f"PSNR {float(self._metrics['psnr']):.2f} dB  {self._metrics['gaussian_count']:,} primitives",
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


def duration(seconds: float) -> str:
    """A duration in two units at most: ``1 h 5 min``, ``2 min``, ``40 s``."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"
