"""The commands of ``sundae run``, in a folder with photos."""

import sys
from pathlib import Path

import pytest
from fake_colmap import FakeColmap
from run_commands import PHOTOS, Commands, photo
from short_prunes import short_prunes  # noqa: F401


@pytest.fixture(autouse=True)
def _short(short_prunes):  # noqa: F811
    """No test here is about how good a prune is."""


@pytest.fixture
def commands(tmp_path, monkeypatch):
    """The commands, in a folder with photos."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photos").mkdir()
    for index in range(PHOTOS):
        photo(Path("photos", f"{index}.JPG"))
    made = Commands()
    for module in ("run", "train"):
        monkeypatch.setattr(f"sundae_ns.cli.{module}.run_command", made)
    monkeypatch.setattr("sundae_ns.cli.run.has_gpu", lambda: made.gpu)
    monkeypatch.setitem(sys.modules, "pycolmap", FakeColmap())
    return made
