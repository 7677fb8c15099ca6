"""A short refit and few virtual views, for tests in which a prune is only a means."""

from __future__ import annotations

import pytest

STEPS, VIEWS, SIDE = 4, 8, 64
SHORT = f"""
from sundae_ns.scene import prune_scene as pruning, virtual_cameras as virtual
pruning.REFIT["cpu"], virtual.VIEWS["cpu"], virtual.SIDE = ({STEPS}, 4, 1.0), {VIEWS}, {SIDE}
"""
"""What the fixture does, as lines of a program of its own."""


@pytest.fixture
def short_prunes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Prunes by few small views and few steps; they train nothing by themselves."""
    from sundae_ns.scene import prune_scene as pruning
    from sundae_ns.scene import virtual_cameras as virtual

    monkeypatch.setitem(pruning.REFIT, "cpu", (STEPS, 4, 1.0))
    monkeypatch.setitem(virtual.VIEWS, "cpu", VIEWS)
    monkeypatch.setattr(virtual, "SIDE", SIDE)


@pytest.fixture
def short_distillation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Distillation and levels of detail by few small views and few steps."""
    for name, value in {"STEPS": {"cpu": 4}, "LEVEL_STEPS": {"cpu": 2}, "CAMERAS": 8, "SIDES": {"cpu": 32}}.items():
        monkeypatch.setattr(f"sundae_ns.plugin.distill.{name}", value)
