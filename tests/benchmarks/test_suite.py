"""``suite.py``: its plan, resuming, captures that are left out, its page, and jobs that share a GPU."""

from __future__ import annotations

import json
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from bench_jobs import Runner, measured
from csv_rows import read_rows
from PIL import Image
from rich.console import Console
from suite import ARMS as SUITE
from suite import SuiteOptions, find_captures, plan_suite, run_suite

from harness.alone import watched
from harness.arms import choose_arms
from harness.job import configure, fingerprint_of, without_times
from harness.plan import Job, done_file
from sundae_ns.errors import DataError

POSE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]
FRAME: dict[str, Any] = {
    "file_path": "images/a.png",
    "transform_matrix": POSE,
    "fl_x": 50,
    "fl_y": 50,
    "cx": 8,
    "cy": 8,
    "w": 16,
    "h": 16,
}
ARMS = ("splatfacto", "sundae", "sundae-no-head")


@pytest.fixture
def captures(tmp_path: Path) -> Path:
    """Two captures, a hidden folder and a file."""
    folder = tmp_path / "captures"
    for name in ("fox", "bonsai"):
        capture(folder / name)
    (folder / ".cache").mkdir()
    (folder / "README.md").touch()
    return folder


def capture(folder: Path, frames: int = 1) -> None:
    folder.mkdir(parents=True)
    (folder / "transforms.json").write_text(json.dumps({"frames": [FRAME] * frames}))
    (folder / "images").mkdir()
    Image.new("RGB", (FRAME["w"], FRAME["h"])).save(folder / FRAME["file_path"])


def suite(captures: Path, runner: Runner, **changed: Any) -> tuple[int, str]:
    text = StringIO()
    options: dict[str, Any] = {"arms": ARMS, "out": captures.parent / "out", **changed}
    console = Console(file=text, width=200, force_terminal=False)
    return run_suite(SuiteOptions(folder=captures, **options), runner=runner, console=console), text.getvalue()


def plan(captures: Path, **changed: Any) -> list[Job]:
    options = SuiteOptions(folder=captures, out=Path("out"), **changed)
    jobs, left_out = plan_suite(options, choose_arms(options.arms, options.method, from_scratch=True))
    assert left_out == {}
    return jobs


def lines_of(page: str, title: str) -> list[list[str]]:
    """Cells of the rows of the table below a title."""
    part = page.partition(f"## {title}\n")[2].partition("\n## ")[0]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in part.splitlines() if line.startswith("|")]
    return rows[2:]


# ----------------------------------------------------------------------------------------------------------------- plan


def test_the_default_plan(captures: Path) -> None:
    jobs = plan(captures)
    assert list(dict.fromkeys(job.scene for job in jobs)) == ["bonsai", "fox"]
    own = {job.arm: job for job in jobs if job.scene == "fox"}
    assert set(own) == {"sundae-warm-up", *SUITE}
    assert {arm: job.kind for arm, job in own.items()} == {
        **{arm: "branch" for arm in SUITE},
        **{arm: "whole" for arm in ("splatfacto", "sundae", "sundae-fast", "sundae-auto")},
        "sundae-warm-up": "warm-up",
    }
    assert [job.key for job in jobs if job.scene == "bonsai"][0] == "bonsai-sundae-warm-up-s42"
    # A method without options trains as its command does, so that its time is that of the command.
    assert own["sundae"].steps == own["splatfacto"].steps == own["sundae-auto"].steps == 30_000
    assert (own["sundae"].key, own["sundae-auto"].key) == ("fox-sundae-10pct-s42", "fox-sundae-auto-s42")


def test_a_method_trains_whole_at_every_share_and_repeated_seed(captures: Path, tmp_path: Path) -> None:
    jobs = plan(captures, scenes=("fox",), keep_ratios=(0.01, 0.1), seeds=(42, 43), arms=("sundae", "splatfacto"))
    wholes = [(job.arm, job.keep_ratio, job.seed) for job in jobs if job.kind == "whole"]
    assert sorted(wholes, key=str) == sorted(
        [
            *[("sundae", 0.01, 42), ("sundae", 0.1, 42), ("sundae", 0.1, 43)],
            *[("splatfacto", None, 42), ("splatfacto", None, 43)],
        ],
        key=str,
    )
    config, command = configure(next(job for job in jobs if job.keep_ratio == 0.01 and job.arm == "sundae"), tmp_path)
    assert "--pipeline.model.pruning.keep-ratio 0.01" in command
    assert "warm-start" not in command
    assert (config.pipeline.model.pruning.keep_ratio, config.max_num_iterations) == (0.01, 30_000)  # type: ignore[attr-defined]


