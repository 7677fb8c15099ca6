"""Numbers in tables and in JSON."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

MEGABYTE = 1e6  # bytes in the MB of tables and plots


def without_nan(value: Any) -> Any:
    """Plain values for JSON: numbers that are not finite become None."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: without_nan(inner) for key, inner in value.items()}
    return [without_nan(inner) for inner in value] if isinstance(value, (list, tuple)) else value


def number(value: float | None, digits: int) -> str:
    """A number with ``digits`` decimals; a dash for None and NaN."""
    return "-" if value is None or value != value else f"{value:,.{digits}f}"


def table(heads: Sequence[str], rows: Sequence[Sequence[str]], *, words: int = 2) -> list[str]:
    """Lines of a Markdown table; the first ``words`` columns are aligned left, the others right."""
    rule = ["---" if i < words else "---:" for i in range(len(heads))]
    return ["| " + " | ".join(cells).replace("\n", " ") + " |" for cells in (heads, rule, *rows)]
