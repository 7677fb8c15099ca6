"""``sundae demo``: what it refuses; integration/ trains."""

from __future__ import annotations

from pathlib import Path

import pytest

from sundae_ns.cli.demo import demo
from sundae_ns.core.errors import SundaeError


@pytest.mark.parametrize(("steps", "message"), [(0, "steps is 0; give at least 1"), (300, "made"), (None, "made")])
def test_no_step_is_refused_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, steps: int | None, message: str
) -> None:
    def make(scene: Path) -> None:
        scene.mkdir(parents=True)
        raise SundaeError("made")

    monkeypatch.setattr("sundae_ns.cli.demo.write_demo_capture", make)
    with pytest.raises(SundaeError, match=message):
        demo(tmp_path / "demo", steps=steps)
    assert (tmp_path / "demo").exists() == (message == "made")
