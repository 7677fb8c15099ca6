"""Times of trainings in words."""

from __future__ import annotations

LONG = 1800.0
"""Seconds of a training on a CPU that are worth a warning."""


def duration(seconds: float) -> str:
    """A duration in two units at most: ``1 h 5 min``, ``2 min``, ``40 s``."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"
