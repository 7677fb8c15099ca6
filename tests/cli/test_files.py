"""``sundae export`` and ``sundae prune``."""

import dataclasses
import json
import logging
import re
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from colmap_models import write_model
from command_line import run
from foreign_files import FOREIGN, KSPLAT, small_field
from packed_scenes import KINDS, write_kind
from plyfile import PlyData
from short_prunes import SHORT

import sundae_ns as sn
from sundae_ns.core.gaussians import SPLAT_NAMES
from sundae_ns.io.formats import read_gaussian_file, write_for_viewers
from sundae_ns.io.pack.packed_scene import PackedScene, fit_scene, read_scene, write_fitted
from sundae_ns.io.ply import Marks, ply_marks, read_ply, write_ply
from sundae_ns.scene import prune_scene as pruning
from sundae_ns.scene.scene import from_points

MODEL = {"sh_degree": 1, "rasterize_mode": "classic", "background_color": "black"}


def gaussians(n=200, features=0):
    torch.manual_seed(0)
    points = torch.rand(n, 3)
    made = from_points(points, points, sh_degree=1)
    made["features_rest"] = torch.randn(n, 3, 3)
    return made | ({"features": torch.randn(n, features)} if features else {})


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_export_of_a_packed_scene(tmp_path, mode):
    scene = PackedScene(gaussians(), meta={"model": {**MODEL, "rasterize_mode": mode}})
    write_fitted(tmp_path / "a.sundae", *fit_scene(scene))
    assert run("export", tmp_path / "a.sundae", "-o", tmp_path / "a.ply") == 0
    found, truth = read_ply(tmp_path / "a.ply"), read_scene(tmp_path / "a.sundae").gaussians
    assert all(torch.equal(found[name], truth[name]) for name in SPLAT_NAMES)
    assert ply_marks(tmp_path / "a.ply").in_model_frame
    assert ("SplatRenderMode: mip" in PlyData.read(tmp_path / "a.ply").comments) == (mode == "antialiased")
    assert run("export", tmp_path / "a.sundae", "-o", tmp_path / "a.spz", "--upright") == 0
    write_for_viewers(tmp_path / "b.spz", truth, Marks(antialiased=mode == "antialiased"), upright=True)
    assert (tmp_path / "a.spz").read_bytes() == (tmp_path / "b.spz").read_bytes()


@pytest.mark.usefixtures("short_distillation")
def test_export_of_levels_of_detail(tmp_path, capsys):
    write_fitted(tmp_path / "a.sundae", *fit_scene(PackedScene(gaussians(), meta={"model": MODEL})))
    assert run("export", tmp_path / "a.sundae", "-o", tmp_path / "b", "--lod") == 0
    assert json.loads((tmp_path / "b" / "lod-meta.json").read_text())["counts"] == [200, 100, 50, 20]
    assert capsys.readouterr().out.count("dB against the full scene") == 3
    assert run("export", tmp_path / "a.sundae", "-o", tmp_path / "b", "--lod") == 2


@pytest.mark.parametrize("kind", [".spz", ".sog"])
@pytest.mark.parametrize("comments", [[], ["SplatRenderMode: mip"]])
def test_export_of_a_ply_of_any_program(tmp_path, kind, comments, capsys, caplog):
    """The file's name does not matter, and the result equals that of the same field as a packed scene."""
    given = gaussians()
    given["means"][3] = torch.nan
    write_ply(tmp_path / "unnamed.bin", given, comments=comments)
    out, same = tmp_path / f"a{kind}", tmp_path / f"b{kind}"
    assert run("export", tmp_path / "unnamed.bin", "-o", out) == 0
    output = " ".join(capsys.readouterr().out.split())
    mode = ", antialiased" if comments else ""
    assert f"a{kind}: 199 Gaussians, degree 1{mode}, {out.stat().st_size:,} bytes" in output
    assert caplog.messages[0].endswith("unnamed.bin: 200 Gaussians: dropped 1 that were not finite (NaN or infinite)")
    assert caplog.messages[1].endswith("states no upward direction; it is 0 -1 0, as files of its kind have")
    finite = {name: value[torch.arange(200) != 3] for name, value in given.items()}
    up = sn.load(tmp_path / "unnamed.bin").up
    write_for_viewers(same, finite, Marks(antialiased=bool(comments), up=up))
    assert out.read_bytes() == same.read_bytes()


