"""Files for other viewers, read by PlayCanvas's splat-transform if it is installed."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from sundae_ns.errors import ConfigError
from sundae_ns.gaussians import from_points
from sundae_ns.gaussians.gaussians import Field
from sundae_ns.rasterization.reference import harmonic_basis
from sundae_ns.storage.formats import ANTIALIASED, FORMATS, write_for_viewers
from sundae_ns.storage.ply import is_nerfstudio_ply, read_ply, write_ply

PROGRAM = shutil.which("splat-transform")
other_program = pytest.mark.skipif(
    PROGRAM is None, reason="splat-transform is not in PATH: npm install -g @playcanvas/splat-transform (node 22)"
)


def field(n: int = 300, degree: int = 3) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)
    points = 4 * torch.rand(n, 3, generator=generator) - 2
    made = from_points(points, points / 4 + 0.5, sh_degree=degree, num_features=3, generator=generator)
    made["quats"] = torch.nn.functional.normalize(torch.randn(n, 4, generator=generator), dim=1)
    made["scales"] = -5 + torch.randn(n, 3, generator=generator)
    made["features_rest"] = 0.1 * torch.randn(made["features_rest"].shape, generator=generator)
    made["opacities"] = 2 * torch.randn(n, 1, generator=generator)
    return made


def header(path: Path) -> str:
    return path.read_bytes().partition(b"end_header")[0].decode()


@other_program
@pytest.mark.parametrize(
    ("kind", "degree", "antialiased"),
    [
        (".ply", 3, True),
        (".ply", 0, False),
        (".spz", 3, True),
        (".spz", 0, False),
        (".sog", 3, True),
        (".sog", 0, False),
    ],
)
def test_another_program_reads_the_same_scene(tmp_path: Path, kind: str, degree: int, antialiased: bool) -> None:
    truth = field(degree=degree)
    file, back = tmp_path / f"a{kind}", tmp_path / "back.ply"
    written = write_for_viewers(file, truth, antialiased=antialiased)
    assert written == (300, 0, degree, False, file.stat().st_size)
    subprocess.run([str(PROGRAM), "--quiet", str(file), str(back)], check=True, capture_output=True, timeout=120)
    assert (ANTIALIASED in header(back)) == antialiased
    found = read_ply(back)
    assert {name: value.shape for name, value in found.items()} == {name: truth[name].shape for name in found}
    rows = torch.from_numpy(cKDTree(found["means"].numpy()).query(truth["means"].numpy())[1])
    assert len(rows.unique()) == 300
    found = {name: value[rows] for name, value in found.items()}
    found["quats"] = found["quats"] * (found["quats"] * truth["quats"]).sum(dim=1, keepdim=True).sign()
    found["opacities"], opacities = found["opacities"].sigmoid(), truth["opacities"].sigmoid()
    # Measured worst cases of both formats: 5e-5, 0.0045, 0.0312, 0.0130, 0.0078, 0.0020.
    tolerances = {"means": 1e-4, "quats": 0.006, "scales": 0.033, "features_dc": 0.015, "features_rest": 0.009}
    for name, tolerance in {**tolerances, "opacities": 0.0021}.items():
        expected = opacities if name == "opacities" else truth[name]
        torch.testing.assert_close(found[name], expected, rtol=0, atol=0 if kind == ".ply" else tolerance, msg=name)


@pytest.mark.parametrize("kind", FORMATS)
def test_primitives_that_are_not_finite_are_dropped(tmp_path: Path, kind: str) -> None:
    given = field()
    given["means"][3, 0] = torch.nan
    given["scales"][7, 1] = torch.inf
    given["scales"][9, 1] = -torch.inf  # a flat primitive
    written = write_for_viewers(tmp_path / f"a{kind}", given)
    assert (written.primitives, written.dropped) == (298, 2)


@pytest.mark.parametrize(("kind", "degree"), [(".ply", 4), (".spz", 3), (".sog", 3)])
def test_sh_degree_4_is_cut_to_the_format(tmp_path: Path, kind: str, degree: int) -> None:
    given = field(degree=3)
    given["features_rest"] = torch.cat([given["features_rest"], torch.ones(300, 9, 3)], dim=1)
    written = write_for_viewers(tmp_path / f"a{kind}", given)
    assert (written.degree, written.cut) == (degree, degree == 3)


def test_colours_of_models_of_sh_degree_0(tmp_path: Path) -> None:
    given = field(degree=0)
    write_for_viewers(tmp_path / "a.ply", Field(given, "logits"))
    colors = 0.5 + 0.28209479 * read_ply(tmp_path / "a.ply")["features_dc"]
    torch.testing.assert_close(colors, given["features_dc"].sigmoid(), rtol=0, atol=1e-6)


def test_upright_rotates_z_to_minus_y(tmp_path: Path) -> None:
    given = field(degree=1)
    given["means"][0] = torch.tensor([1.0, 2.0, 3.0])
    write_for_viewers(tmp_path / "a.ply", given)
    write_for_viewers(tmp_path / "b.ply", given, upright=True)
    assert is_nerfstudio_ply(tmp_path / "a.ply")
    assert not is_nerfstudio_ply(tmp_path / "b.ply")
    turned = read_ply(tmp_path / "b.ply")
    torch.testing.assert_close(turned["means"][0], torch.tensor([1.0, -3.0, 2.0]))
    # SH rotate, too: from above, along +z before and -y after, the colours are the same.
    above, turned_above = (harmonic_basis(1, torch.tensor([d]))[0, 1:] for d in ([0.0, 0.0, 1.0], [0.0, -1.0, 0.0]))
    before = torch.einsum("k,nkc->nc", above, given["features_rest"])
    after = torch.einsum("k,nkc->nc", turned_above, turned["features_rest"])
    torch.testing.assert_close(after, before, rtol=0, atol=1e-5)


def test_other_suffixes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"name it .ply or .spz or .sog or .glb"):
        write_for_viewers(tmp_path / "a.splat", field())


def test_suffixes_in_capitals(tmp_path: Path) -> None:
    write_for_viewers(tmp_path / "a.PLY", field())
    write_ply(tmp_path / "b.ply", field())
    assert torch.equal(read_ply(tmp_path / "a.PLY")["means"], read_ply(tmp_path / "b.ply")["means"])
