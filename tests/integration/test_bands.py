"""``sundae bands`` on a finished run, from the cameras that nerfstudio gives to it."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image

from sundae_ns.cli import main
from sundae_ns.scenes.cameras import training_cameras


def test_cameras_are_those_of_the_run(tiny: Any) -> None:
    _, pipeline, _, _ = eval_setup(tiny.config, test_mode="test")
    expected = pipeline.datamanager.train_dataset.cameras
    found = training_cameras(tiny.config)
    assert len(found) == len(expected)
    torch.testing.assert_close(found.camera_to_worlds, expected.camera_to_worlds)
    torch.testing.assert_close(found.get_intrinsics_matrices(), expected.get_intrinsics_matrices())


@pytest.mark.parametrize("what", ["folder", "config", "checkpoints"])
def test_points_lie_where_the_run_renders_them(tiny: Any, tmp_path: Path, what: str) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["bands", str(getattr(tiny, what)), "-o", str(tmp_path), "--keep-ratio", "0.5", "--view", "2"])
    assert caught.value.code == 0
    result = json.loads((tmp_path / "bands.json").read_text())
    assert result["seen_from"] == "training view 2"
    assert result["primitives"] == result["bands"][0]["kept"]["high"] + result["bands"][0]["kept"]["low"]
    assert set(os.listdir(tmp_path)) == {*result["files"], "bands.json"}
    with Image.open(tmp_path / "bands-0.5.png") as sheet:
        assert len(np.unique(np.asarray(sheet).reshape(-1, 3), axis=0)) > 100


def test_a_view_that_is_not_there(tiny: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["bands", str(tiny.folder), "-o", str(tmp_path), "--view", "12"])
    assert caught.value.code == 2
    assert "the run has 12, from 0 on" in capsys.readouterr().err
