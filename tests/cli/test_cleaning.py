"""``--crop`` and ``--remove-floaters`` of ``sundae prune``, ``pack`` and ``export``."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from command_line import refusal, run
from numpy.lib.recfunctions import append_fields
from PIL import Image
from plyfile import PlyData, PlyElement

import sundae_ns as sn

INSIDE = ("--crop", 0, 0, 0, 0.5, 1, 1)


def scene(n=400):
    """Points of a cube of side 1, and one far beside it."""
    generator = torch.Generator().manual_seed(0)
    points = torch.cat([torch.rand(n, 3, generator=generator), torch.tensor([[3.0, 0.5, 0.5]])])
    made = sn.Scene.from_points(points, points.sigmoid())
    made.gaussians["scales"][:] = math.log(0.05)
    cameras = tuple(sn.Camera.look_at((x, -3, 0.5), (0.5, 0.5, 0.5), width=64, height=48) for x in (0.0, 1.0, 2.0))
    return dataclasses.replace(made, cameras=cameras)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The scene as ``.ply`` with a property and an element of its own and a broken Gaussian, and as ``.sundae``."""
    folder = tmp_path_factory.mktemp("scenes")
    sn.save(scene(), folder / "packed.sundae")
    sn.save(scene(), folder / "plain.ply")
    rows = vertices(folder / "plain.ply")[[0, *range(401)]]
    rows["x"][0] = np.nan
    wider = append_fields(rows, "mine", np.arange(402, dtype="f4"), usemask=False)
    other = PlyElement.describe(np.array([(7,)], [("number", "<i4")]), "extra")
    PlyData([PlyElement.describe(wider, "vertex"), other], comments=["by another program"]).write(folder / "a.ply")
    return folder


def vertices(path):
    return PlyData.read(path)["vertex"].data


def test_export_cuts_a_ply_and_keeps_its_rows(folder, tmp_path, capsys):
    before = vertices(folder / "a.ply")
    assert run("export", folder / "a.ply", "-o", tmp_path / "a.ply", *INSIDE) == 0
    inside = (before["x"] >= 0) & (before["x"] <= 0.5)
    assert np.array_equal(vertices(tmp_path / "a.ply"), before[inside])
    said = capsys.readouterr()
    assert f"{tmp_path / 'a.ply'}: {int(inside.sum()):,} Gaussians, degree " in said.out
    assert f"{int(inside.sum())} of 401 Gaussians are in the box" in said.err
    assert run("export", folder / "a.ply", "-o", tmp_path / "b.ply", "--remove-floaters") == 0
    assert np.array_equal(vertices(tmp_path / "b.ply"), before[1:401])
    assert "removed 1 floaters of 401 Gaussians, by their neighbours alone" in capsys.readouterr().err
    PlyData([*PlyData.read(folder / "a.ply")], text=True).write(tmp_path / "text.ply")
    assert run("export", tmp_path / "text.ply", "-o", tmp_path / "c.ply") == 0
    assert "text.ply is text or has no SH colours; columns of its own are left out" in capsys.readouterr().err


def test_export_to_a_page_and_to_other_formats(folder, tmp_path):
    for name in ("site", "a.spz", "b.ply"):
        assert run("export", folder / "packed.sundae", "-o", tmp_path / name, "--remove-floaters") == 0
    assert run("export", folder / "packed.sundae", "-o", tmp_path / "c.spz", *INSIDE) == 0
    assert len(found := sn.load(tmp_path / "site" / "scene.sundae")) <= 400
    assert float(found.gaussians["means"].max()) < 1.1
    assert len(found.cameras) == 3
    assert [len(sn.load(tmp_path / name)) for name in ("a.spz", "b.ply")] == [len(found)] * 2
    assert len(sn.load(tmp_path / "c.spz")) == int((sn.load(folder / "packed.sundae").means[:, 0] <= 0.5).sum())


def test_a_preview_shows_what_cleaning_changes_most(folder, tmp_path, capsys):
    """Both images side by side, by the camera that sees most of what goes."""
    words, shown = ("export", folder / "packed.sundae", "-o"), tmp_path / "shown.png"
    assert "shows what --remove-floaters changes" in refusal(capsys, *words, tmp_path / "a.spz", "--preview", shown)
    assert "name it .png" in refusal(capsys, *words, tmp_path / "a.spz", "--preview", "a.jpg", "--remove-floaters")
    assert run(*words, tmp_path / "a.spz", "--preview", shown, "--remove-floaters") == 0
    before = sn.load(folder / "packed.sundae")
    scenes = (before, sn.remove_floaters(before))
    pairs = [[sn.render(each, camera).rgb for each in scenes] for camera in before.cameras]
    most = max(pairs, key=lambda pair: float((pair[0] - pair[1]).square().mean()))
    found = np.asarray(Image.open(shown), np.float32) / 255
    np.testing.assert_allclose(found, torch.cat(most, dim=1).numpy(), atol=0.01)
    assert found.shape == (48, 128, 3)
    assert np.abs(found[:, :64] - found[:, 64:]).max() > 0.05
    assert run(*words, tmp_path / "b.spz", "--preview", shown, "--remove-floaters") == 2
    assert f"{shown} exists" in capsys.readouterr().err


def test_prune_keeps_a_share_of_what_remains(folder, tmp_path, capsys):
    before = vertices(folder / "a.ply")
    inside = before["mine"][before["x"] <= 0.5]
    words = ("--keep", 0.5, "--num-cameras", 4, *INSIDE)
    assert run("prune", folder / "a.ply", "-o", tmp_path / "a.ply", *words) == 0
    found = vertices(tmp_path / "a.ply")["mine"]
    assert len(found) == round(0.5 * len(inside)) == len(np.unique(found))
    assert set(found) <= set(inside)
    assert f"{len(found)} of 402 Gaussians" in capsys.readouterr().out
    assert run("prune", folder / "a.ply", "-o", tmp_path / "b.ply", "--keep", 1, "--remove-floaters", *INSIDE) == 0
    assert np.array_equal(vertices(tmp_path / "b.ply")["mine"], inside)
    words = ("--redistribution", "none", "--score", "response", "--selection", "band")
    assert run("prune", folder / "a.ply", "-o", tmp_path / "d.ply", "--keep", 0.25, *words) == 0
    whole = PlyData.read(tmp_path / "d.ply")
    assert whole.comments == ["by another program", "Vertical axis: 0 -1 0"]
    assert whole["extra"].data["number"].tolist() == [7]
    assert len(kept := whole["vertex"].data) == 100
    assert np.array_equal(kept, before[kept["mine"].astype(int)]), "kept rows do not change"
    assert run("prune", folder / "packed.sundae", "-o", tmp_path / "c.spz", "--count", 20, "--remove-floaters") == 0
    assert len(found := sn.load(tmp_path / "c.spz")) == 20
    assert float(found.gaussians["means"].max()) < 1.2


def test_pack_cuts_and_a_scene_that_is_all_floaters_is_refused(folder, tmp_path, capsys):
    assert run("pack", folder / "a.ply", "-o", tmp_path / "a.sundae", "--remove-floaters", *INSIDE[:4], 9, 9, 9) == 0
    assert sn.load(tmp_path / "a.sundae").num_gaussians == 400
    beside = sn.Camera.look_at((3, -3, 0.5), (3, 0.5, 0.5), fov=10, width=64, height=48)
    sn.save(dataclasses.replace(scene(), cameras=(beside,)), tmp_path / "b.sundae")
    assert run("export", tmp_path / "b.sundae", "-o", tmp_path / "b.spz", "--remove-floaters") == 2
    assert "all Gaussians float" in capsys.readouterr().err
