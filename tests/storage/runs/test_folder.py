"""The folder of a run: its ``config.yml`` is found, and damaged records of prunes do not end a training."""

from __future__ import annotations

from pathlib import Path

from sundae_ns.storage.runs.folder import find_config, prunes_before, prunes_of


def test_the_configuration_is_found_from_any_path_of_its_run(tmp_path: Path) -> None:
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


def test_earlier_records_are_kept_and_a_damaged_file_is_renamed(tmp_path: Path) -> None:
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


def test_records_of_a_finished_run_are_read_whole_or_not_at_all(tmp_path: Path) -> None:
    assert prunes_of(tmp_path) == []
    (tmp_path / "prune.json").write_text('[{"before": 9, "after": 3}]')
    assert prunes_of(tmp_path) == [{"before": 9, "after": 3}]
    for text in ("[", "3", '{"before": 9}', "[3]", '[{"before": 9}, 3]', "\x00"):
        (tmp_path / "prune.json").write_text(text)
        assert prunes_of(tmp_path) == []
        assert (tmp_path / "prune.json").read_text() == text
