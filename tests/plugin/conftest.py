"""Ranks that run the checks of a file, models of Gaussians made in memory, and a small capture to parse."""

import json
import shutil
from pathlib import Path

import pytest
from forked import run
from models import *  # noqa: F403
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

from harness.still_life import write_still_life
from sundae_ns.plugin.datamanager import SundaeDatamanagerConfig

RANKS = 2
LIMIT = 600  # Seconds that a program may take on a busy machine


@pytest.fixture(scope="session")
def run_ranks():
    """Run the checks of a file on two ranks, which write their results into a folder; a missing one fails by name."""
    return lambda file, folder: print(run(Path(__file__).with_name("rank.py"), file, RANKS, folder, LIMIT)[1])


@pytest.fixture(scope="session")
def passed():
    """Assert that every rank has passed a check."""

    def check(folder, name):
        for path in (folder / f"rank{rank}.json" for rank in range(RANKS)):
            results = json.loads(path.read_text()) if path.exists() else {}
            assert results.get(name, "not reached") == "", f"{path.stem}: {results.get(name)}"

    return check


@pytest.fixture(scope="session")
def still_life(tmp_path_factory):
    out = tmp_path_factory.mktemp("still_life") / "scene"
    return write_still_life(out, train_views=10, test_views=2, width=24, height=24, points=80)


@pytest.fixture
def capture(still_life, tmp_path):
    return Path(shutil.copytree(still_life, tmp_path / "capture"))


@pytest.fixture
def load():
    """Parses a capture as ``ns-train`` does, with nerfstudio's parser replaced by ours."""

    def parse(data, *, colmap=None, robust=True, manager=None, **options):
        if colmap is None:
            parser = NerfstudioDataParserConfig(load_3D_points=True, **options)
        else:
            parser = ColmapDataParserConfig(colmap_path=Path(colmap), downscale_factor=1, **options)
        more = {"cache_images_type": "uint8", "robust_frame": robust, **(manager or {})}
        return SundaeDatamanagerConfig(data=data, dataparser=parser, **more).setup(device="cpu", test_mode="val")

    return parse


@pytest.fixture
def edit():
    """Changes entries of a ``transforms.json``; None removes one."""

    def change(data, **changes):
        meta = {**json.loads((data / "transforms.json").read_text()), **changes}
        (data / "transforms.json").write_text(json.dumps({k: v for k, v in meta.items() if v is not None}))

    return change
