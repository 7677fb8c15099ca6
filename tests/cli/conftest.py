"""The commands of ``sundae run``, in a folder with photos."""

from __future__ import annotations

from pathlib import Path

import pytest
from run_commands import PHOTOS, Commands, photo, program


@pytest.fixture
def commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Commands:
    """The commands, in a folder with photos, on a machine with COLMAP and ffmpeg."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photos").mkdir()
    for index in range(PHOTOS):
        photo(Path("photos", f"{index}.JPG"))
    program(tmp_path, "colmap", "COLMAP 3.9 (without CUDA)")
    program(tmp_path, "ffmpeg", "")
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    made = Commands()
    monkeypatch.setattr("sundae_ns.cli.run.run_in_group", made)
    monkeypatch.setattr("sundae_ns.cli.run.measured_step", made.measured)
    return made
