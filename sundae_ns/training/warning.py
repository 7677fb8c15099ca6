"""Warnings to the user, in the words of one place."""

from __future__ import annotations

from nerfstudio.utils.rich_utils import CONSOLE


def warn(text: str) -> None:
    """Print a warning on the console, without markup: names of files may hold brackets."""
    CONSOLE.print(f"Warning: {text}", style="yellow", markup=False, soft_wrap=True)
