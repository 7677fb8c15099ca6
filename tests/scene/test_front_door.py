"""``import sundae_ns``: its names, its doctests, the lines of README, and that none of it needs nerfstudio."""

import doctest
import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from fields import random_field
from short_prunes import SHORT

import sundae_ns as sn
from sundae_ns.head.head import CompensationHead, HeadConfig

ROOT = Path(__file__).parents[2]
WITHOUT_EXAMPLE = {"PruneRule", "Quality", "Rendering", "SundaeError", "distill"}
WITHOUT_NERFSTUDIO = """
import os, sys, torch
os.environ["HOME"] = os.getcwd()
sys.modules["nerfstudio"] = None
torch.set_default_dtype(torch.float64)
torch.set_default_device("meta")  # whose tensors have no values
import sundae_ns as sn
scene = sn.load("headed.sundae")
image = sn.render(scene, sn.Camera.look_at((2.0, 2.0, 2.0), (0.5, 0.5, 0.5), width=64, height=48)).rgb
assert image.dtype == torch.float32 and image.device.type == "cpu"
assert scene.head and "torch._dynamo" not in sys.modules  # the import of torch's compiler takes most of a second
points = sn.Scene.from_points([[0.0, 0, 0], [1, 2, 3]], [[0.1, 0.2, 0.3]] * 2)
for suffix in (".ply", ".spz", ".sog", ".glb"):
    sn.save(points, "~/points" + suffix)
    assert sn.load("points" + suffix).num_gaussians == 2
assert sn.measure(scene, [image], [sn.Camera.look_at((0, 0, 9), (0, 0, 0), width=64, height=48)]).ssim < 1
%s
exec(sys.stdin.read())
assert (torch.get_default_dtype(), torch.ones(1).device.type) == (torch.float64, "meta")
assert not any(name.split(".")[0] == "nerfstudio" and module for name, module in sys.modules.items())
"""


def five_lines(text):
    """The Python of the page's first block that imports the library."""
    blocks = re.findall(r"(?:^    .*\n|^\n)+", text, re.MULTILINE)
    block = next(block for block in blocks if "import sundae_ns as sn" in block)
    return "\n".join(line[4:] for line in block.splitlines())


@pytest.fixture
def garden(tmp_path):
    gaussians = random_field(200, features=0)
    gaussians["scales"] += 2
    sn.save(sn.Scene(gaussians), tmp_path / "garden.ply")
    # With a head for its one feature.
    head = CompensationHead(HeadConfig(size="tiny", num_features=1))
    sn.save(sn.Scene({**gaussians, "features": torch.zeros(200, 1)}, head), tmp_path / "headed.sundae")
    return tmp_path


def test_the_lines_of_the_pages_run_without_nerfstudio(garden):
    programs = [five_lines((ROOT / page).read_text()) for page in ("README.md", "sundae_ns/__init__.py")]
    for program in programs:
        for name in ("load", "prune", "render", "save"):
            assert f"sn.{name}(" in program
    code = [sys.executable, "-c", WITHOUT_NERFSTUDIO % SHORT]
    # Each in names of its own.
    told = "\n".join(
        f"exec({program!r}, {{}})\nimport os; os.rename('small.sundae', 'small-{number}.sundae')"
        for number, program in enumerate(programs)
    )
    done = subprocess.run(code, input=told, cwd=garden, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert [sn.load(garden / f"small-{number}.sundae").num_gaussians for number in range(2)] == [20, 20]


def test_every_public_name_is_there_and_documented():
    for name in sn.__all__:
        assert inspect.getdoc(getattr(sn, name)), name
        assert name in dir(sn)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        sn.nothing  # noqa: B018


@pytest.mark.usefixtures("short_prunes")
def test_the_lines_of_the_page_of_the_library_run(garden, monkeypatch):
    monkeypatch.chdir(garden)
    names = {}
    for block in re.findall(r"(?:^    .*\n|^\n)+", (ROOT / "docs" / "api.md").read_text(), re.MULTILINE):
        exec("\n".join(line[4:] for line in block.splitlines()), names)
    assert len(names["both"]) == 2 * len(names["near"]) < 2000
    assert "@@" not in Path("mine.html").read_text()


@pytest.mark.parametrize("name", [name for name in sn.__all__ if name not in WITHOUT_EXAMPLE])
def test_doctests(name):
    """Each public function has an example, and all examples run."""
    module = importlib.import_module(getattr(sn, name).__module__)
    finder = doctest.DocTestFinder(recurse=True)
    found = [test for test in finder.find(getattr(sn, name), name, module=module, globs={}) if test.examples]
    assert found, f"{name} has no example"
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    for test in found:
        torch.manual_seed(0)
        report = []
        assert runner.run(test, out=report.append).failed == 0, "".join(report)
