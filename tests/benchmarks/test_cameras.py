"""Training cameras of a run from its ``config.yml`` and capture; ``test_bands.py`` compares them with nerfstudio's."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
import yaml
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from ray_tracing import write_still_life

from harness.cameras import training_cameras
from sundae_ns.errors import CheckpointError, DataError
from sundae_ns.method_configs import sundae


def saved(folder: Path, parser: DataParserConfig, data: Path | None) -> Path:
    """A ``config.yml`` with this parser and capture."""
    config: Any = copy.deepcopy(sundae.config)
    config.pipeline.datamanager.dataparser = parser
    config.pipeline.datamanager.data = data
    path = folder / "config.yml"
    path.write_text(yaml.dump(config))
    return path


@pytest.mark.parametrize("where", ["datamanager", "parser"])
def test_the_capture_that_the_run_names_is_read(tmp_path: Path, where: str) -> None:
    scene = write_still_life(tmp_path / "scene", train_views=3, test_views=1, width=16, height=16, points=20, samples=1)
    here = where == "datamanager"
    parser = NerfstudioDataParserConfig() if here else NerfstudioDataParserConfig(data=scene)
    assert len(training_cameras(saved(tmp_path, parser, scene if here else None))) == 3


@pytest.mark.parametrize(
    ("parser", "data", "message"),
    [
        (BlenderDataParserConfig(), "gone", "another layout"),
        (NerfstudioDataParserConfig(), "gone", "does not exist"),
        (ColmapDataParserConfig(), "gone", "does not exist"),
        (NerfstudioDataParserConfig(), ".", "transforms.json"),
        (ColmapDataParserConfig(), None, "does not say where"),
    ],
)
def test_a_capture_that_cannot_be_read(
    tmp_path: Path, parser: DataParserConfig, data: str | None, message: str
) -> None:
    path = saved(tmp_path, parser, None if data is None else tmp_path / data)
    with pytest.raises(DataError, match=message) as caught:
        training_cameras(path)
    assert "\n" not in str(caught.value)


def test_a_missing_configuration(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="cannot be read"):
        training_cameras(tmp_path / "config.yml")
