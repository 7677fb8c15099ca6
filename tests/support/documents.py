"""Parsed JSON, changed by dotted paths."""

from __future__ import annotations

from collections.abc import Mapping
from functools import reduce
from operator import getitem
from typing import Any

GONE = object()
"""Value of what is removed."""


def put(document: Any, changes: Mapping[str, Any]) -> None:
    """Set values of a document; ``{"nodes.0.scale": [1, 2, 1]}`` names one by keys and indices."""
    for path, value in changes.items():
        *outer, last = (int(key) if key.isdigit() else key for key in path.split("."))
        inner = reduce(getitem, outer, document)
        if value is GONE:
            del inner[last]
        else:
            inner[last] = value
