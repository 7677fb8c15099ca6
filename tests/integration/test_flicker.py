"""``flicker.py`` on a finished run."""

from __future__ import annotations

import json
from typing import Any

import pytest
from flicker import FRAMES, flicker, measure_flicker

from sundae_ns.errors import ConfigError
from sundae_ns.scenes.models import load_model


def test_the_head_is_compared_with_base_colours(tiny: Any, capsys: pytest.CaptureFixture[str]) -> None:
    assert flicker(tiny.folder, places=1, as_json=True) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["frames_apart"] for line in lines] == [1, 7]
    assert lines[0]["paths"] == 1
    for line in lines:
        assert 0 < line["seen"] < 1
        assert 0 < line["excess"] < line["mse"]
        assert 0 < line["excess_base"] < line["mse_base"]
        assert line["ratio"] == pytest.approx(line["excess"] / line["excess_base"])
    assert flicker(tiny.folder, places=1) == 0
    assert "head / base" in capsys.readouterr().out


def test_flicker_says_how_many_paths_there_were(tiny: Any) -> None:
    run = load_model(tiny.config)
    cameras = len(run.datamanager.train_dataset.cameras)
    frames = []
    found = measure_flicker(run, places=10 * cameras, progress=lambda: frames.append(1))
    assert {one.paths for one in found} == {len(frames) / FRAMES}
    assert 1 < found[0].paths <= cameras


def test_flicker_needs_a_head_and_a_path(tiny: Any) -> None:
    run = load_model(tiny.config)
    with pytest.raises(ConfigError, match="at 0 places"):
        measure_flicker(run, places=0)
    run.model.state.head_starts_at = 10**9
    with pytest.raises(ConfigError, match="has no head"):
        measure_flicker(run)
