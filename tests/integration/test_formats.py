"""``bench_formats.py``: a finished run in every packed format, loaded again and measured on its test views."""

import csv
import runpy
import stat
import sys
from pathlib import Path

import pytest
import torch

import sundae_ns as sn
from sundae_ns.plugin.dataparsers import camera_of
from sundae_ns.plugin.finished_runs import load_model

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "bench_formats.py"
TRANSFORM = """#!{python}
import sys
import sundae_ns as sn
if sys.argv[1:] == ["--version"]:
    print("splat-transform v9.8.7 (0a1b2c3)", file=sys.stderr)
else:
    sn.save(sn.load(sys.argv[-2]), sys.argv[-1])
"""


def run(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", [SCRIPT.name, *map(str, arguments)])
    with pytest.raises(SystemExit) as caught:
        runpy.run_path(str(SCRIPT), run_name="__main__")
    assert caught.value.code == 0


def rows_of(path):
    return list(csv.DictReader(path.read_text().splitlines()))


@pytest.fixture
def transform(tmp_path):
    """A program with the command line of splat-transform."""
    path = tmp_path / "splat-transform"
    path.write_text(TRANSFORM.format(python=sys.executable))
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def test_each_format_has_a_row(tiny, transform, tmp_path, monkeypatch):
    out = tmp_path / "formats.csv"
    run(monkeypatch, tiny.folder, "-o", out, "--splat-transform", transform)
    rows = {(row["format"], row["program"]): row for row in rows_of(out)}
    assert list(rows) == [
        ("fp32", ""),
        *((kind, "sundae_ns") for kind in (".ply", ".spz", ".sog", ".sundae")),
        (".sog", "splat-transform 9.8.7"),
    ]
    opened = load_model(tiny.folder)
    scene = sn.load(tiny.folder)
    assert scene.head is not None
    cameras = [camera_of(camera, "cpu") for camera in opened.cameras]
    with_head, base = (sn.measure(scene, opened.truths, cameras, head=head).psnr for head in (True, False))
    assert abs(with_head - base) > 3e-4
    psnr = {place: float(row["psnr"]) for place, row in rows.items()}
    assert psnr["fp32", ""] == pytest.approx(with_head, abs=1e-4)
    assert psnr[".sundae", "sundae_ns"] == pytest.approx(with_head, abs=0.5)
    assert psnr[".ply", "sundae_ns"] == pytest.approx(base, abs=1e-4)  # over the background of the run
    for row in rows.values():
        assert (row["capture"], row["primitives"]) == (opened.scene, str(scene.num_gaussians))
        assert row["seed"] == str(opened.seed)
    sizes = {place: int(row["bytes"]) for place, row in rows.items()}
    assert sizes[".ply", "sundae_ns"] > sizes[".sog", "sundae_ns"] > 0
    assert sizes["fp32", ""] > sizes[".sundae", "sundae_ns"]


def test_a_program_that_fails_costs_its_own_row_alone(tiny, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "path", [str(SCRIPT.parent), *sys.path])
    files = runpy.run_path(str(SCRIPT))["packed_files"]
    made = [one.file.suffix for one in files(tiny.folder, sn.load(tiny.folder), tmp_path, None, "false --gpu cpu")]
    assert made == [".ply", ".spz", ".sog", ".sundae"]
    assert "false --gpu cpu has failed" in capsys.readouterr().err


def test_a_file_of_another_program_takes_the_place_of_its_own_row(tiny, tmp_path, monkeypatch):
    out, file = tmp_path / "formats.csv", tmp_path / "other.ply"
    scene = sn.load(tiny.folder)
    cameras = sn.virtual_cameras(scene, 2)
    for count in (scene.num_gaussians, 20):
        sn.save(sn.prune(scene, count=count, cameras=cameras) if count < scene.num_gaussians else scene, file)
        run(monkeypatch, tiny.folder, "-o", out, "--ply", file, "--program", f"tool {count}")
    rows = [row for row in rows_of(out) if row["format"] == ".ply"]
    assert [(row["program"], row["primitives"]) for row in rows] == [("tool 20", "20")]
    assert len(rows_of(out)) == 2
    assert torch.tensor(float(rows[0]["psnr"])).isfinite()
