"""The record: its commands are those of the benchmarks, in order; it goes on where it was stopped."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
from rich.console import Console

from harness import record as module
from harness.record import RecordOptions, record, steps_of
from sundae_ns.errors import DataError, SundaeError

FOLDER = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def options(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RecordOptions:
    for name in ("a", "b"):
        (tmp_path / "captures" / name / "sparse/0").mkdir(parents=True)
    (tmp_path / "results").mkdir()
    monkeypatch.setattr(module, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(module.shutil, "which", lambda name: None)
    return RecordOptions(folder=tmp_path / "captures", out=tmp_path / "out")


class Programs:
    """Stands for the commands; ``broken`` ends the one of that name."""

    def __init__(self, broken: BaseException | None = None, at: str = "") -> None:
        self.ran: list[str] = []
        self.broken, self.at = broken, at

    def __call__(self, words: Sequence[str], log: Path) -> None:
        self.ran.append(log.stem)
        if words[-2] == "-o":
            with Path(words[-1]).open("a") as file:
                file.write(f"{log.stem}\n")
        if self.broken is not None and log.stem == self.at:
            raise self.broken


def test_commands_are_those_of_the_scripts(tmp_path: Path) -> None:
    steps = steps_of([tmp_path / "captures" / "a"], tmp_path, others=True)
    assert len({step.name for step in steps}) == len(steps)
    for step in steps:
        assert Path(step.words[1]).is_file(), step
    (formats,) = (step for step in steps if step.name == "a-formats-splatfacto")
    assert formats.words[2] == str(tmp_path / "others/jobs/a-splatfacto-s42/splatfacto/splatfacto/run")
    assert formats.words[3:5] == ("--splat-transform", "splat-transform")
    (few,) = (step for step in steps if step.name == "a-curve")
    assert few.words[:2] == (sys.executable, str(FOLDER / "quality.py"))
    assert "--splat-transform" not in str(steps_of([tmp_path / "a"], tmp_path, others=False))


def test_what_is_done_is_not_run_again(options: RecordOptions) -> None:
    stopped = Programs(KeyboardInterrupt(), at="a-prune")
    assert record(options, stopped) == 130
    assert stopped.ran[:3] == ["default", "others", "a-curve"]
    assert stopped.ran[-1] == "a-prune"
    rest = Programs()
    assert record(options, rest) == 0
    assert rest.ran[0] == "a-prune"
    assert rest.ran[-2:] == ["tables.py", "plot.py"]
    nothing = Programs()
    assert record(options, nothing) == 0
    assert nothing.ran == ["tables.py", "plot.py"]
    results = options.folder.parent / "results"
    # The one that was stopped had begun to write.
    assert (results / "prune.csv").read_text().split() == ["a-prune", "a-prune", "b-prune"]


def test_a_failure_leaves_the_others(options: RecordOptions, capsys: pytest.CaptureFixture[str]) -> None:
    programs = Programs(SundaeError("python failed with 1; its log is x, which ends with:\nno GPU"), at="a-prune")
    assert record(options, programs) == 1
    assert programs.ran[-1] == "plot.py"
    assert "a-prune failed: no GPU" in capsys.readouterr().out
    results = options.folder.parent / "results"
    assert (results / "formats.csv").is_file()
    assert not (results / "prune.csv").exists()  # a part of a table is none
    again = Programs()
    assert record(options, again) == 0
    assert again.ran[0] == "a-prune"
    assert (results / "prune.csv").read_text().split() == ["a-prune", "b-prune", "a-prune"]


def test_the_list_says_what_is_done(options: RecordOptions) -> None:
    record(options, Programs(SundaeError("no"), at="b-curve"))
    console = Console(record=True, width=1000)
    listed = RecordOptions(folder=options.folder, out=options.out, list=True)
    assert record(listed, Programs(), console) == 0
    lines = console.export_text().splitlines()
    assert [line.startswith("done") for line in lines].count(False) == 1
    assert all("benchmarks" in line for line in lines)


def test_a_folder_without_captures_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="holds no capture; give the folder that holds the captures"):
        record(RecordOptions(folder=tmp_path, out=tmp_path / "out"))
