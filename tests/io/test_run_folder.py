"""The folder of a run: one process trains in it, and damaged records of prunes do not end a training."""

import json
import os

import pytest

from sundae_ns.core.errors import StorageError
from sundae_ns.core.files import locked
from sundae_ns.io.config_file import find_config
from sundae_ns.io.run_folder import LOCK, files_of, new_name, prunes_before, prunes_of, reserve, take_records


def test_the_configuration_is_found_from_any_path_of_its_run(tmp_path):
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


def test_a_folder_belongs_to_one_process_until_it_ends(tmp_path):
    run = tmp_path / "runs" / "a"
    left = ("config.yml.17.partial", "models/partial--1.17.tmp", "config.yml", "models/step-000000001.ckpt")
    (run / "models").mkdir(parents=True)
    roundabout = tmp_path / "runs" / ".." / "runs" / "a"
    with (run / LOCK).open("w") as other:
        assert locked(other)
        print("process 7 on a node", file=other, flush=True)
        with pytest.raises(StorageError, match=f"^process 7 on a node trains in {run}; .*--timestamp$"):
            reserve(roundabout)
        for name in left:
            (run / name).touch()
    reserve(run)
    reserve(roundabout)  # its own folder
    with (run / LOCK).open() as ours:
        assert ours.read().startswith(f"process {os.getpid()} on ")
        assert locked(ours) is False
    assert {path for path in run.rglob("*") if path.is_file()} == {run / name for name in (LOCK, *left[2:])}


def test_parts_of_a_run(tmp_path):
    (tmp_path / "config.yml").touch()
    (tmp_path / "a.ply").touch()
    assert files_of(tmp_path) == files_of(tmp_path / "config.yml")
    assert tmp_path / "nerfstudio_models" in files_of(tmp_path)
    assert files_of(tmp_path / "a.ply") == [tmp_path / "a.ply"]
    assert len({new_name() for _ in range(100)}) == 100, "runs of the same second have different names"


def test_records_follow_a_resumed_run(tmp_path):
    old = tmp_path / "old"
    old.mkdir()
    take_records(old, tmp_path / "none", 9)  # there are none
    (old / "prune.json").write_text('[{"step": 3, "after": 9}, {"step": 5, "after": 4}, {"step": 8, "after": 2}]')
    assert prunes_before(old / "prune.json", 8) == prunes_of(old)[:2]
    assert prunes_before(tmp_path / "prune.json", 5) == prunes_of(tmp_path) == []
    for step, prunes in ((2, []), (5, [3, 5]), (8, [3, 5, 8])):
        new = tmp_path / f"resumed-after-{step}"
        new.mkdir()
        take_records(old, new, step)
        assert [record["step"] for record in prunes_of(new)] == prunes
    (new / "prune.json").write_text("[]")
    take_records(old, new, 8)
    assert prunes_of(new) == []  # its own record


DAMAGED = ("[", "[" * 100_000, "", "3", '"step"', "[3]", "\x00", '{"before": 9}', '[{"step": 3}, 3]')


@pytest.mark.parametrize("text", [*DAMAGED, '[{"before": 9}]', '[{"step": "3"}]'])
def test_damaged_records_end_no_training(tmp_path, text):
    path = tmp_path / "prune.json"
    path.write_text(text)
    assert prunes_of(tmp_path) == ([] if text in DAMAGED else json.loads(text))
    take_records(tmp_path, tmp_path / "none", 9)
    assert not (tmp_path / "none").exists()
    assert path.read_text() == text
    assert prunes_before(path, 7) == []
    assert [(left.name, left.read_text()) for left in tmp_path.iterdir()] == [("prune.damaged.json", text)]