@pytest.mark.usefixtures("short_distillation")
@pytest.mark.parametrize("name", FOREIGN)
def test_every_command_reads_files_of_other_programs(tmp_path, monkeypatch, caplog, name):
    """In folders that do not exist yet."""
    monkeypatch.chdir(tmp_path)
    truth = KSPLAT if name == "a.ksplat" else small_field()
    FOREIGN[name](Path(name), truth)
    colors = read_gaussian_file(Path(name))[0].gaussians["features_dc"]
    assert run("prune", name, "-o", "pruned/a/b.ply", "--keep", "0.5", "--num-cameras", "4") == 0
    assert len(read_ply(Path("pruned/a/b.ply"))["means"]) == len(truth["means"]) // 2
    assert run("prune", name, "-o", "same/a.ply", "--keep", "1", "--num-cameras", "4") == 0
    torch.testing.assert_close(read_gaussian_file(Path("same/a.ply"))[0].gaussians["features_dc"], colors)
    assert run("pack", name, "-o", "packed/a.sundae") == 0
    found = read_scene(Path("packed/a.sundae")).gaussians["means"]
    assert torch.cdist(truth["means"].double(), found.double()).amin(dim=1).max() < 0.002
    if name == "a.splat":  # these open it as the others do
        for words in ("export {} -o a/a.spz", "export {} -o b/a.html", "render {} -o c/a.png --width 64"):
            assert run(*words.format(name).split()) == 0
        assert run("prune", name, "-o", "d/a.sundae", "--distill", "--steps", "1", "--no-head", "--keep", "0.5") == 0
        assert all(Path(file).stat().st_size > 0 for file in ("a/a.spz", "b/a.html", "c/a.png", "d/a.sundae"))
    if name != "plain.ply":
        assert run("export", name, "-o", "plain/a.ply") == 0
        assert torch.equal(read_ply(Path("plain/a.ply"))["features_dc"], colors)
    assert all("states no upward direction" in message for message in caplog.messages)


WITHOUT = f"""
import json, sys
sys.modules["nerfstudio"] = sys.modules["numba"] = None
{SHORT}
from sundae_ns.cli import main
from sundae_ns.rasterize.interface import numba_problem
codes = []
for words in json.loads(sys.argv[1]):
    try:
        main(words.split())
    except SystemExit as end:
        codes.append(end.code)
    if sys.modules.get("numba", 1) is None:  # for the first command alone
        del sys.modules["numba"]
        numba_problem.cache_clear()
print(json.dumps(codes))
"""


def test_commands_on_files_need_no_nerfstudio_and_a_prune_no_compiler(tmp_path):
    write_fitted(tmp_path / "a.sundae", *fit_scene(PackedScene(gaussians(), meta={"model": MODEL})))
    write_ply(tmp_path / "few.ply", gaussians(50))
    write_kind(tmp_path / "head.sundae", KINDS["residual"])
    commands = (
        "prune few.ply -o fewer.ply --num-cameras 2; export a.sundae -o a.ply; export a.ply -o a.spz; "
        "prune a.ply -o pruned.ply --num-cameras 4; prune a.spz -o pruned.sundae --count 20 --num-cameras 4; "
        "export head.sundae -o head.html; pack a.ply -o packed.sundae; pack gone -o x; export gone -o x.html"
    ).split("; ")
    words = [sys.executable, "-c", WITHOUT, json.dumps(commands)]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == [0] * 7 + [2] * 2, done.stderr
    for command in commands[:7]:
        assert (tmp_path / command.split()[3]).stat().st_size > 0
    *_, pack, export = (line for line in done.stderr.splitlines() if line.startswith("sundae: "))
    assert all("gone does not exist; give a run" in line for line in (pack, export))


def test_prune_by_the_cameras_of_files(tmp_path, capsys):
    """Those of a packed scene, of a COLMAP model and of a transforms.json; each says how many it is."""
    scene = sn.Scene.from_points(torch.rand(200, 3), torch.rand(200, 3))
    sn.save(scene, tmp_path / "a.ply")
    sn.save(dataclasses.replace(scene, cameras=tuple(sn.virtual_cameras(scene, 3, size=32))), tmp_path / "a.sundae")
    write_model(tmp_path / "photos/sparse/0", ["a.png", "b.png"], (32, 24))
    frame = {"transform_matrix": [[1, 0, 0, 2.0], [0, 1, 0, 0.5], [0, 0, 1, 3], [0, 0, 0, 1]]}
    frame |= {"fl_x": 30, "fl_y": 30, "cx": 16, "cy": 12, "w": 32, "h": 24}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    for name, number in (("a.sundae", 3), ("photos/sparse/0", 2), ("photos", 2), ("transforms.json", 1)):
        arguments = ["prune", tmp_path / "a.ply", "-o", tmp_path / "out.spz", "--cameras", tmp_path / name]
        assert run(*arguments, "--count", "50", "--overwrite") == 0
        text = capsys.readouterr().out
        seen = re.search(rf"{number} cameras see ([\d.]+)% of the Gaussians(; if the cameras are not in)?", text)
        assert (seen[2] is not None) == (float(seen[1]) < 92) == (name == "transforms.json")
        assert "50 of 200 Gaussians" in text
    words = "-o", tmp_path / "transforms.json", "--cameras", tmp_path, "--overwrite"
    assert run("prune", tmp_path / "a.ply", *words) == 2


