"""``bands.py`` on a finished run, from the cameras that nerfstudio gives to it."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest
import torch
from bands import bands
from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image

from harness.cameras import training_cameras
from sundae_ns.errors import ConfigError


def test_cameras_are_those_of_the_run(tiny: Any) -> None:
    _, pipeline, _, _ = eval_setup(tiny.config, test_mode="test")
    expected = pipeline.datamanager.train_dataset.cameras
    found = training_cameras(tiny.config)
    assert len(found) == len(expected)
    torch.testing.assert_close(found.camera_to_worlds, expected.camera_to_worlds)
    torch.testing.assert_close(found.get_intrinsics_matrices(), expected.get_intrinsics_matrices())


@pytest.mark.parametrize("what", ["folder", "config", "checkpoints"])
def test_points_lie_where_the_run_renders_them(tiny: Any, tmp_path: Path, what: str) -> None:
    assert bands(getattr(tiny, what), tmp_path, keep_ratio=(0.5,), view=2) == 0
    result = json.loads((tmp_path / "bands.json").read_text())
    assert result["seen_from"] == "training view 2"
    assert result["primitives"] == result["bands"][0]["kept"]["high"] + result["bands"][0]["kept"]["low"]
    assert set(os.listdir(tmp_path)) == {*result["files"], "bands.json"}
    with Image.open(tmp_path / "bands-0.5.png") as sheet:
        assert len(sheet.getcolors(sheet.width * sheet.height)) > 100


def test_a_view_that_is_not_there(tiny: Any, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="the run has 12, from 0 on"):
        bands(tiny.folder, tmp_path, view=12)