def test_a_job_has_the_fingerprint_of_its_arm_and_share(captures: Path) -> None:
    jobs = plan(captures, keep_ratios=(0.01, 0.1), seeds=(42, 43), arms=("sundae", "sundae-no-head"))
    found: dict[Any, set[str]] = {}
    for job in jobs:
        found.setdefault((job.arm, job.keep_ratio), set()).add(fingerprint_of(job))
    assert all(len(own) == 1 for own in found.values()), found
    assert len(found) == len(set.union(*found.values())) == 5


def test_folders_that_hold_no_captures(captures: Path, tmp_path: Path) -> None:
    for folder, said in (
        (tmp_path / "gone", "no folder"),
        (captures / "fox", "is a capture itself"),
        (captures / ".cache", "holds no capture"),
    ):
        with pytest.raises(DataError, match=said):
            find_captures(folder)


# ---------------------------------------------------------------------------------------------------------- carried out


def test_stopped_and_continued(captures: Path) -> None:
    first, second, third = Runner(stop_after=4), Runner(), Runner()
    code, said = suite(captures, first)
    assert code == 130
    assert "the same command resumes" in said
    assert suite(captures, second)[0] == 0
    assert not set(first.ran) & set(second.ran)
    assert len(first.ran + second.ran) == 2 * (1 + len(ARMS))
    assert suite(captures, third)[0] == 0
    assert third.ran == []
    rows = read_rows(captures.parent / "out" / "results.csv")
    assert {(row.scene, row.variant) for row in rows} == {
        (scene, arm) for scene in ("fox", "bonsai") for arm in ("sundae-warm-up", *ARMS)
    }
    assert (suite(captures, third, jobs=True)[1]).count(" done |") == len(rows)


def test_several_commands_share_a_folder(captures: Path) -> None:
    suite(captures, Runner())
    again = Runner()
    assert suite(captures, again, scenes=("fox",), keep_ratios=(0.1, 0.3))[0] == 0
    assert again.ran == ["fox-sundae-no-head-30pct-s42", "fox-sundae-30pct-s42"]
    page = (captures.parent / "out" / "table.md").read_text()
    assert {(line[0], line[2]) for line in lines_of(page, "Packing")} == {
        *[("bonsai", "10%"), ("fox", "10%"), ("fox", "30%")]
    }


def test_shards_divide_the_captures_jobs(captures: Path) -> None:
    runners = [Runner(), Runner(), Runner()]
    for index, runner in enumerate(runners, start=1):
        assert suite(captures, runner, shard=f"{index}/3")[0] == 0
    ran = [key for runner in runners for key in runner.ran]
    assert len(ran) == len(set(ran)) == 2 * (1 + len(ARMS))


@pytest.mark.parametrize("kind", ["missing", "damaged", "no capture", "incomplete model"])
def test_a_capture_that_cannot_be_used_is_named_and_the_others_are_measured(captures: Path, kind: str) -> None:
    scenes: tuple[str, ...] = ()
    if kind == "missing":
        scenes, said = ("fox", "bonsai", "odd"), "odd is no folder"
    elif kind == "damaged":
        capture(captures / "odd", frames=0)
        said = "transforms.json lists no frames"
    elif kind == "no capture":
        (captures / "odd").mkdir()
        said = "odd is no capture: it has neither sparse/0 nor transforms.json"
    else:
        (captures / "odd" / "sparse" / "0").mkdir(parents=True)
        (captures / "odd" / "images").mkdir()
        for name in ("cameras", "images"):
            (captures / "odd" / "sparse" / "0" / f"{name}.bin").write_bytes(b"\1\0")
        said = "cameras.bin ends early"
    runner = Runner()
    code, printed = suite(captures, runner, scenes=scenes)
    assert code == 1
    assert "Left out: odd: " in printed
    assert said in printed
    assert len(runner.ran) == 2 * (1 + len(ARMS))
    page = (captures.parent / "out" / "table.md").read_text()
    assert "- odd: " in page
    assert said in page
    assert {line[0] for line in lines_of(page, "Training")} == {"fox", "bonsai"}
    assert suite(captures, Runner(), scenes=("fox", "bonsai"))[0] == 0


