"""``quality.py`` and ``suite.py`` with tiny trainings: stopped and resumed, and published layouts."""

import json
import runpy
import shutil
import struct
import sys
from pathlib import Path

import forked
import numpy as np
import pytest
from csv_rows import read_rows
from PIL import Image
from scipy.spatial.transform import Rotation
from suite import SuiteOptions, run_suite

from harness import job as jobs
from harness.arms import choose_arms
from harness.job import perform
from harness.plan import parser_of, plan_scene
from harness.results import read_results
from sundae_ns.io.pack.container import read_header
from sundae_ns.plugin.finished_runs import load_model
from sundae_ns.report.measure import measure_scene

ROOT = Path(__file__).parents[2]
SCALE, WARMUP = 0.02, 12
WARM_UP = "sundae-tiny-warm-up"


def in_process(job, out, on_percent):
    """A job without a process of its own, which would load everything anew."""
    perform(job, out)


@pytest.fixture
def forked_jobs(tmp_path, monkeypatch):
    """Fork the processes of jobs off one that has imported nerfstudio; their command lines."""
    started = []

    def run_logged(words, log, on_line):
        python, option, code, *arguments = words
        assert (python, option) == (sys.executable, "-c")
        (tmp_path / "job.py").write_text(code)
        status, printed = forked.run(tmp_path / "job.py", *arguments)
        assert status == 0, printed
        for line in printed.splitlines():
            on_line(line)
        started.append(words)
        return 0, printed

    monkeypatch.setattr("harness.run.run_logged", run_logged)
    return started


def test_stopped_and_continued(tiny, tmp_path, monkeypatch, forked_jobs):
    arms, out = ["sundae", "band-no-head"], tmp_path / "out"
    jobs = plan_scene(
        tiny.scene.resolve(),
        parser_of(tiny.scene),
        choose_arms(arms, "sundae-tiny", SCALE),
        keep_ratios=[0.5],
        seeds=[42],
        repeat_at=[0.5],
    )
    warm_up, band = (job for job in jobs if job.kind == "warm-up" or job.arm == "band-no-head")
    for job in jobs:
        if job is not band:
            perform(job, out)
    # What a branch leaves that was cut off in its midst.
    leftover = out / "jobs" / band.key / "band-no-head" / "sundae-tiny" / "run" / "events.out.tfevents.1.gone"
    leftover.parent.mkdir(parents=True)
    leftover.touch()
    stamps = {path: path.stat().st_mtime_ns for path in (out / "done").iterdir()}
    assert len(stamps) == 2

    words = [ROOT / "benchmarks" / "quality.py", tiny.scene, "-o", out, "--arms", *arms]
    words += ["--method", "sundae-tiny", "--steps-scale", SCALE, "--seeds", 42]
    words += ["--keep-ratios", 0.5, "--repeat-at", 0.5]
    monkeypatch.setattr(sys, "argv", [str(word) for word in words])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(words[0]), run_name="__main__")
    assert ended.value.code == 0
    assert [words[-1] for words in forked_jobs] == [band.key]
    assert {path: path.stat().st_mtime_ns for path in stamps} == stamps
    assert not leftover.exists()
    rows = {row.variant: row for row in read_rows(out / "results.csv")}
    assert set(rows) == {WARM_UP, *arms}
    kept = round(0.5 * rows[WARM_UP].primitives)
    assert {rows[arm].primitives for arm in arms} == {kept}
    for row in rows.values():
        assert None not in (row.ms_frame, row.psnr, row.train_s)
    peaks = {arm: row.peak_primitives for arm, row in rows.items()}
    assert peaks["sundae"] == peaks["band-no-head"] == rows[WARM_UP].primitives <= peaks[WARM_UP]
    assert rows["sundae"].bytes_head > 0 == rows["band-no-head"].bytes_head
    # What was measured is what lies there: the run can be opened and looked at.
    assert load_model(out / "jobs" / warm_up.key / WARM_UP / "sundae-tiny" / "run").steps == WARMUP
    results = {result["job"]["arm"]: result for result in read_results(out)}
    assert results[WARM_UP]["packed"] is results[WARM_UP]["tuned"] is None
    for arm in arms:
        packed, key = results[arm]["packed"], results[arm]["job"]["key"]
        scene = load_model(out / "jobs" / key / "scene.sundae", data=tiny.scene)
        found = measure_scene(scene, label="", repeats=0, visible=False)
        assert packed["bytes"] == scene.packed_bytes == found.bytes_total
        assert (packed["psnr"], packed["psnr_base"]) == pytest.approx(
            (found.full.mean("psnr"), found.base.mean("psnr"))
        )
        assert packed["bytes"] < 0.7 * results[arm]["measured"]["bytes_total"]


