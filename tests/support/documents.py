"""Nested dictionaries and lists, changed by paths such as ``nodes/0/scale``."""

from __future__ import annotations

from collections.abc import Mapping
from functools import reduce
from operator import getitem
from typing import Any

GONE = object()  # Value of what is removed


def put(document: Any, changes: Mapping[str, Any]) -> None:
    """Set values by their paths; a function makes a value of the one before."""
    for path, value in changes.items():
        *outer, last = (int(key) if key.isdigit() else key for key in path.split("/"))
        inner = reduce(getitem, outer, document)
        if value is GONE:
            del inner[last]
        else:
            inner[last] = value(inner[last]) if callable(value) else value
