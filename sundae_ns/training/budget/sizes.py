"""Bytes of a field and its head, and the head that is small beside a field."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from sundae_ns.compensation import CompensationHead, HeadConfig
from sundae_ns.compensation.head import SIZES
from sundae_ns.storage import accounting
from sundae_ns.training.budget.search import Search

HEAD_SHARE = 0.25
"""Largest share of the field's bytes that a head may take, and of a primitive's bytes that its features may take."""
WIDTHS = (1, 5, 13, 29)
"""Numbers of features that splat without padding."""


def bytes_of(field: Mapping[str, Tensor], head: HeadConfig | None) -> int:
    """Bytes of a stored field and its head. The one place where a budget counts bytes."""
    return accounting.bytes_of(field) + head_bytes(head)


def head_bytes(head: HeadConfig | None) -> int:
    """Bytes of a head, computed without allocating its weights."""
    if head is None or head.mode == "off":
        return 0
    with torch.device("meta"):
        return accounting.bytes_of_module(CompensationHead(head))


def head_for(stored: int, primitives: int, largest: HeadConfig) -> HeadConfig | None:
    """The largest head, at most ``largest``, that is small beside ``stored`` bytes without features; None if none is."""
    narrower = [width for width in WIDTHS if width < largest.num_features]
    floats = HEAD_SHARE * stored / primitives / accounting.BYTES_PER_FLOAT
    widths = [width for width in (*narrower, largest.num_features) if width <= floats]
    sizes = list(SIZES)[: list(SIZES).index(largest.size) + 1]
    for size in reversed(sizes if widths else []):
        config = replace(largest, size=size, num_features=widths[-1])  # type: ignore[arg-type]
        if head_bytes(config) <= HEAD_SHARE * stored:
            return config
    return None


def chosen_head(search: Search, largest: HeadConfig | None) -> HeadConfig | None:
    """The head that a search has chosen, before that the largest that it may choose; None for none."""
    if largest is None or search.head_dropped:
        return None
    if not search.head_size:
        return largest
    return replace(largest, size=search.head_size, num_features=search.num_features)  # type: ignore[arg-type]
