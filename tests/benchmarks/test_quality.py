"""Plans of ``quality.py`` and ``paper.py``, and how they are carried out, with a runner that trains nothing."""

from __future__ import annotations

import csv
import json
import shlex
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
import tyro
from bench_jobs import Runner
from csv_rows import read_rows
from paper import DATASETS, PRINTED, PaperOptions, find_scene, run_paper
from quality import QualityOptions, run_quality
from rich.console import Console
from suite import SuiteOptions

from harness.arms import choose_arms
from harness.plan import Arm, Job, jobs_of_shard, parser_of, plan_scene
from harness.results import read_results, spread
from sundae_ns.errors import ConfigError, DataError, StorageError
from sundae_ns.evaluation import COLUMNS


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    folder = tmp_path / "fox"
    folder.mkdir()
    (folder / "transforms.json").write_text("{}")
    return folder


def quality(capture: Path, out: Path, runner: Runner, **changed: Any) -> tuple[int, str]:
    text = StringIO()
    options: dict[str, Any] = {"arms": ("sundae", "band-no-head", "splatfacto"), **changed}
    console = Console(file=text, width=200, force_terminal=False)
    code = run_quality(QualityOptions(folder=capture, out=out, **options), runner=runner, console=console)
    return code, text.getvalue()


# -------------------------------------------------------------------------------------------------------------- options


@pytest.mark.parametrize(
    "options",
    [
        QualityOptions(folder=Path("a b"), out=Path("out")),
        QualityOptions(folder=Path("a"), out=Path("o"), arms=("band", "my arms.yaml"), steps_scale=0.5, downscale=4),
        PaperOptions(folder=Path("a b"), out=Path("out")),
        PaperOptions(folder=Path("a"), out=Path("o"), scenes=("garden", "room"), seeds=(1,), method="sundae-tiny"),
        SuiteOptions(folder=Path("a b"), out=Path("out")),
        SuiteOptions(folder=Path("a"), out=Path("o"), scenes=("fox",), keep_ratios=(0.01, 0.3), seeds=(1, 2)),
    ],
)
def test_a_page_names_the_command_of_the_whole(options: QualityOptions | PaperOptions | SuiteOptions) -> None:
    part = replace(options, shard="2/3", jobs=True)
    assert part.command() == options.command()
    words = shlex.split(part.command())
    assert words[:2] == ["python", f"benchmarks/{type(options).__name__.removesuffix('Options').lower()}.py"]
    assert tyro.cli(type(options), args=words[2:]) == options


# ---------------------------------------------------------------------------------------------------------------- plans


@pytest.fixture(scope="module")
def arms() -> list[Arm]:
    """All default arms."""
    return choose_arms([], "sundae")


def plan(arms: list[Arm], **changed: Any) -> list[Job]:
    options: dict[str, Any] = {"keep_ratios": [0.01, 0.1], "seeds": [42, 43], "repeat_at": [0.1]}
    return plan_scene(Path("fox"), (), arms, **{**options, **changed})


def test_seeds_repeat_only_what_is_asked_for(arms: list[Arm]) -> None:
    jobs = plan(arms)
    assert len({job.key for job in jobs}) == len(jobs)
    names = [arm.name for arm in arms if arm.kind != "whole" and arm.keep_ratio is None]
    with_own_ratio = {(arm.name, arm.keep_ratio) for arm in arms if arm.keep_ratio is not None}
    assert with_own_ratio == {("sundae-no-head-bytes", 0.13)}
    for seed, ratios in ((42, {0.01, 0.1}), (43, {0.1})):
        own = [job for job in jobs if job.seed == seed]
        expected = {(a, r) for a in names for r in ratios} | (with_own_ratio if seed == 42 else set())
        assert {(job.arm, job.keep_ratio) for job in own if job.needs} == expected
        assert [job.method for job in own if job.kind == "warm-up"] == ["sundae", "sundae-fast"]
        assert {job.arm: job.steps for job in own if job.kind == "whole"} == {
            "splatfacto": 30_000,
            "splatfacto-7k": 7_000,
            "sundae-auto": 30_000,
        }


