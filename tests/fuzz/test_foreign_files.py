"""Bad files of other programs: .splat, .ksplat, compressed .ply, colours in a .ply, checkpoints of gsplat."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from foreign_files import FOREIGN, small_field

from sundae_ns.storage.formats import read_primitives


@pytest.mark.parametrize("name", FOREIGN)
@pytest.mark.seeds(20)
def test_corrupted_files(corrupted: Any, verdict: Any, tmp_path: Path, name: str, seed: int) -> None:
    FOREIGN[name](tmp_path / name, small_field())
    path = tmp_path / f"corrupted-{name}"
    path.write_bytes(corrupted((tmp_path / name).read_bytes(), seed))
    verdict(lambda: read_primitives(path), path.stat().st_size)
