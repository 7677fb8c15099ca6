"""Which run a command of nerfstudio opens."""

from __future__ import annotations

from pathlib import Path

import pytest

from sundae_ns.train.progress import loaded_run


@pytest.mark.parametrize(
    "words",
    [["--load-config", "{}"], ["--load_config", "{}"], ["--load-config={}"], ["camera-path", "--load-config={}"]],
)
@pytest.mark.parametrize("program", ["ns-eval", "/usr/bin/ns-render", "ns-viewer", "ns-export"])
def test_the_folder_of_the_config(tmp_path: Path, program: str, words: list[str]) -> None:
    path = tmp_path / "run" / "config.yml"
    words = [word.format(path) for word in words]
    assert loaded_run([program, *words]) is None, "there is no such file"
    path.parent.mkdir()
    path.touch()
    assert loaded_run([program, *words]) == path.parent


def test_a_training_writes_where_it_is_told(tmp_path: Path) -> None:
    path = tmp_path / "config.yml"
    path.touch()
    assert loaded_run(["ns-train", "sundae", "--load-config", str(path)]) is None
    assert loaded_run(["sundae", "report", str(path)]) is None
    assert loaded_run(["ns-eval", "--load-config"]) is None
    assert loaded_run(["ns-eval", "--output-path", str(path)]) is None
    assert loaded_run([]) is None