def test_every_arm_of_a_seed_starts_from_its_warm_up_and_trains_as_long(arms: list[Arm]) -> None:
    jobs = plan(arms)
    place = {job.key: index for index, job in enumerate(jobs)}
    for job in jobs:
        if job.needs is not None:
            warm_up = jobs[place[job.needs]]
            assert place[warm_up.key] < place[job.key]
            assert (warm_up.kind, warm_up.seed) == ("warm-up", job.seed)
            total, steps = (18_000, 12_000) if job.arm == "sundae-fast" else (30_000, 18_000)
            assert job.steps == steps
            assert warm_up.steps + job.steps == total


def test_arms_differ_in_their_rule_alone(arms: list[Arm]) -> None:
    by_arm = {job.arm: job.options for job in plan(arms, keep_ratios=[0.1], seeds=[42])}
    head = ("--pipeline.model.head.mode", "off")
    for arm in ("sundae", "band"):
        assert by_arm[arm + "-no-head"] == (*by_arm[arm], *head)
        assert by_arm[arm][: len(by_arm["sundae"])] == by_arm["sundae"]


@pytest.mark.parametrize("parts", [1, 2, 5, 40])
def test_shards_divide_the_jobs_and_bring_the_warm_ups_they_need(parts: int, arms: list[Arm]) -> None:
    jobs = plan(arms)
    shards = [jobs_of_shard(jobs, f"{index}/{parts}") for index in range(1, parts + 1)]
    dealt = sorted(job.key for shard in shards for job in shard if job.kind != "warm-up")
    assert dealt == sorted(job.key for job in jobs if job.kind != "warm-up")
    for shard in shards:
        keys = [job.key for job in shard]
        assert all(job.needs is None or keys.index(job.needs) < keys.index(job.key) for job in shard)
        assert all(any(other.needs == job.key for other in shard) for job in shard if job.kind == "warm-up")


@pytest.mark.parametrize("shard", ["0/2", "3/2", "1", "a/b", "1/2/3", ""])
def test_shards_that_cannot_be(shard: str) -> None:
    with pytest.raises(ConfigError, match="i/n"):
        jobs_of_shard([], shard)


@pytest.mark.parametrize(
    "odd",
    [
        {"keep_ratios": [0]},
        {"keep_ratios": []},
        {"seeds": [1, 1]},
        {"repeat_at": [0.5]},
    ],
)
def test_plans_that_cannot_be(odd: dict[str, Any], arms: list[Arm]) -> None:
    with pytest.raises(ConfigError):
        plan(arms, **odd)


# ------------------------------------------------------------------------------------------------------- carried out


def test_stopped_and_continued(capture: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    first = Runner(stop_after=3)
    code, said = quality(capture, out, first)
    assert code == 130
    assert "the same command resumes" in said
    second = Runner()
    assert quality(capture, out, second)[0] == 0
    assert len(first.ran) == 3
    assert not set(first.ran) & set(second.ran)
    third = Runner()
    code, said = quality(capture, out, third)
    assert (code, third.ran) == (0, [])
    rows = read_rows(out / "results.csv")
    assert len(rows) == len(first.ran) + len(second.ran)
    assert {row.peak_primitives for row in rows} == {1500}
    with open(out / "results.csv", newline="") as file:
        assert tuple(next(csv.reader(file))) == COLUMNS
    assert "table.md" in said
    assert "done" in quality(capture, out, third, jobs=True)[1]


def test_the_page_has_mean_and_spread_beside_each_ways_own_time(capture: Path, tmp_path: Path) -> None:
    quality(capture, tmp_path / "out", Runner())
    page = (tmp_path / "out" / "table.md").read_text()
    assert "--keep-ratios 0.01 0.1 --seeds 42 43 44 --repeat-at 0.1" in page
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in page.splitlines() if line.startswith("| sun")]
    by_way = {(line[1], line[2]): line for line in lines}
    on, off = by_way["head on", "10%"], by_way["head off", "10%"]
    assert (on[3], on[5], on[12]) == ("3", "27.10 ± 0.10", "3.50 ± 0.00")
    assert (off[3], off[5], off[12]) == ("3", "26.10 ± 0.10", "2.00 ± 0.00")
    assert by_way["head on", "1%"][5] == "27.00"


