"""The kind of a file follows from its first bytes, not from its name."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from sundae_ns.errors import CheckpointError
from sundae_ns.gaussians import from_points
from sundae_ns.storage.formats import kind_of, refuse
from sundae_ns.storage.pack import PackedScene, write_scene
from sundae_ns.storage.ply import write_ply


@pytest.fixture
def files(tmp_path: Path) -> Path:
    field = from_points(torch.rand(4, 3), torch.rand(4, 3), sh_degree=0, num_features=0)
    write_scene(tmp_path / "packed.ply", PackedScene(field))
    write_ply(tmp_path / "points.sundae", field)
    (tmp_path / "dos.txt").write_bytes(b"ply\r\nformat")
    (tmp_path / "word.ply").write_text("plywood")
    (tmp_path / "empty.sundae").touch()
    return tmp_path


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("packed.ply", "packed"),
        ("points.sundae", "ply"),
        ("dos.txt", "ply"),
        ("word.ply", None),
        ("empty.sundae", None),
        ("missing.sundae", None),
        (".", None),
    ],
)
def test_kinds(files: Path, name: str, kind: str | None) -> None:
    assert kind_of(files / name) == kind


def test_only_kinds_with_advice_are_refused(files: Path) -> None:
    with pytest.raises(CheckpointError, match=r"packed\.ply is a packed scene; unpack it$"):
        refuse(files / "packed.ply", packed="unpack it")
    with pytest.raises(CheckpointError, match=r"points\.sundae is a \.ply file; give a run$"):
        refuse(files / "points.sundae", packed="unpack it", primitives="give a run")
    refuse(files / "points.sundae", packed="unpack it")
    refuse(files / "word.ply", packed="unpack it", primitives="give a run")
