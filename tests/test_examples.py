"""The programs in ``examples/`` run, and show what they say."""

import ast
import json
import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from packed_scenes import KINDS, write_kind
from PIL import Image

import sundae_ns as sn

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture
def run(short_prunes, monkeypatch, capsys):
    """Run a program in this process; returns what it printed."""

    def run(name, *words):
        monkeypatch.setattr(sys, "argv", [name, *map(str, words)])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out

    return run


@pytest.fixture(scope="module")
def cloud(tmp_path_factory):
    """A ball of smooth colours."""
    points = torch.nn.functional.normalize(torch.randn(600, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    scene = sn.Scene.from_points(points, 0.5 + 0.4 * points)
    scene.gaussians["opacities"] += 4
    sn.save(scene, path := tmp_path_factory.mktemp("examples") / "cloud.ply")
    return path


def test_every_example_is_tested():
    programs = {"plot_curve.py", "prune_ply.py", "render_packed.py"}
    assert {path.name for path in EXAMPLES.iterdir() if path.is_file()} == {"notebook.ipynb", *programs}


def test_prune_ply(run, cloud, tmp_path):
    text = run("prune_ply.py", cloud, tmp_path / "a.spz", "--keep", 0.5, "--cameras", 8)
    assert "300 of 600 Gaussians" in text
    assert float(re.findall(r"PSNR ([\d.]+) dB", text)[0]) > 20
    assert sn.load(tmp_path / "a.spz").num_gaussians == 300


def test_render_packed(run, tmp_path):
    packed = write_kind(tmp_path / "a.sundae", KINDS["residual"])
    assert "tiny head" in run("render_packed.py", packed, tmp_path / "a.png", "--camera", 1)
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.size == (3 * 50, 37)


def test_plot_curve(run, cloud, tmp_path):
    text = run("plot_curve.py", cloud, tmp_path / "a.png", "--cameras", 4)
    quality = [float(value) for value in re.findall(r"merged: [\d,]+ Gaussians, ([\d.]+) dB", text)]
    assert len(quality) == 10
    assert quality[4] > quality[0]
    assert Image.open(tmp_path / "a.png").size == (750, 525)


@pytest.mark.usefixtures("short_prunes")
def test_the_notebook():
    notebook = json.loads((EXAMPLES / "notebook.ipynb").read_text(encoding="utf-8"))
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert not [cell for cell in cells if cell["outputs"]], "the repository keeps no outputs"
    names, shown = {}, []
    for cell in cells:
        *statements, last = ast.parse("".join(cell["source"])).body
        exec(compile(ast.Module(statements, []), "cell", "exec"), names)
        shown.append(eval(compile(ast.Expression(last.value), "cell", "eval"), names))
    assert shown[:2] == [2000, 500]
    assert float(re.findall(r"PSNR ([\d.]+) dB", shown[2])[0]) > 20
    assert np.asarray(shown[3]).std() > 5
    assert shown[4]._repr_html_().startswith('<iframe srcdoc="')
