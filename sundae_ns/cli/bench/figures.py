"""Numbers as benchmarks print them."""

from __future__ import annotations


def significant(value: float, digits: int = 4) -> float:
    """The number rounded to this many significant digits."""
    return float(f"{value:.{digits}g}")
