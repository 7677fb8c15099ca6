"""A short refit and few virtual views, for tests in which a prune is only a means."""

from __future__ import annotations

import pytest

SHORT = """
from sundae_ns.api import refit, virtual
refit.STEPS["cpu"], virtual.VIEWS["cpu"], virtual.SIDES["cpu"] = 4, 8, 64
"""
"""The same as lines of a program of its own."""


@pytest.fixture
def short_prunes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Prunes by few small views and few steps; they train nothing by themselves."""
    from sundae_ns.api import refit, virtual

    monkeypatch.setitem(refit.STEPS, "cpu", 4)
    monkeypatch.setitem(virtual.VIEWS, "cpu", 8)
    monkeypatch.setitem(virtual.SIDES, "cpu", 64)