def test_a_capture_whose_first_job_fails_is_left_out(captures: Path) -> None:
    """As one that is too large for the GPU, or whose images cannot be decoded."""
    runner = Runner(broken="bonsai-sundae-warm-up")
    code, printed = suite(captures, runner)
    assert code == 1
    assert "Left out: bonsai" in printed
    assert {key.partition("-")[0] for key in runner.ran} == {"fox"}
    page = (captures.parent / "out" / "table.md").read_text()
    assert "- bonsai: it broke" in page
    assert {line[0] for line in lines_of(page, "Training")} == {"fox"}
    again = Runner()
    assert suite(captures, again)[0] == 0
    assert {key.partition("-")[0] for key in again.ran} == {"bonsai"}


def test_another_job_that_fails_leaves_out_itself(captures: Path) -> None:
    runner = Runner(broken="bonsai-splatfacto")
    code, _ = suite(captures, runner)
    assert code == 1
    assert len(runner.ran) == 2 * (1 + len(ARMS)) - 1
    assert "- bonsai-splatfacto-s42: it broke" in (captures.parent / "out" / "table.md").read_text()


def test_all_captures_may_be_left_out(captures: Path) -> None:
    code, printed = suite(captures, Runner(), scenes=("a", "b"))
    assert code == 1
    assert printed.count("Left out") == 2
    assert not (captures.parent / "out" / "table.md").exists()


# ------------------------------------------------------------------------------------------------------------- the page


def test_times_stand_beside_errors_and_are_of_trainings_from_scratch(captures: Path) -> None:
    suite(captures, Runner(), scenes=("fox",))
    page = (captures.parent / "out" / "table.md").read_text()
    training = lines_of(page, "Training")
    assert {line[1] for line in training} == {"splatfacto", "sundae"}
    sundae = next(line for line in training if line[1] == "sundae")
    assert sundae == ["fox", "sundae", "10%", "1", "30,000", "10", "26.00", "0.8000", "1,000", "-", "CPU"]
    packing = {line[1]: line for line in lines_of(page, "Packing")}
    assert set(packing) == {"sundae", "sundae-no-head"}
    assert packing["sundae"] == ["fox", "sundae", "10%", "1", "1,000", "0.05", "26.00", "24.90", "0.8000", "0.7500"]
    assert "`sundae`: `sundae` from scratch, 30,000 steps" in page
    assert "--finetune" not in page


def test_fine_tuned_packs_have_a_table_of_their_own(captures: Path) -> None:
    suite(captures, Runner(), scenes=("fox",))
    out = captures.parent / "out"
    path = done_file(out, "fox-sundae-10pct-s42")
    result = json.loads(path.read_text())
    result["tuned"] = {**result["packed"], "bytes": 30_000, "psnr": 24.8}
    path.write_text(json.dumps(result) + "\n")
    suite(captures, Runner(), scenes=("fox",))
    *_, row = lines_of((out / "table.md").read_text(), "Packing")
    assert row[1:] == ["sundae", "10%", "1", "1,000", "0.03", "26.00", "24.80", "0.8000", "0.7500"]


def test_a_job_that_shared_its_gpu_has_no_times(captures: Path) -> None:
    suite(captures, Runner(), scenes=("fox",))
    out = captures.parent / "out"
    path = done_file(out, "fox-sundae-10pct-s42")
    result = json.loads(path.read_text())
    job = next(job for job in plan(captures, scenes=("fox",), arms=ARMS) if job.key == result["job"]["key"])
    result["measured"], result["alone"] = without_times(measured(job)).as_json(), False
    path.write_text(json.dumps(result) + "\n")
    suite(captures, Runner(), scenes=("fox",))
    page = (out / "table.md").read_text()
    assert {line[1] for line in lines_of(page, "Training")} == {"splatfacto"}
    (row,) = [row for row in read_rows(out / "results.csv") if row.variant == "sundae"]
    assert (row.ms_frame, row.ms_splat, row.ms_head, row.train_s, row.prune_s) == (None,) * 5
    assert row.psnr is not None


def test_jobs_on_one_gpu_notice_each_other(tmp_path: Path) -> None:
    path = tmp_path / "gpu"
    with watched(path) as alone:
        assert alone()
    with watched(path) as first:
        with watched(path) as second:
            assert not second()
        # The second one has ended, but it was there.
        assert not first()
    with watched(path) as alone, watched(tmp_path / "another gpu") as elsewhere:
        assert alone()
        assert elsewhere()
