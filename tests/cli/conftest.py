"""Photos and a COLMAP that is a fake, and the commands that ``sundae run`` and ``sundae train`` start."""

import sys
from pathlib import Path

import pytest
from fake_colmap import FakeColmap
from run_commands import PHOTOS, Commands, photo

from sundae_ns.io import run_folder


@pytest.fixture(autouse=True)
def _short(short_prunes):
    """No test here is about how good a prune is."""


@pytest.fixture
def colmap(tmp_path, monkeypatch):
    """pycolmap, in a folder with photos and with an empty capture, ``scene``."""
    monkeypatch.chdir(tmp_path)
    Path("photos").mkdir()
    for index in range(PHOTOS):
        photo(Path("photos", f"{index}.JPG"))
    Path("scene").mkdir()
    Path("scene/transforms.json").touch()
    made = FakeColmap()
    monkeypatch.setitem(sys.modules, "pycolmap", made)
    monkeypatch.setattr(run_folder, "_held", {})
    return made


@pytest.fixture
def commands(colmap, monkeypatch):
    """The commands, in the folder with photos."""
    made = Commands()
    for module in ("run", "train"):
        monkeypatch.setattr(f"sundae_ns.cli.{module}.run_command", made)
    monkeypatch.setattr("torch.cuda.is_available", lambda: made.gpu)
    return made
