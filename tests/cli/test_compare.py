"""``sundae compare`` and ``sundae info`` of files, without a capture."""

import dataclasses
import json
import re
import sys
from pathlib import Path

import pytest
import torch
from command_line import run

import sundae_ns as sn
from sundae_ns.core.gaussians import bytes_of
from sundae_ns.io import formats
from sundae_ns.scene.compose import box_of


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A scene with cameras, packed; the same as .ply, and with half of its Gaussians."""
    folder, generator = tmp_path_factory.mktemp("scenes"), torch.Generator().manual_seed(0)
    scene = sn.Scene.from_points(torch.rand(300, 3, generator=generator), torch.rand(300, 3, generator=generator))
    cameras = tuple(sn.Camera.look_at((x, -3, 0.5), (0.5, 0.5, 0.5), width=48, height=32) for x in (0.0, 1.0, 2.0))
    sn.save(dataclasses.replace(scene, cameras=cameras), folder / "whole.sundae")
    sn.save(scene, folder / "whole.ply")
    sn.save(sn.prune(scene, keep=0.5, cameras=cameras), folder / "half.ply")
    return folder


def rows_of(text):
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    return [dict(zip(lines[0], row, strict=True)) for row in lines[2:]]


def test_files_are_compared_with_the_first_one(folder, tmp_path, capsys, caplog):
    words = (folder / "whole.sundae", folder / "whole.ply", folder / "half.ply")
    assert run("compare", *words, "-o", tmp_path / "out", "--min-psnr", 99) == 1
    said = capsys.readouterr()
    assert "below 99 dB: whole.ply, half.ply" in said.err
    first, ply, half = rows_of(said.out)
    assert (first["scene"], first["PSNR, dB"], first["Gaussians"]) == ("whole.sundae", "-", "300")
    assert "rendered with" not in first, "a column without figures is left out"
    assert float(half["worst, dB"]) <= float(half["PSNR, dB"]) < float(ply["PSNR, dB"]) < 99
    scenes = [sn.load(path) for path in words]
    cameras = scenes[0].cameras
    assert half["PSNR, dB"] == f"{sn.measure(scenes[2], scenes[0], cameras).psnr:.2f}"
    assert ply["MB"] == f"{(folder / 'whole.ply').stat().st_size / 1e6:.2f}"
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert page.count("<article") == 2 * len(cameras)
    assert 'aria-hidden="true">whole.sundae</span>' in page
    assert run("compare", *words, "--cameras", folder / "whole.sundae", "--num-cameras", 1, "--min-psnr", 5) == 0
    assert "scaled" not in caplog.text
    away = cameras[0], sn.Camera.look_at((0, 9, 0), (0, 99, 0), width=48, height=32)
    sn.save(dataclasses.replace(scenes[0], cameras=away), tmp_path / "away.sundae")
    assert run("compare", tmp_path / "away.sundae", words[2], "--min-psnr", 90) == 1, "an empty view proves nothing"
    assert "1 of 2 cameras see nothing of" in caplog.text
    moves = {"1 times .* 9 away; if it was moved or scaled": {"translation": (0, 9, 0)}, "3 times": {"scale": 3}}
    for told, change in moves.items():
        sn.save(sn.transform(scenes[1], **change), tmp_path / "other.ply")
        assert run("compare", words[1], tmp_path / "other.ply") == 0
        assert re.search(f"other.ply is {told}", caplog.messages[-1])


def test_formats_of_one_scene_are_one_table(folder, tmp_path, capsys, monkeypatch):
    """What cannot hold the scene is left out, and no report names the folder of the files."""
    monkeypatch.setitem(formats._WRITERS, ".glb", lambda path, *_: print(path, "lacks", file=sys.stderr))  # no file
    assert run("compare", folder / "whole.ply", "--formats", "-o", tmp_path / "out") == 1
    said, warned = capsys.readouterr()
    assert f"{folder}/whole.ply as .glb lacks\n" in warned
    rows = {row["scene"]: row for row in rows_of(said)}
    assert list(rows) == ["whole.ply", "whole.spz", "whole.sog", "whole.sundae"]
    assert float(rows["whole.sundae"]["PSNR, dB"]) > float(rows["whole.spz"]["PSNR, dB"]) > 25
    assert "- Left out: whole.glb: whole.glb cannot be read" in said
    assert {row["source"] for row in json.loads((tmp_path / "out/report.json").read_text())} == {f"{folder}/whole.ply"}


COSTS = {
    "prune whole.sundae -o a.spz --keep 0.5": "against the whole scene on 3 cameras",
    "prune whole.ply -o b.html --keep 0.5": "against the whole scene on 16 held-out cameras",
    "prune whole.ply -o c.sundae --distill --steps 1 --no-head": "against the whole scene on 16 held-out cameras",
    "export whole.ply -o d.ply --crop 0 0 0 1 1 0.5": "100.0 dB, 1.000 against the scene in the box on 16 held-out",
    "export whole.ply -o e --cameras whole.sundae": "against the whole scene on 3 cameras",
    "pack whole.ply -o f.sundae": "against the whole scene on 16 held-out cameras",
    "export whole.sundae -o g.html": None,
    "export whole.sundae -o g.ply": None,
}


@pytest.mark.usefixtures("short_distillation")
def test_commands_say_what_a_change_costs(folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    for words, expected in COSTS.items():
        assert run(*words.split()) == 0
        said = capsys.readouterr().out.splitlines()
        assert (" MB (of " in said[-1]) == (expected is not None), words
        assert expected is None or expected in said[-1], words
        if words.startswith("prune whole.sundae"):
            assert run("compare", "whole.sundae", "a.spz") == 0
            row = rows_of(capsys.readouterr().out)[1]
            figures = [float(row[name]) for name in ("MB", "PSNR, dB", "SSIM", "worst, dB")]
            found = re.fullmatch(r"(.*) MB \(of .*\); (.*) dB, (.*) against .*, worst (.*)", said[-1])
            assert [float(value) for value in found.groups()] == pytest.approx(figures, abs=0.051)
        assert " -o e" not in words or said[-2].endswith(f"; scene: {(folder / 'e/scene.sundae').stat().st_size:,}")
    assert (sn.load("b.html").num_gaussians, len(sn.load("e/scene.sundae").cameras)) == (150, 3)


def facts_of(path, capsys):
    assert run("info", path, "--json") == 0
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def test_info_says_what_a_file_holds(folder, capsys, monkeypatch):
    with monkeypatch.context() as patch:
        patch.delattr(Path, "read_bytes")  # a whole file may be larger than the memory
        facts, scene = facts_of(folder / "whole.ply", capsys), sn.load(folder / "whole.ply")
    assert (facts["gaussians"], facts["sh_degree"], facts["stored_cameras"]) == (300, 0, 0)
    assert sum(facts["bytes_by_attribute"].values()) == bytes_of(scene.gaussians)
    assert facts["low"] == pytest.approx(scene.gaussians["means"].amin(dim=0).tolist())
    frame = {"transform": [[1, 0, 0, -50000.451], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": 1.0}
    sn.save(dataclasses.replace(scene, meta={"frame": frame}), folder / "survey.ply")
    for name, seen_by in (("whole.sundae", "3 cameras"), ("survey.ply", "64 virtual cameras")):
        assert run("info", folder / name) == 0
        said, warned = capsys.readouterr()
        assert f"invisible             0.0% of the Gaussians, to {seen_by}" in said
        assert not warned, "a bar leaves no line where stderr is no terminal"
        box = said.partition("--crop ")[2].split()[:6]
        assert run("export", folder / name, "-o", folder / "cut.spz", "--crop", *box, "--overwrite") == 0
        assert sn.load(folder / "cut.spz").num_gaussians > 290
        capsys.readouterr()


def test_a_packed_scene_and_its_page_are_packed_again(folder, tmp_path, capsys):
    """A page holds the bytes of its scene, in base64, and its code."""
    whole, page, again = folder / "whole.sundae", tmp_path / "page.html", tmp_path / "again.sundae"
    assert run("export", whole, "-o", page) == run("pack", page, "-o", again, "--max-cameras", 1) == 0
    parts, packed = (facts_of(path, capsys)["bytes_by_attribute"] for path in (page, whole))
    assert parts.pop("page") > 1.3 * whole.stat().st_size > 1.3 * sum(packed.values())
    assert parts == packed
    assert [facts_of(again, capsys)[name] for name in ("gaussians", "stored_cameras")] == [300, 1]


def test_a_box_holds_the_share_that_is_asked_for():
    generator = torch.Generator().manual_seed(0)
    means, weights = 20 * torch.randn(5000, 3, generator=generator).double(), torch.rand(5000, generator=generator)
    weights[means[:, 0] > 40] = 0  # what nobody sees does not count
    numbers = box_of(means, weights, 0.9)
    box = torch.tensor(numbers)
    inside = ((means >= box[:3]) & (means <= box[3:])).all(dim=1)
    assert 0.9 <= float(weights[inside].sum() / weights.sum()) < 0.95
    assert box[3] < 40
    assert numbers == [round(number, 2) for number in numbers], "they are short"
    assert box_of(torch.ones(2, 3), torch.ones(2)) == [1.0] * 3 + [1.001] * 3, "a box of no width would be refused"
