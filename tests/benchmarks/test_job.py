"""One job of a comparison: what it refuses before it trains, and how its process says so."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path

import pytest
import torch

from harness import job as jobs
from harness.plan import Job, done_file, job_folder
from sundae_ns.errors import BackendError, CheckpointError, DataError


def a_job(kind: str = "branch", needs: str | None = "warm", method: str = "sundae-tiny") -> Job:
    return Job("a", kind, "still-life", "an-arm", "data", method, 10, 42, 0.25, needs)  # type: ignore[arg-type]


def test_a_result_is_whole_missing_or_said_to_be_damaged(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    assert jobs.read_result(path) is None
    path.write_text('{"measured": {"primitives": 3}}')
    assert jobs.read_result(path) == {"measured": {"primitives": 3}}
    for text in ('{"measured"', "", "[1]", "3"):
        path.write_text(text)
        with pytest.raises(CheckpointError, match="remove it, and the job is done again"):
            jobs.read_result(path)


def test_what_a_job_needs_has_to_be_done_first(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"warm.*not done; run the whole plan"):
        jobs.train_and_measure(a_job("branch"), tmp_path)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device here")
def test_stock_splatfacto_needs_a_gpu(tmp_path: Path) -> None:
    with pytest.raises(BackendError, match="an-arm needs a CUDA device.*--arms"):
        jobs.train_and_measure(a_job("whole", None, "splatfacto"), tmp_path)


def test_a_job_that_is_done_is_not_done_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jobs, "train_and_measure", lambda *_: {"measured": {}})
    jobs.perform(a_job(), tmp_path)
    monkeypatch.setattr(jobs, "train_and_measure", lambda *_: pytest.fail("done twice"))
    jobs.perform(a_job(), tmp_path)
    assert jobs.read_result(done_file(tmp_path, "a")) == {"measured": {}}


def test_its_process_ends_with_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = job_folder(tmp_path, "a")
    folder.mkdir(parents=True)
    (folder / "job.json").write_text(json.dumps(asdict(a_job())))

    def broken(job: Job, out: Path) -> None:
        assert (job, out) == (a_job(), tmp_path)
        raise DataError("the capture is gone; say where it is")

    monkeypatch.setattr(jobs, "perform", broken)
    monkeypatch.setattr(sys, "argv", ["job.py", str(tmp_path), "a"])
    with pytest.raises(SystemExit) as raised:
        jobs.main()
    assert raised.value.code == 2
    assert capsys.readouterr().err == "sundae: the capture is gone; say where it is\n"
