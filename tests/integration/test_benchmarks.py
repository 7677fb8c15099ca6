"""``quality.py``, ``suite.py`` and ``bench_formats.py`` with tiny trainings."""

import csv
import io
import runpy
import shutil
import stat
import sys
from contextlib import redirect_stdout
from pathlib import Path

import pytest
from colmap_models import write_model
from csv_rows import read_rows
from PIL import Image
from suite import SuiteOptions, run_suite

import sundae_ns as sn
from harness import job as jobs
from harness.arms import choose_arms
from harness.job import perform
from harness.plan import parser_of, plan_scene
from harness.results import read_results
from sundae_ns.io.pack.container import read_header
from sundae_ns.plugin.dataparsers import camera_of
from sundae_ns.plugin.finished_runs import load_model
from sundae_ns.report.measure import Subject, measure

FOLDER = Path(__file__).parents[2] / "benchmarks"
WARM_UP = "sundae-tiny-warm-up"
SHORT = {"keep_ratios": (0.5,), "method": "sundae-tiny", "steps_scale": 0.02}


def run(monkeypatch, script, *words):
    monkeypatch.setattr(sys, "argv", [script, *map(str, words)])
    with pytest.raises(SystemExit, match="0"):
        runpy.run_path(str(FOLDER / script), run_name="__main__")


@pytest.fixture
def jobs_here(monkeypatch):
    """Run the programs of jobs in this process, which has imported nerfstudio; their command lines."""
    started = []

    def run_logged(words, log):
        python, option, code, *arguments = words
        assert (python, option) == (sys.executable, "-c")
        with monkeypatch.context() as patch, redirect_stdout(io.StringIO()) as printed:
            patch.setattr(sys, "argv", [option, *arguments])
            patch.setattr(sys, "path", [*sys.path])
            with pytest.raises(SystemExit, match="0"):
                exec(code, {})
        started.append(words)
        return 0, printed.getvalue()

    monkeypatch.setattr("harness.run.run_logged", run_logged)
    return started


def test_a_comparison_that_was_stopped_is_continued(tiny, tmp_path, monkeypatch, jobs_here):
    arms, out, scale = ["sundae", "band-no-head"], tmp_path / "out", SHORT["steps_scale"]
    planned = plan_scene(
        tiny.scene.resolve(),
        parser_of(tiny.scene),
        choose_arms(arms, "sundae-tiny", scale),
        keep_ratios=[0.5],
        seeds=[42],
        repeat_at=[0.5],
    )
    warm_up, band = (job for job in planned if job.kind == "warm-up" or job.arm == "band-no-head")
    for job in planned:
        if job is not band:
            perform(job, out)
    # What a branch leaves that was cut off in its midst.
    leftover = out / "jobs" / band.key / "band-no-head" / "sundae-tiny" / "run" / "events.out.tfevents.1.gone"
    leftover.parent.mkdir(parents=True)
    leftover.touch()
    stamps = {path: path.stat().st_mtime_ns for path in (out / "done").iterdir()}
    assert len(stamps) == 2

    words = [tiny.scene, "-o", out, "--arms", *arms, "--method", "sundae-tiny", "--steps-scale", scale]
    run(monkeypatch, "quality.py", *words, "--seeds", 42, "--keep-ratios", 0.5, "--repeat-at", 0.5)
    assert [words[-1] for words in jobs_here] == [band.key]
    assert {path: path.stat().st_mtime_ns for path in stamps} == stamps
    assert not leftover.exists()
    rows = {row.variant: row for row in read_rows(out / "results.csv")}
    assert set(rows) == {WARM_UP, *arms}
    assert {rows[arm].primitives for arm in arms} == {round(0.5 * rows[WARM_UP].primitives)}
    assert not [row for row in rows.values() if None in (row.ms_frame, row.psnr, row.train_s)]
    peaks = {arm: row.peak_primitives for arm, row in rows.items()}
    assert peaks["sundae"] == peaks["band-no-head"] == rows[WARM_UP].primitives <= peaks[WARM_UP]
    assert rows["sundae"].bytes_head > 0 == rows["band-no-head"].bytes_head
    # What was measured is what lies there: the run can be opened and looked at.
    assert load_model(out / "jobs" / warm_up.key / WARM_UP / "sundae-tiny" / "run").steps == 12
    results = {result["job"]["arm"]: result for result in read_results(out)}
    assert results[WARM_UP]["packed"] is results[WARM_UP]["tuned"] is None
    for arm in arms:
        packed, key = results[arm]["packed"], results[arm]["job"]["key"]
        scene = load_model(out / "jobs" / key / "scene.sundae", data=tiny.scene)
        found = measure(Subject.of_run(scene), repeats=0)
        assert packed["bytes"] == scene.packed_bytes == found.full.bytes
        for name, way in (("psnr", found.full), ("psnr_base", found.base)):
            assert packed[name] == pytest.approx(way.mean("psnr"))
        assert packed["bytes"] < 0.7 * results[arm]["measured"]["bytes_total"]


