"""The head of a search: the largest that is small beside the field."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from sundae_ns.compensation import HeadConfig
from sundae_ns.compensation.head import SIZES
from sundae_ns.storage import accounting
from sundae_ns.training.budget.search import SearchProgress
from sundae_ns.training.field_state import FieldState

HEAD_SHARE = 0.25
"""Largest share of the field's bytes that a head may take, and of a primitive's bytes that its features may take."""
WIDTHS = (1, 5, 13, 29)
"""Numbers of features that splat without padding."""


def head_for(primitives: int, row: int, largest: HeadConfig) -> HeadConfig | None:
    """The largest head, at most ``largest``, that is small beside a field; None if none is.

    Args:
        primitives: number of primitives of the field.
        row: bytes of a primitive without features.
        largest: configuration of the largest head.
    """
    narrower = [width for width in WIDTHS if width < largest.num_features]
    floats = HEAD_SHARE * row / accounting.BYTES_PER_FLOAT
    widths = [width for width in (*narrower, largest.num_features) if width <= floats]
    sizes = list(SIZES)[: list(SIZES).index(largest.size) + 1]
    for size in reversed(sizes if widths else []):
        config = replace(largest, size=size, num_features=widths[-1])  # type: ignore[arg-type]
        if accounting.bytes_of_head(config) <= HEAD_SHARE * primitives * row:
            return config
    return None


def reshape(state: FieldState, search: SearchProgress, largest: HeadConfig | None) -> None:
    """Give field and head the shapes that a search has left in a checkpoint; values are loaded afterwards."""
    if search.degree >= 0:
        rest = state.field["features_rest"]
        rest.data = rest.data[:, : (search.degree + 1) ** 2 - 1]
    if largest is None or search.head_dropped:
        state.remove_head()
        return
    size: Any = search.head_size
    chosen = replace(largest, size=size, num_features=search.num_features) if size else largest
    if state.head is not None and state.head.config != chosen:
        state.reshape_head(chosen)
