"""Bad input: a reader either succeeds or fails with a one-line error, quickly and in little memory.

Each kind of input has one file ``test_<kind>.py``. It takes a valid input made by the package, damages it by hypothesis
(``damage``) or by hand, and judges each case by ``verdict``: 5 seconds, 300 MB and 20 bytes per byte. Before a release:

    python -m pytest tests/fuzz -k damaged --hypothesis-profile release --hypothesis-seed 0    # 5,000 of each kind
"""

import shutil
from pathlib import Path

import pytest
from colmap_models import write_model
from small_captures import HEIGHT, SIZE, VIEWS, WIDTH

from harness.still_life import write_still_life


@pytest.fixture(scope="session")
def scene(tmp_path_factory):
    out = tmp_path_factory.mktemp("capture") / "scene"
    return write_still_life(out, train_views=VIEWS, test_views=1, width=WIDTH, height=HEIGHT, points=40)


@pytest.fixture
def capture(scene, tmp_path):
    """A copy of the capture for one test, with a transforms.json and a COLMAP model."""
    copy = Path(shutil.copytree(scene, tmp_path / "scene"))
    write_model(copy / "sparse" / "0", sorted(path.name for path in (copy / "images").iterdir()), SIZE)
    return copy