def test_a_run_is_packed_with_a_fine_tune(tiny, tmp_path, monkeypatch):
    """As a job does on a GPU."""
    monkeypatch.setattr(jobs, "FINETUNE_STEPS", 3)
    opened, file = load_model(tiny.folder), tmp_path / "tuned.sundae"
    plain, tuned = jobs.pack(opened, tmp_path / "plain.sundae"), jobs.tune(opened, file)
    assert tuned.keys() == plain.keys()
    assert tuned["bytes"] == file.stat().st_size < plain["bytes"]
    assert read_header(file).meta["source"]["finetuned"] == 3
    early = shutil.copytree(tiny.folder, tmp_path / "run")
    for checkpoint in (early / "nerfstudio_models").iterdir():
        if checkpoint.name != tiny.checkpoint(30).name:
            checkpoint.unlink()
    assert jobs.tune(load_model(early), tmp_path / "b.sundae") is None  # it still densifies


def test_the_suite_trains_a_method_as_its_command_does(tiny, tmp_path):
    captures, out = tmp_path / "captures", tmp_path / "out"
    shutil.copytree(tiny.scene, captures / "still-life")
    (captures / "torn").mkdir()
    assert run_suite(SuiteOptions(folder=captures, out=out, arms=("sundae",), **SHORT), runner=perform) == 1
    (row,) = read_rows(out / "results.csv")
    assert (row.scene, row.variant, row.keep_ratio, row.steps) == ("still-life", "sundae", 0.5, 24)
    assert row.peak_primitives > row.primitives
    assert "warm-start" not in row.command
    assert "- torn: " in (out / "table.md").read_text()


def test_a_scene_as_it_is_published(tiny, tmp_path):
    """As Mip-NeRF 360 is: a COLMAP model of large images, and ``images_4``."""
    out, bicycle = tmp_path / "out", tmp_path / "360_v2" / "bicycle"
    size = 4 * 48 - 1, 4 * 48 - 2  # rounded up, by a hair
    shutil.copytree(tiny.scene / "images", bicycle / "images_4")
    (bicycle / "images").mkdir()
    names = sorted(path.name for path in (bicycle / "images_4").iterdir())
    for name in names:
        with Image.open(bicycle / "images_4" / name) as image:
            image.resize(size).save(bicycle / "images" / name)
    write_model(bicycle / "sparse" / "0", names, size)
    options = SuiteOptions(paper=True, folder=tmp_path, out=out, arms=("sundae",), **SHORT)
    assert run_suite(options, runner=perform) == 0
    rows = [row for row in read_rows(out / "results.csv") if row.variant == "sundae"]
    # The published images, not the large ones, rounded as they are.
    assert [(row.scene, row.resolution) for row in rows] == [("bicycle", "48x48")]
    opened = load_model(out / "jobs" / "bicycle-sundae-50pct-s42" / "sundae" / "sundae-tiny" / "run")
    assert [float(camera.fx) for camera in opened.cameras] == pytest.approx([18 / 4] * 2), "every eighth of 15"
    page = (out / "table.md").read_text()
    assert "*23.23*" in page
    assert "Missing: bonsai, counter, garden" in page


TRANSFORM = f"""#!{sys.executable}
import sys
import sundae_ns as sn
if sys.argv[1:] == ["--version"]:
    print("splat-transform v9.8.7 (0a1b2c3)", file=sys.stderr)
else:
    sn.save(sn.load(sys.argv[-2]), sys.argv[-1])
"""
"""A program with the command line of splat-transform."""


def test_each_format_has_a_row(tiny, tmp_path, monkeypatch):
    out, transform = tmp_path / "formats.csv", tmp_path / "splat-transform"
    transform.write_text(TRANSFORM)
    transform.chmod(transform.stat().st_mode | stat.S_IXUSR)
    run(monkeypatch, "bench_formats.py", tiny.folder, "-o", out, "--splat-transform", transform)
    rows = {(row["format"], row["program"]): row for row in csv.DictReader(out.read_text().splitlines())}
    ours = [(kind, "sundae_ns") for kind in (".ply", ".spz", ".sog", ".sundae")]
    assert list(rows) == [("fp32", ""), *ours, (".sog", "splat-transform 9.8.7")]
    opened, scene = load_model(tiny.folder), sn.load(tiny.folder)
    cameras = [camera_of(camera, "cpu") for camera in opened.cameras]
    with_head, base = (sn.measure(scene, opened.truths, cameras, head=head).psnr for head in (True, False))
    assert abs(with_head - base) > 3e-4
    psnr = {place: float(row["psnr"]) for place, row in rows.items()}
    assert psnr["fp32", ""] == pytest.approx(with_head, abs=1e-4)
    assert psnr[".sundae", "sundae_ns"] == pytest.approx(with_head, abs=0.5)
    assert psnr[".ply", "sundae_ns"] == pytest.approx(base, abs=1e-4)  # over the background of the run
    facts = {"capture": opened.scene, "primitives": str(scene.num_gaussians), "seed": str(opened.seed)}
    assert all(facts.items() <= row.items() for row in rows.values())
    sizes = {place: int(row["bytes"]) for place, row in rows.items()}
    assert sizes[".ply", "sundae_ns"] > sizes[".sog", "sundae_ns"] > 0
    assert sizes["fp32", ""] > sizes[".sundae", "sundae_ns"]


def test_a_program_that_fails_costs_its_own_row_alone(tiny, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "path", [str(FOLDER), *sys.path])
    files = runpy.run_path(str(FOLDER / "bench_formats.py"))["packed_files"]
    made = [one.file.suffix for one in files(tiny.folder, sn.load(tiny.folder), tmp_path, None, "false --gpu cpu")]
    assert made == [".ply", ".spz", ".sog", ".sundae"]
    assert "false --gpu cpu has failed" in capsys.readouterr().err
