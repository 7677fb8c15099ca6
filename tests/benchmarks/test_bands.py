"""``bands.py`` on a field without a run: files, statistics and error messages."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from bands import bands, base_colors
from PIL import Image
from plyfile import PlyData
from prunes import decide_share
from torch import Tensor

from harness.script import run_script
from sundae_ns.gaussians import from_points
from sundae_ns.pruning import PruneRule, band_rule, response
from sundae_ns.storage.ply import read_ply, read_point_cloud, write_ply

N = 300


@pytest.fixture(autouse=True)
def _command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["bands.py"])


def run(*arguments: object) -> int:
    sys.argv[1:] = map(str, arguments)
    with pytest.raises(SystemExit) as caught:
        run_script(bands, "")
    assert isinstance(caught.value.code, int)
    return caught.value.code


def field(n: int = N) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)
    points, colors = torch.randn(n, 3, generator=generator), torch.rand(n, 3, generator=generator)
    return from_points(points, colors, sh_degree=1, num_features=0, generator=generator)


@pytest.fixture
def ply(tmp_path: Path) -> Path:
    params = field()
    params["means"][[3, 50]] = torch.nan
    write_ply(tmp_path / "field.ply", params)
    return tmp_path / "field.ply"


def test_files_and_statistics_agree(ply: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "deep" / "er"
    assert run(ply, "-o", out, "--keep-ratio", 0.1, 0.5, "--gamma", 0.3, "--neighbors", 9) == 0
    result: dict[str, Any] = json.loads((out / "bands.json").read_text())
    assert {*result["files"], "bands.json"} == {path.name for path in out.iterdir()}
    assert (result["primitives"], result["not_finite"], result["num_neighbors"]) == (N, 2, 9)
    assert "wrote bands.json" in capsys.readouterr().out

    params = {name: value[torch.isfinite(x_of(ply))] for name, value in read_ply(ply).items()}
    rule = PruneRule(signal="positions", num_neighbors=9)
    magnitude = response(params, band_rule(rule, 0.3))
    known = magnitude[magnitude.isfinite()]
    assert result["response"]["known"] == len(known)
    assert result["isolated"] == len(magnitude) - len(known)
    assert result["response"]["quantiles"]["0.5"] == pytest.approx(float(known.median()), rel=0.02)
    points, colors = read_point_cloud(out / "all.ply")
    assert torch.equal(points, params["means"])
    assert torch.equal(colors, base_colors(params["features_dc"]))
    for figures, keep_ratio in zip(result["bands"], (0.1, 0.5), strict=True):
        count = round(keep_ratio * (N - 2))
        masks = {}
        for name, gamma in (("high", 1.0), ("low", 0.0), ("combined", 0.3)):
            masks[name] = decide_share(params, band_rule(rule, gamma), keep_ratio).mask
            found = PlyData.read(str(out / f"{name}-{keep_ratio}.ply"))["vertex"]
            kept = torch.from_numpy(np.stack([found["x"], found["y"], found["z"]], axis=1))
            assert torch.equal(kept, params["means"][masks[name]])
            expected = magnitude[masks[name]].nan_to_num(nan=-1).float()
            assert torch.equal(torch.from_numpy(found["response"].copy()), expected)
            assert figures["kept"][name] == len(kept) == count
        assert figures["overlap"]["high and low"] == int((masks["high"] & masks["low"]).sum())
        assert figures["overlap"]["combined and high"] == round(0.3 * count)
        assert figures["high_from"] == float(magnitude[masks["high"]].min())
        with Image.open(out / f"bands-{keep_ratio}.png") as sheet:
            assert len(sheet.getcolors(sheet.width * sheet.height)) > 100
    with Image.open(out / "response.png") as histogram:
        assert histogram.width > 500


def x_of(ply: Path) -> Tensor:
    """The x coordinate of each primitive ``[N]``; NaN if the primitive is not finite."""
    return read_ply(ply)["means"][:, 0]


def test_the_signal_changes_the_choice(ply: Path, tmp_path: Path) -> None:
    for signal in ("positions", "attributes"):
        assert run(ply, "-o", tmp_path / signal, "--signal", signal, "--keep-ratio", 0.2) == 0
    clouds = [read_point_cloud(tmp_path / signal / "high-0.2.ply")[0] for signal in ("positions", "attributes")]
    assert not torch.equal(*clouds)


def test_colours_are_those_of_degree_0_harmonics() -> None:
    assert base_colors(torch.tensor([[0.0, 1e9, -1e9]])).tolist() == [[128, 255, 0]]
    assert base_colors(torch.ones(2, 3)).tolist() == [[round(255 * (0.5 + 0.28209479))] * 3] * 2


@pytest.mark.parametrize("source", ["checkpoint", "folder"])
def test_colours_of_checkpoints_without_harmonics_are_read_from_logits(tmp_path: Path, source: str) -> None:
    """A stock checkpoint of SH degree 0 stores logits; the point cloud has the colours that splatfacto renders."""
    params = field(30)
    params["features_rest"] = params["features_rest"][:, :0]
    params["features_dc"] = torch.randn(30, 3, generator=torch.Generator().manual_seed(1))
    checkpoint = tmp_path / "step-000000100.ckpt"
    state = {f"_model.gauss_params.{name}": value for name, value in params.items()}
    torch.save({"step": 100, "pipeline": state}, checkpoint)
    path = checkpoint if source == "checkpoint" else tmp_path
    assert run(path, "-o", tmp_path / "out", "--keep-ratio", 0.5) == 0
    _, colors = read_point_cloud(tmp_path / "out" / "all.ply")
    expected = 255 * params["features_dc"].sigmoid()
    assert (colors - expected).abs().max() <= 0.5 + 1e-3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--keep-ratio", "0"), "keep_ratio is 0.0: use a share"),
        (("--keep-ratio", "0.1", "1.5"), "keep_ratio is 1.5: use a share"),
        (("--keep-ratio",), "nothing to keep"),
        (("--gamma", "2"), "gamma is 2.0"),
        (("--neighbors", "0"), "num_neighbors is 0"),
        (("--view", "1"), "no training view 1: the field has no run"),
    ],
)
def test_options_that_cannot_work(
    ply: Path, tmp_path: Path, options: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(ply, "-o", tmp_path / "out", *options) == 2
    error = capsys.readouterr().err
    assert error.startswith("sundae: ")
    assert message in error
    assert error.count("\n") == 1


def test_fields_that_cannot_be_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tmp_path / "gone", "-o", tmp_path / "out") == 2
    write_ply(tmp_path / "one.ply", field(1))
    assert run(tmp_path / "one.ply", "-o", tmp_path / "out") == 2
    params = field(5)
    params["means"][:] = torch.nan
    write_ply(tmp_path / "nan.ply", params)
    assert run(tmp_path / "nan.ply", "-o", tmp_path / "out") == 2
    (tmp_path / "file").touch()
    write_ply(tmp_path / "few.ply", field(5))
    assert run(tmp_path / "few.ply", "-o", tmp_path / "file") == 2
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 4
    assert all(error.startswith("sundae: ") for error in errors)
    assert "5 primitives, and none is finite" in errors[2]
    # A field with fewer primitives than neighbours works.
    assert run(tmp_path / "few.ply", "-o", tmp_path / "out") == 0
