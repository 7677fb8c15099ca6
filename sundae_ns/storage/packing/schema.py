"""The one description of headers and sections, ``format.json``, and the checks by it.

The web page is built with the same file, and ``web/src/scene/schema.ts`` is the twin of this module: both readers
refuse the same files. A schema is JSON Schema (2020-12) with the keywords that :func:`fault` reads. Two are our own:
items of a list differ in the entry ``uniqueBy``; ``orthonormal`` lists are a direction ``[3]`` or the rows of a pose
``[3, 4]``, of about unit length and at right angles, and three rows are no mirror image.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

FORMAT: dict[str, Any] = json.loads(resources.files(__package__).joinpath("format.json").read_text(encoding="utf-8"))
"""``limits`` of files, schemas of ``container``, ``header`` and ``model``, and ``sections`` by codec and part."""
LIMITS: dict[str, int] = FORMAT["limits"]
_CROOKED = 0.1
"""Most that products of ``orthonormal`` rows are off; captures may be as far off."""
_TYPES: dict[str, type] = {"object": dict, "array": list, "string": str, "null": type(None)}


def fault(value: Any, schema: Mapping[str, Any], place: str = "") -> str | None:
    """The place of the first violation of a schema, as dotted keys from ``place`` on; None for a valid value.

    Whole numbers may be written as ``3.0``, which JavaScript does not tell from ``3``.
    """
    kinds = schema.get("type", [])
    kinds = [kinds] if isinstance(kinds, str) else kinds
    if kinds and not any(_is(value, kind) for kind in kinds):
        return place
    if "enum" in schema and value not in schema["enum"]:
        return place
    if isinstance(value, str) and not re.fullmatch(schema.get("pattern", ".*"), value, re.DOTALL):
        return place
    if _is(value, "number"):
        lowest, highest = schema.get("minimum", value), schema.get("maximum", value)
        return None if lowest <= value <= highest else place
    if isinstance(value, list):
        return _fault_of_list(value, schema, place)
    return _fault_of_object(value, schema, place) if isinstance(value, dict) else None


def _is(value: Any, kind: str) -> bool:
    if kind == "integer":
        return type(value) is int or (type(value) is float and value.is_integer())
    # By type: True is 1 in Python.
    return type(value) in (int, float) if kind == "number" else isinstance(value, _TYPES[kind])


def _fault_of_list(value: list[Any], schema: Mapping[str, Any], place: str) -> str | None:
    count = len(value)
    if not schema.get("minItems", 0) <= count <= schema.get("maxItems", count):
        return place
    first = schema.get("prefixItems", [])
    for i, item in enumerate(value):
        wanted = first[i] if i < len(first) else schema.get("items", {})
        found = fault(item, wanted, _joined(place, i))
        if found is not None:
            return found
    key = schema.get("uniqueBy")
    if key is not None and len({item[key] for item in value}) < count:
        return place
    return place if schema.get("orthonormal") and not _is_orthonormal(value) else None


def _is_orthonormal(value: list[Any]) -> bool:
    """Whether a checked list is a direction, or the rows of a rotation, before their fourth number."""
    rows = [row[:3] for row in value] if isinstance(value[0], list) else [value]

    def dot(a: list[float], b: list[float]) -> float:
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

    for i, row in enumerate(rows):
        for j in range(i + 1):
            if not abs(dot(row, rows[j]) - (i == j)) <= _CROOKED:
                return False
    if len(rows) < 3:
        return True
    (a, b, c), (d, e, f) = rows[0], rows[1]
    return dot([b * f - c * e, c * d - a * f, a * e - b * d], rows[2]) > 0


def _fault_of_object(value: dict[str, Any], schema: Mapping[str, Any], place: str) -> str | None:
    properties: Mapping[str, Any] = schema.get("properties", {})
    for key in schema.get("required", ()):
        if key not in value:
            return _joined(place, key)
    if schema.get("additionalProperties") is False and not value.keys() <= properties.keys():
        return place
    for key, wanted in properties.items():
        if key in value:
            found = fault(value[key], wanted, _joined(place, key))
            if found is not None:
                return found
    return None


def _joined(place: str, key: str | int) -> str:
    return f"{place}.{key}" if place else str(key)


def parsed(content: bytes) -> Any:
    """A JSON value of UTF-8; ``ValueError`` if it is none, is nested too deeply, or has numbers beyond float64."""

    def whole(text: str) -> int:
        try:
            float(int(text))
        except OverflowError as error:
            raise ValueError("a number is beyond float64") from error
        return int(text)

    def real(text: str) -> float:
        value = float(text)
        if not np.isfinite(value):
            raise ValueError("a number is beyond float64")
        return value

    def constant(name: str) -> None:
        raise ValueError(f"{name} is not a number")

    try:
        value = json.loads(content.decode(), parse_int=whole, parse_float=real, parse_constant=constant)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    if not _shallow(value, LIMITS["depth"]):
        raise ValueError("it is nested too deeply")
    return value


def _shallow(value: Any, depth: int) -> bool:
    """Whether lists and objects are nested at most ``depth`` deep."""
    if not isinstance(value, (list, dict)):
        return True
    inner = value.values() if isinstance(value, dict) else value
    return depth > 0 and all(_shallow(item, depth - 1) for item in inner)


def fits(array: NDArray[Any], section: Mapping[str, Any], lengths: Mapping[str, int]) -> bool:
    """Whether an array has dtype and shape of a section.

    Args:
        array: the section's array.
        section: of ``FORMAT["sections"]``.
        lengths: sides that the shape names; None there matches any length.
    """
    sides = [lengths.get(side, side) for side in section["shape"]]
    same = all(side is None or side == found for side, found in zip(sides, array.shape, strict=False))
    return array.dtype.str == section["dtype"] and array.ndim == len(sides) and same


def in_range(array: NDArray[Any], section: Mapping[str, Any]) -> bool:
    """Whether all values are finite and in the range of a section; a list is a range for each column."""
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        return False
    lowest, highest = np.array(section.get("minimum", -np.inf)), np.array(section.get("maximum", np.inf))
    return bool(((array >= lowest) & (array <= highest)).all())
