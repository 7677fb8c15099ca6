"""Training curves, read from the tensorboard event files that nerfstudio writes into a run's folder."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple


class Curve(NamedTuple):
    """One quantity over training, by ascending step."""

    steps: tuple[int, ...] = ()
    values: tuple[float, ...] = ()


@dataclass(frozen=True)
class Curves:
    """The curves of one run; a curve that the run did not record is empty."""

    loss: Curve = Curve()
    """Training loss of the step's view."""
    primitives: Curve = Curve()
    """Number of primitives."""
    psnr: Curve = Curve()
    """PSNR of the step's training view, with the head as soon as it is enabled, dB."""
    psnr_base: Curve = Curve()
    """PSNR of the same view without the head, dB."""
    memory: Curve = Curve()
    """Peak device memory so far, MiB."""


_TAGS = {
    "loss": "Train Loss",
    "primitives": "Train Metrics Dict/gaussian_count",
    "psnr": "Train Metrics Dict/psnr",
    "psnr_base": "Train Metrics Dict/psnr_base",
    "memory": "GPU Memory (MB)",
}
"""nerfstudio's tags of the curves. Its "MB" are 2^20 bytes."""


def read_curves(folder: Path) -> Curves | None:
    """Read the curves of a run from its folder; None if it holds no readable event file.

    A resumed run has several event files; its parts are joined.
    """
    if not any(folder.glob("events.out.tfevents.*")):
        return None
    # This import takes a second, and few commands need it.
    from tensorboard.backend.event_processing.event_accumulator import SCALARS, EventAccumulator

    # Tensorboard logs every incomplete record that a killed run leaves; the complete ones are enough.
    logging.getLogger("tensorboard").setLevel(logging.ERROR)
    events = EventAccumulator(str(folder), size_guidance={SCALARS: 0})
    try:
        events.Reload()
    except Exception:  # a damaged file raises many types; a report works without curves
        return None
    known = set(events.Tags()["scalars"])
    curves = {name: _curve(events.Scalars(tag)) for name, tag in _TAGS.items() if tag in known}
    return Curves(**curves) if curves else None


def _curve(events: Sequence[Any]) -> Curve:
    """A curve from tensorboard's events, each with ``step``, ``value`` and ``wall_time``."""
    # A resumed run repeats the steps after its checkpoint; the later record of a step counts.
    by_step = {event.step: event.value for event in sorted(events, key=lambda event: event.wall_time)}
    steps = sorted(by_step)
    return Curve(tuple(steps), tuple(float(by_step[step]) for step in steps))
