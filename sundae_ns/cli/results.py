"""Whether results of commands are whole: a full disk or a copy may have left a part of a file."""

from __future__ import annotations

import re
from pathlib import Path

from sundae_ns.errors import SundaeError

_IMAGE = re.compile(r"\]\(([^()]+\.(?:png|jpg))\)")
"""Name of an image in a report."""
_TAIL = 16
"""Bytes at the end of a page: the end of its last element, or of the licences behind it."""


def is_evaluation(path: Path) -> bool:
    """Whether a file has the metrics of an evaluation, as JSON."""
    from sundae_ns.data.capture import read_json

    try:
        results = read_json(path).get("results")
    except SundaeError:
        return False
    return isinstance(results, dict) and bool(results)


def is_packed(path: Path) -> bool:
    """Whether a file is a packed scene whose checksums are right."""
    from sundae_ns.storage.pack.container import read_header, read_sections

    try:
        read_sections(path, read_header(path))
    except SundaeError:
        return False
    return True


def is_report(path: Path) -> bool:
    """Whether a report (``report.md``) has its last line, and beside it all of its images and ``report.html``."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, ValueError):
        return False
    whole = text.endswith("\n") and is_page(path.with_suffix(".html"))
    return whole and all(_decodes(path.parent / name) for name in _IMAGE.findall(text))


def _decodes(path: Path) -> bool:
    from PIL import Image

    try:
        with Image.open(path) as image:
            image.load()
    except (OSError, ValueError, SyntaxError):  # Pillow's errors for broken files
        return False
    return True


def is_page(path: Path) -> bool:
    """Whether a web page has its end, which comes after the scene."""
    try:
        with path.open("rb") as file:
            file.seek(-_TAIL, 2)
            return file.read().rstrip().endswith((b"</html>", b"-->"))
    except OSError:  # it is missing, or shorter
        return False
