"""Reading config.yml without running it."""

from __future__ import annotations

from pathlib import Path

import pytest

from sundae_ns.errors import CheckpointError, DataError
from sundae_ns.storage.runs.folder import CLASS, find_config, prunes_before, read_config, training_cameras

PIPELINE = "pipeline: !!python/object:some.Pipeline\n  datamanager: null\n"


def test_objects_become_plain_values_and_nothing_is_run(tmp_path: Path) -> None:
    mark = tmp_path / "ran"
    path = tmp_path / "config.yml"
    path.write_text(
        "!!python/object:not.there.Config\n"
        f"a: !!python/object/apply:os.mkdir ['{mark}']\n"
        f"b: !!python/object/new:os.mkdir\n  args: ['{mark}']\n"
        "c: !!python/name:os.system ''\n"
        "d: !!python/module:this ''\n"
        "e: &path !!python/object/apply:pathlib.PosixPath [a, b]\n"
        "f: *path\n"
        "g: !!python/tuple [1, 2.5, true]\n" + PIPELINE
    )
    found = read_config(path)
    assert not mark.exists()
    assert found["a"] == [str(mark)]
    assert found["b"][CLASS] == "object/new:os.mkdir"
    assert found["c"] == "name:os.system"
    assert found["e"] == found["f"] == ["a", "b"]
    assert found["g"] == [1, 2.5, True]
    assert (found[CLASS], found["pipeline"][CLASS]) == ("object:not.there.Config", "object:some.Pipeline")
    with pytest.raises(DataError, match="another layout"):
        training_cameras(found)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "3",
        "- 1",
        "a: 1",
        "pipeline: 3",
        "a: [",
        "a: !unknown 3\n" + PIPELINE,
        "\x00",
        "a: 99-99-99 1:1\n- x",
        "a: 2024-99-99\n" + PIPELINE,
        "[1]: 2\n" + PIPELINE,
        "? {a: 1}\n: 2\n" + PIPELINE,
        "[" * 3000,
        "!!python/object:a.B\n<<: 3\n" + PIPELINE,
    ],
)
def test_what_is_no_configuration_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "config.yml"
    path.write_text(text)
    with pytest.raises(CheckpointError, match=r"config\.yml.*; give a run's folder") as caught:
        read_config(path)
    assert "\n" not in str(caught.value)


def test_bytes_that_are_no_text_and_files_that_are_not_there(tmp_path: Path) -> None:
    (tmp_path / "config.yml").write_bytes(b"\xff\xfe\x80")
    with pytest.raises(CheckpointError, match="is not a run's"):
        read_config(tmp_path / "config.yml")
    with pytest.raises(CheckpointError, match="cannot be read"):
        read_config(tmp_path / "gone.yml")
    with pytest.raises(CheckpointError, match="cannot be read"):
        read_config(tmp_path)


def test_the_configuration_is_found_from_anywhere_in_its_run(tmp_path: Path) -> None:
    run = tmp_path / "run"
    folder = run / "nerfstudio_models"
    folder.mkdir(parents=True)
    (folder / "step-000000001.ckpt").touch()
    places = (run, folder, folder / "step-000000001.ckpt", run / "config.yml")
    assert [find_config(place) for place in places] == [None] * 4
    (run / "config.yml").touch()
    assert [find_config(place) for place in places] == [run / "config.yml"] * 4
    assert find_config(tmp_path) is None
    assert find_config(tmp_path / "gone") is None


def test_earlier_prunes_are_kept_and_what_cannot_be_read_is_set_aside(tmp_path: Path) -> None:
    path = tmp_path / "prune.json"
    assert prunes_before(path, 5) == []
    path.write_text('[{"step": 3, "before": 9}, {"step": 7}]')
    assert prunes_before(path, 7) == [{"step": 3, "before": 9}]
    assert path.exists()
    for text in ('[{"step": 3', "", '"step"', "3", '[{"before": 9}]', "[3]", '[{"step": "3"}]'):
        path.write_text(text)
        assert prunes_before(path, 7) == []
        assert not path.exists()
        assert (tmp_path / "prune.damaged.json").read_text() == text


@pytest.mark.parametrize(
    ("parser", "message"),
    [
        ("nerfstudio.BlenderDataParserConfig", "another layout"),
        ("evil.NerfstudioDataParserConfig\n      _target: !!python/name:os.system ''", "does not exist"),
    ],
)
def test_a_capture_of_another_layout_or_that_is_gone(tmp_path: Path, parser: str, message: str) -> None:
    path = tmp_path / "config.yml"
    data = f"!!python/object/apply:pathlib.PosixPath ['{tmp_path / 'gone'}']"
    path.write_text(
        f"data: {data}\npipeline:\n  datamanager:\n    dataparser: !!python/object:{parser}\n      scale_factor: 1.0\n"
    )
    with pytest.raises(DataError, match=message):
        training_cameras(read_config(path))
    path.write_text("pipeline:\n  datamanager:\n    dataparser: !!python/object:a.ColmapDataParserConfig {}\n")
    with pytest.raises(DataError, match="does not say where"):
        training_cameras(read_config(path))
