"""Paths of a COLMAP model's images, which nerfstudio writes into lines of a shell; fuzz/ has damaged models."""

from __future__ import annotations

from pathlib import Path

import pytest
from colmap_models import write_model

from sundae_ns.data import check_colmap
from sundae_ns.errors import DataError


@pytest.mark.parametrize(
    ("name", "fits"), [("my photos (2)", True), ("-a;b&c", True), ("a$(touch PWNED)", False), ('a"b', False)]
)
def test_no_folder_ends_a_word_of_a_shell(tmp_path: Path, name: str, fits: bool) -> None:
    images = tmp_path / name / "images"
    images.mkdir(parents=True)
    (images / "a.png").touch()
    write_model(tmp_path / name / "sparse" / "0", ["a.png"], (48, 48))
    if fits:
        check_colmap(images.parent / "sparse" / "0", images)
        return
    with pytest.raises(DataError, match="rename the folder"):
        check_colmap(images.parent / "sparse" / "0", images)
    check_colmap(images.parent / "sparse" / "0", None)  # a viewer reads no image