def test_parts_merge_by_concatenation(capture: Path, tmp_path: Path) -> None:
    parts = []
    for index in (1, 2, 3):
        out = tmp_path / f"part{index}"
        assert quality(capture, out, Runner(), shard=f"{index}/3")[0] == 0
        parts.append((out / "results.jsonl").read_text())
    whole = tmp_path / "whole"
    whole.mkdir()
    (whole / "merged.jsonl").write_text("".join(parts))
    again = Runner()
    assert quality(capture, whole, again)[0] == 0
    assert again.ran == []
    straight = tmp_path / "straight"
    quality(capture, straight, Runner())

    def figures(path: Path) -> list[str]:
        return [line for line in (path / "table.md").read_text().splitlines() if line.startswith("|")]

    assert figures(whole) == figures(straight)


def test_a_branch_needs_the_warm_up_and_not_its_result_alone(capture: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    quality(capture, out, Runner(), arms=("sundae",), seeds=(42,))
    (out / "done" / "fox-sundae-warm-up-s42.json").unlink()
    runner = Runner()
    quality(capture, out, runner, arms=("sundae", "sundae-no-head"), keep_ratios=(0.1,), seeds=(42,))
    assert runner.ran == ["fox-sundae-warm-up-s42", "fox-sundae-no-head-10pct-s42"]


def test_a_job_that_fails_stops_only_what_needs_it(capture: Path, tmp_path: Path) -> None:
    runner = Runner(broken="sundae-warm-up-s43")
    code, said = quality(capture, tmp_path / "out", runner)
    assert code == 1
    assert "fox-sundae-warm-up-s43 failed: it broke" in said
    assert not any(key.endswith("s43") and "splatfacto" not in key for key in runner.ran)
    assert "fox-sundae-10pct-s44" in runner.ran
    assert quality(capture, tmp_path / "out", Runner())[0] == 0


def test_another_plan_does_not_pass_for_this_one(capture: Path, tmp_path: Path) -> None:
    quality(capture, tmp_path / "out", Runner())
    with pytest.raises(ConfigError, match="steps"):
        quality(capture, tmp_path / "out", Runner(), steps_scale=0.5)


def test_damaged_results_are_refused(capture: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    quality(capture, out, Runner(), arms=("splatfacto",))
    (out / "more.jsonl").write_text((out / "results.jsonl").read_text() + '{"job"')
    with pytest.raises(DataError, match="more.jsonl, line 4"):
        read_results(out)
    (out / "more.jsonl").write_bytes(b"\xff\xfe")
    with pytest.raises(DataError, match="more.jsonl, line 1"):
        read_results(out)


def test_folders_of_something_else_are_left_alone(capture: Path, tmp_path: Path) -> None:
    notes = tmp_path / "notes"
    notes.mkdir()
    (notes / "table.md").write_text("mine")
    with pytest.raises(StorageError, match="holds files of something else"):
        quality(capture, notes, Runner())
    assert (notes / "table.md").read_text() == "mine"
    for out in (capture, capture / "out", tmp_path):
        with pytest.raises(StorageError, match="what the command reads"):
            quality(capture, out, Runner())
    with pytest.raises(StorageError, match="is a file"):
        quality(capture, notes / "table.md", Runner())


def test_seeds_whose_trials_differ_have_lines_of_their_own(capture: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    quality(capture, out, Runner(), arms=("sundae",), keep_ratios=(0.1,))
    path = out / "done" / "fox-sundae-10pct-s43.json"
    result = json.loads(path.read_text())
    del result["measured"]["configurations"][1:]
    path.write_text(json.dumps(result) + "\n")
    (out / "results.jsonl").unlink()
    quality(capture, out, Runner(), arms=("sundae",), keep_ratios=(0.1,))
    page = (out / "table.md").read_text()
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in page.splitlines() if line.startswith("| sun")]
    assert [line[1:4] for line in lines if line[2] == "10%"] == [
        ["head on", "10%", "2"],
        ["head off", "10%", "2"],
        ["no head", "10%", "1"],
    ]


def test_markup_in_names_and_errors_is_shown_as_it_is(tmp_path: Path) -> None:
    folder = tmp_path / "fox[red]"
    folder.mkdir()
    (folder / "transforms.json").write_text("{}")
    code, said = quality(folder, tmp_path / "out", Runner(broken="splatfacto-s42"), arms=("splatfacto",))
    assert code == 1
    assert "fox[red]-splatfacto-s42 failed: it broke" in said


def test_spread() -> None:
    assert spread([1.0, 2.0, 3.0], 2) == "2.00 ± 1.00"
    assert spread([1.0], 2) == "1.00"
    assert spread([1.0, None], 2) == spread([], 2) == "-"


# ---------------------------------------------------------------------------------------------------------- the paper's


def scene_folder(folder: Path, *pictures: str) -> None:
    (folder / "sparse" / "0").mkdir(parents=True)
    for name in pictures:
        (folder / name).mkdir()


@pytest.fixture
def archives(tmp_path: Path) -> Path:
    """Empty folders, laid out as the archives unpack."""
    parents = {"Mip-NeRF 360": "360_v2", "Tanks and Temples": "tandt_db/tandt", "Deep Blending": "tandt_db/db"}
    for dataset, scenes in DATASETS.items():
        for scene in scenes:
            scene_folder(tmp_path / "data" / parents[dataset] / scene, "images", "images_2", "images_4")
    return tmp_path / "data"


def paper(root: Path, out: Path, runner: Runner, **changed: Any) -> tuple[int, str]:
    text = StringIO()
    options: dict[str, Any] = {"arms": ("sundae", "splatfacto"), **changed}
    console = Console(file=text, width=200, force_terminal=False)
    return run_paper(PaperOptions(folder=root, out=out, **options), runner=runner, console=console), text.getvalue()


def cells_of(page: str, first: str) -> list[str]:
    """The other cells of a line of the table of PSNR."""
    table = page.partition("## PSNR")[2].partition("## SSIM")[0]
    line = next(line for line in table.splitlines() if line.startswith(f"| {first} "))
    return [cell.strip() for cell in line.split("|")[2:-1]]


def test_scenes_are_the_papers_eleven_at_its_resolutions() -> None:
    factors = {scene: factor for members in DATASETS.values() for scene, factor in members.items()}
    assert len(factors) == 11
    assert (factors["bicycle"], factors["counter"], factors["truck"], factors["playroom"]) == (4, 2, 1, 1)
    assert set(PRINTED) <= {*factors, *DATASETS}


def test_all_scenes_into_one_table_beside_the_papers(archives: Path, tmp_path: Path) -> None:
    runner = Runner()
    assert paper(archives, tmp_path / "out", runner)[0] == 0
    assert len(runner.ran) == 11 * (1 + 4 + 1)
    page = (tmp_path / "out" / "table.md").read_text()
    arms = ["splatfacto", "sundae 1%", "sundae 10%", "sundae 30%", "sundae 50%"]
    assert cells_of(page, "scene")[:5] == arms
    ours = ["27.00", *["27.00"] * 4]
    assert cells_of(page, "bicycle") == [*ours, "*23.23*", "*24.36*", "*24.40*", "*24.46*"]
    assert cells_of(page, "**Tanks and Temples**") == [*ours, "*20.49*", "*22.50*", "*23.46*", "*23.70*"]


def test_scenes_that_are_not_there_are_said_and_left_out(archives: Path, tmp_path: Path) -> None:
    (archives / "360_v2" / "garden").rename(tmp_path / "elsewhere")
    code, said = paper(archives, tmp_path / "out", Runner(), keep_ratios=(0.1,))
    assert code == 0
    assert "left out: garden" in said
    page = (tmp_path / "out" / "table.md").read_text()
    assert "Missing: garden." in page
    # A mean of six of seven is not the data set's.
    assert cells_of(page, "**Mip-NeRF 360**")[:2] == ["-", "-"]


def test_folders_that_cannot_be_used(archives: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="none of the paper's scenes"):
        paper(archives, tmp_path / "out", Runner(), scenes=("treehill",))
    with pytest.raises(DataError, match="holds none"):
        paper(tmp_path / "fresh", tmp_path / "out", Runner())
    (archives / "360_v2" / "stump" / "images_4").rmdir()
    with pytest.raises(DataError, match="images_4 does not exist"):
        paper(archives, tmp_path / "out", Runner())
    scene_folder(archives / "copy" / "bicycle")
    with pytest.raises(DataError, match="more than once"):
        find_scene(archives, "bicycle")
    with pytest.raises(DataError, match="no capture: .*`sundae poses "):
        parser_of(archives)