def test_a_run_is_packed_with_a_fine_tune(tiny, tmp_path, monkeypatch):
    """As a job does on a GPU."""
    monkeypatch.setattr(jobs, "FINETUNE_STEPS", 3)
    opened = load_model(tiny.folder)
    plain = jobs.pack(opened, tmp_path / "plain.sundae")
    tuned = jobs.tune(opened, tmp_path / "tuned.sundae")
    assert plain is not None
    assert tuned is not None
    assert tuned.keys() == plain.keys()
    assert tuned["bytes"] == (tmp_path / "tuned.sundae").stat().st_size < plain["bytes"]
    assert read_header(tmp_path / "tuned.sundae").meta["source"]["finetuned"] == 3
    shutil.copytree(tiny.folder, tmp_path / "run")
    for checkpoint in (tmp_path / "run" / "nerfstudio_models").iterdir():
        if checkpoint.name != tiny.checkpoint(30).name:
            checkpoint.unlink()
    assert jobs.tune(load_model(tmp_path / "run"), tmp_path / "b.sundae") is None  # it still densifies


def test_the_suite_trains_a_method_as_its_command_does(tiny, tmp_path):
    captures = tmp_path / "captures"
    shutil.copytree(tiny.scene, captures / "still-life")
    (captures / "torn").mkdir()
    options = SuiteOptions(
        folder=captures,
        out=tmp_path / "out",
        arms=("sundae",),
        keep_ratios=(0.5,),
        method="sundae-tiny",
        steps_scale=SCALE,
    )
    assert run_suite(options, runner=in_process) == 1
    (row,) = read_rows(tmp_path / "out" / "results.csv")
    assert (row.scene, row.variant, row.keep_ratio, row.steps) == ("still-life", "sundae", 0.5, 24)
    assert row.peak_primitives > row.primitives
    assert "warm-start" not in row.command
    page = (tmp_path / "out" / "table.md").read_text()
    assert "- torn: " in page


def published(scene, out, *, factor):
    """The still life laid out as Mip-NeRF 360 is published: a COLMAP model of large pictures, and ``images_N``."""
    meta = json.loads((scene / "transforms.json").read_text())
    width, height = factor * meta["w"] - 1, factor * meta["h"] - factor // 2  # rounded up, by a hair
    intrinsics = [factor * meta[name] for name in ("fl_x", "fl_y", "cx", "cy")]
    model = out / "sparse" / "0"
    model.mkdir(parents=True)
    (out / "images").mkdir()
    (out / f"images_{factor}").mkdir()
    cameras = struct.pack("<QiiQQ4d", 1, 1, 1, width, height, *intrinsics)
    images = struct.pack("<Q", len(meta["frames"]))
    for number, frame in enumerate(meta["frames"], start=1):
        name = Path(frame["file_path"]).name
        shutil.copy(scene / frame["file_path"], out / f"images_{factor}" / name)
        with Image.open(scene / frame["file_path"]) as image:
            image.resize((width, height)).save(out / "images" / name)
        pose = np.array(frame["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
        turn, shift = pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3]
        x, y, z, w = Rotation.from_matrix(turn).as_quat()
        images += struct.pack("<i7di", number, w, x, y, z, *shift, 1) + name.encode() + b"\0" + struct.pack("<Q", 0)
    cloud = np.random.default_rng(0).uniform(-1, 1, (60, 3))
    points = struct.pack("<Q", len(cloud))
    for number, point in enumerate(cloud):
        points += struct.pack("<Q3d3Bd", number, *point, 90, 90, 90, 0.5)
        points += struct.pack("<Q", 1) + struct.pack("<ii", 1, 0)
    for name, content in (("cameras", cameras), ("images", images), ("points3D", points)):
        (model / f"{name}.bin").write_bytes(content)


def test_a_scene_as_it_is_published(tiny, tmp_path):
    published(tiny.scene, tmp_path / "360_v2" / "bicycle", factor=4)
    published(tiny.scene, tmp_path / "360_v2" / "counter", factor=2)
    options = SuiteOptions(
        paper=True,
        folder=tmp_path,
        out=tmp_path / "out",
        arms=("sundae",),
        keep_ratios=(0.5,),
        method="sundae-tiny",
        steps_scale=SCALE,
    )
    assert run_suite(options, runner=in_process) == 0
    rows = [row for row in read_rows(tmp_path / "out" / "results.csv") if row.variant == "sundae"]
    meta = json.loads((tiny.scene / "transforms.json").read_text())
    assert {row.scene for row in rows} == {"bicycle", "counter"}
    # The published pictures, not the large ones, rounded as they are.
    assert {row.resolution for row in rows} == {f"{meta['w']}x{meta['h']}"}
    opened = load_model(tmp_path / "out" / "jobs" / "bicycle-sundae-50pct-s42" / "sundae" / "sundae-tiny" / "run")
    assert len(opened.cameras) == -(-len(meta["frames"]) // 8)
    assert [float(camera.fx) for camera in opened.cameras] == pytest.approx([meta["fl_x"]] * len(opened.cameras))
    page = (tmp_path / "out" / "table.md").read_text()
    assert "*23.23*" in page
    assert "Missing: bonsai, garden" in page
