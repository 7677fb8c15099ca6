"""Curves over training, from the tensorboard event files that nerfstudio leaves in a run's folder."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Curve:
    """One quantity over training, by ascending step."""

    steps: tuple[int, ...] = ()
    values: tuple[float, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.steps)


@dataclass(frozen=True)
class Curves:
    """What a run recorded of itself; curves that it did not record are empty."""

    loss: Curve = Curve()
    """Training loss, of the step's view."""
    primitives: Curve = Curve()
    psnr: Curve = Curve()
    """Of the training view of the step, with the head once it takes part, dB."""
    psnr_base: Curve = Curve()
    """The same without the head, dB."""
    memory: Curve = Curve()
    """Most device memory so far, MiB."""

    def __bool__(self) -> bool:
        return any(getattr(self, field.name) for field in fields(self))


TAGS = {
    "loss": "Train Loss",
    "primitives": "Train Metrics Dict/gaussian_count",
    "psnr": "Train Metrics Dict/psnr",
    "psnr_base": "Train Metrics Dict/psnr_base",
    "memory": "GPU Memory (MB)",
}
"""nerfstudio's names of the curves. Its "MB" are 2^20 bytes."""


def read_curves(folder: Path) -> Curves | None:
    """Read the curves of a run.

    Args:
        folder: the run's folder; event files lie in it, several where training was resumed.

    Returns:
        The curves, a resumed run's as one; None where the folder has no event file, or none that can be read.
    """
    if not any(folder.glob("events.out.tfevents.*")):
        return None
    # Here and not above: it loads for a second, and few need it.
    from tensorboard.backend.event_processing.event_accumulator import SCALARS, EventAccumulator

    # It logs each odd thing that a killed run leaves behind; what can be read is read.
    logging.getLogger("tensorboard").setLevel(logging.ERROR)
    events = EventAccumulator(str(folder), size_guidance={SCALARS: 0})
    try:
        events.Reload()
    except Exception:  # a damaged file ends in many kinds; curves are no reason to end a report
        return None
    known = set(events.Tags()["scalars"])
    curves = Curves(**{name: _curve(events.Scalars(tag)) for name, tag in TAGS.items() if tag in known})
    return curves if curves else None


def _curve(events: Sequence[Any]) -> Curve:
    """A curve of tensorboard's events, each with ``step``, ``value`` and ``wall_time``."""
    # A resumed run repeats the steps after its checkpoint; the later record of a step counts.
    by_step = {event.step: event.value for event in sorted(events, key=lambda event: event.wall_time)}
    steps = sorted(by_step)
    return Curve(tuple(steps), tuple(float(by_step[step]) for step in steps))