@pytest.mark.parametrize(("name", "asked"), [("a.ply", 0.1), ("a.spz", 0.02), ("a.sundae", 0.027), ("a.html", 0.25)])
def test_a_size_that_was_asked_for_binds(name, asked, tmp_path, capsys, monkeypatch):
    """With a box, a direction and a page in the same command; if all Gaussians fit, none goes, and a line says so."""
    monkeypatch.setattr(logging.getLogger("sundae_ns"), "handlers", [logging.lastResort])
    monkeypatch.setattr("sundae_ns.scene.prune_scene.refit", noted := Mock(side_effect=pruning.refit))
    monkeypatch.setattr(pruning, "SAMPLED", (8, 32) if name == "a.sundae" else pruning.SAMPLED)
    points = torch.rand(3000, 3, generator=torch.Generator().manual_seed(0))
    scene = sn.Scene.from_points(points, points, sh_degree=2)
    scene.gaussians["features_dc"][: 40 * (name == "a.spz")] = -3.34
    sn.save(scene, tmp_path / "in.ply")
    words = ["prune", tmp_path / "in.ply", "-o", tmp_path / name, "--num-cameras", "2", "--up", "0", "1", "0"]
    assert run(*words, "--max-mb", asked, "--crop", "0", "0", "0", "1", "1", "0.9") == 0
    size, said = (tmp_path / name).stat().st_size, capsys.readouterr()
    (kept,) = re.findall("([0-9,]+) of 3,000", said.out)
    assert said.err.count(f"{name} clamps") == (name == "a.spz"), "of all tries, the written file is heard"
    assert 0.97 * asked <= size / 1e6 <= asked
    assert (2600 if name == "a.sundae" else 100) < int(kept.replace(",", "")) < 2710  # a pack holds nearly all
    assert sn.load(tmp_path / name).gaussians.sh_degree == (degree := 0 if name in ("a.ply", "a.spz") else 2)
    fits = {call.args[0].sh_degree for call in noted.call_args_list}  # make up for harmonics that go
    assert fits == (set() if name == "a.sundae" else {degree})
    if name != "a.html":  # whose code takes most of the time, and which is searched for as a .sundae is
        assert run(*words, "--max-mb", "9", "--overwrite") == 0
        said, size = capsys.readouterr(), (tmp_path / name).stat().st_size / 1e6
        assert "3,000 of 3,000" in said.out
        assert f"the whole scene takes {size:.2f} MB, less than was asked for" in said.err


def test_a_size_is_that_of_a_page_with_both_scenes_and_all_files(tmp_path, monkeypatch):
    scene = sn.Scene.from_points(*torch.rand(2, 1000, 3, generator=torch.Generator().manual_seed(0)))
    sn.save(scene, tmp_path / "a.ply")
    sn.save(dataclasses.replace(scene[:300], cameras=tuple(sn.virtual_cameras(scene, 3))), tmp_path / "b.sundae")
    bytes_of = Mock(side_effect=lambda path, one, two, views: path.write_bytes(one[2] + two[2]))
    monkeypatch.setattr("sundae_ns.cli.export.write_page", bytes_of)
    words, most = (tmp_path / "a.ply", tmp_path / "b.sundae", "-o", tmp_path / "site"), 15_000
    assert run("export", *words, "--max-mb", most / 1e6, "--cameras", tmp_path / "b.sundae") == 0
    assert 0.97 * most <= (tmp_path / "site").stat().st_size <= most


@pytest.mark.gpu
def test_prune_uses_the_gpu(tmp_path, monkeypatch):
    noted = Mock(side_effect=pruning.prune_with_mask)
    monkeypatch.setattr("sundae_ns.cli.inputs.prune_with_mask", noted)
    sn.save(sn.Scene.from_points(torch.rand(200, 3), torch.rand(200, 3)), tmp_path / "a.ply")
    for name in ("out.ply", "out.sundae"):
        assert run("prune", tmp_path / "a.ply", "-o", tmp_path / name, "--count", "50", "--num-cameras", "8") == 0
        assert sn.load(tmp_path / name).num_gaussians == 50
    assert [call.args[0].device.type for call in noted.call_args_list] == ["cuda", "cuda"]
