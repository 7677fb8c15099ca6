"""The queue of ``benchmarks/jobs.py``, with commands that take no time."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).parents[1] / "benchmarks"
RunJobs = Callable[..., int]


@pytest.fixture
def run_jobs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RunJobs:
    monkeypatch.syspath_prepend(str(FOLDER))
    import jobs

    def run(lines: list[dict[str, Any]], *options: str) -> int:
        file = tmp_path / "jobs.jsonl"
        file.write_text("".join(json.dumps(line) + "\n" for line in lines))
        monkeypatch.setattr(sys, "argv", ["jobs.py", str(file), "--state", str(tmp_path / "state"), *options])
        return jobs.main()

    return run


def noting(path: Path, name: str, *, between: str = "sleep 0.3") -> dict[str, Any]:
    """A job that notes when it begins, on which GPU, and when it ends."""
    command = f"echo {name} begins on $CUDA_VISIBLE_DEVICES >> {path}; {between}; echo {name} ends >> {path}"
    return {"name": name, "command": command}


def test_in_order_as_many_as_fit_and_never_twice(run_jobs: RunJobs, tmp_path: Path) -> None:
    notes = tmp_path / "notes"
    lines = [noting(notes, name) for name in "abc"]
    assert run_jobs(lines, "--gpus", "3") == 0
    assert notes.read_text().split("\n") == [f"{n} {what}" for n in "abc" for what in ("begins on 3", "ends")] + [""]
    assert run_jobs([*lines, noting(notes, "d")], "--gpus", "3") == 0
    assert notes.read_text().count("begins") == 4
    assert (tmp_path / "state" / "logs" / "a.log").exists()


def test_two_gpus_share_the_work(run_jobs: RunJobs, tmp_path: Path) -> None:
    notes = tmp_path / "notes"
    assert run_jobs([noting(notes, name) for name in "abcd"], "--gpus", "0", "1", "--per-gpu", "2") == 0
    begun = [line for line in notes.read_text().splitlines() if "begins" in line]
    assert sorted(line[-1] for line in begun) == ["0", "0", "1", "1"]


def test_what_is_needed_comes_first(run_jobs: RunJobs, tmp_path: Path) -> None:
    notes, file = tmp_path / "notes", tmp_path / "made"
    after = {**noting(notes, "after"), "needs": ["maker", str(file)]}
    assert run_jobs([after, noting(notes, "maker", between=f"touch {file}")], "--per-gpu", "2") == 0
    assert [line.split()[0] for line in notes.read_text().splitlines()] == ["maker"] * 2 + ["after"] * 2


def test_alone_is_alone(run_jobs: RunJobs, tmp_path: Path) -> None:
    notes = tmp_path / "notes"
    alone = {**noting(notes, "timed"), "alone": True, "gpu": 0, "needs": ["a"]}
    lines = [noting(notes, "a"), noting(notes, "b", between="sleep 1"), alone, noting(notes, "c"), noting(notes, "d")]
    assert run_jobs(lines, "--per-gpu", "2") == 0
    events = [line.split()[:2] for line in notes.read_text().splitlines()]
    place = events.index(["timed", "begins"])
    assert events[place + 1] == ["timed", "ends"]
    assert sorted(events[:place]) == [[n, what] for n in "ab" for what in ("begins", "ends")]


def test_alone_anywhere_keeps_its_place(run_jobs: RunJobs, tmp_path: Path) -> None:
    notes = tmp_path / "notes"
    lines = [noting(notes, "a"), {**noting(notes, "timed"), "alone": True}, *(noting(notes, name) for name in "bcd")]
    lines[1]["needs"] = [str(notes)]  # once the first has begun
    assert run_jobs(lines, "--per-gpu", "2") == 0
    events = [line.split()[:2] for line in notes.read_text().splitlines()]
    place = events.index(["timed", "begins"])
    assert events[place + 1] == ["timed", "ends"]
    assert ["c", "begins"] not in events[:place]


def test_a_gpu_that_is_not_there_is_refused(run_jobs: RunJobs) -> None:
    with pytest.raises(SystemExit, match=r"x is to run on GPU 3, which is not of --gpus; add it there"):
        run_jobs([{"name": "x", "command": "true", "gpu": 3}], "--gpus", "0", "1")


def test_a_failure_is_told_and_what_needs_it_left_out(
    run_jobs: RunJobs, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = [
        {"name": "bad", "command": "exit 3"},
        {"name": "lost", "command": "true", "needs": ["bad"]},
        {"name": "good", "command": "true"},
    ]
    assert run_jobs(lines) == 1
    out = capsys.readouterr().out
    assert "bad failed (3)" in out
    assert "lost is left out" in out
    assert [path.name for path in (tmp_path / "state" / "done").iterdir()] == ["good"]


def test_the_end_of_the_time_ends_them_with_all_they_have_started(
    run_jobs: RunJobs, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    notes = tmp_path / "notes"
    lines = [noting(notes, "endless", between="sh -c 'sleep 600'"), {"name": "long", "command": "true", "seconds": 500}]
    assert run_jobs(lines, "--seconds", "2") == 1
    assert notes.read_text() == "endless begins on 0\n"
    out = capsys.readouterr().out
    assert "endless was ended" in out
    assert "long is left out" in out


def test_what_nobody_makes_is_not_waited_for(run_jobs: RunJobs, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_jobs([{"name": "lonely", "command": "true", "needs": ["/nowhere/at/all"]}]) == 1
    assert "nothing makes what these need: lonely" in capsys.readouterr().out


def test_branches_without_a_line_are_jobs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(str(FOLDER))
    import rules

    results = tmp_path / "rules.jsonl"
    line = {"scene": "s", "method": "sundae", "steps": 7, "rule": "random", "keep": 0.1, "seed": 0, "warmup": 15000}
    results.write_text(json.dumps(line) + "\n")
    options = "--scene s --steps 7 --keep 0.1 0.01 --rules random paper --rows - --missing".split()
    options += ["--data", str(tmp_path), "--out", str(tmp_path / "out"), "--results", str(results)]
    monkeypatch.setattr(sys, "argv", ["rules.py", *options])
    rules.main()
    first, *others = [json.loads(job) for job in capsys.readouterr().out.splitlines()]
    assert [job["name"] for job in (first, *others)] == ["s-0.1-paper-0", "s-0.01-random-0", "s-0.01-paper-0"]
    assert first["needs"] == []
    assert all(job["needs"] == [str(tmp_path / "out" / "s" / "sundae-15000.ckpt")] for job in others)
    # Those that can be are one job, where that is asked for.
    monkeypatch.setattr(sys, "argv", ["rules.py", *options, "--abreast", "4"])
    rules.main()
    together = [json.loads(job) for job in capsys.readouterr().out.splitlines()]
    assert [job["name"] for job in together] == ["s-0.1-paper-0", "s-0.01-random-0-and-1"]
    # What a job runs is that branch and no other.
    monkeypatch.setattr(sys, "argv", others[0]["command"].split()[1:] + ["--list"])
    rules.main()
    branch = json.loads(capsys.readouterr().out)
    assert (branch["rule"], branch["keep"], branch["seed"]) == ("random", 0.01, 0)
