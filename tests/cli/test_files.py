"""``sundae export`` and ``sundae prune``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement
from torch import Tensor

from sundae_ns.cli import main
from sundae_ns.gaussians import SPLAT_NAMES, from_points
from sundae_ns.gaussians.parameters import SH_C0
from sundae_ns.storage import is_nerfstudio_ply, read_ply, write_ply
from sundae_ns.storage.packing import Scene, read_scene, write_scene


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as caught:
        main([str(argument) for argument in arguments])
    assert isinstance(caught.value.code, int)
    return caught.value.code


def field(n: int = 200) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(n, 3, generator=generator)
    made = from_points(points, points, sh_degree=1, num_features=3, generator=generator)
    made["features_rest"] = torch.randn(n, 3, 3, generator=generator)
    return made


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_export_of_a_packed_scene(tmp_path: Path, mode: str) -> None:
    write_scene(tmp_path / "a.sundae", Scene(field(), meta={"model": {"rasterize_mode": mode}}))
    assert run("export", tmp_path / "a.sundae", "-o", tmp_path / "a.ply") == 0
    found, truth = read_ply(tmp_path / "a.ply"), read_scene(tmp_path / "a.sundae").field
    assert all(torch.equal(found[name], truth[name]) for name in SPLAT_NAMES)
    assert is_nerfstudio_ply(tmp_path / "a.ply")
    assert ("SplatRenderMode: mip" in PlyData.read(tmp_path / "a.ply").comments) == (mode == "antialiased")


@pytest.mark.parametrize("kind", [".spz", ".sog"])
def test_export_to_other_formats(tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    model = {"rasterize_mode": "antialiased", "sh_degree": 1}
    write_scene(tmp_path / "a.sundae", Scene(field(), meta={"model": model}))
    out = tmp_path / f"a{kind}"
    assert run("export", tmp_path / "a.sundae", "-o", out) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert f"a{kind}: 200 primitives, degree 1, antialiased, {out.stat().st_size:,} bytes" in said
    assert out.read_bytes()[:2] == {".spz": b"\x1f\x8b", ".sog": b"PK"}[kind]


def test_export_of_a_model_without_harmonics(tmp_path: Path) -> None:
    given = field()
    given["features_rest"] = given["features_rest"][:, :0]
    write_scene(tmp_path / "a.sundae", Scene(given, meta={"model": {"sh_degree": 0}}))
    assert run("export", tmp_path / "a.sundae", "-o", tmp_path / "a.ply", "--upright") == 0
    truth = read_scene(tmp_path / "a.sundae").field
    found = read_ply(tmp_path / "a.ply")
    # Such a model keeps logits of colours, and a .ply the harmonic of band 0.
    torch.testing.assert_close(0.5 + SH_C0 * found["features_dc"], truth["features_dc"].sigmoid(), rtol=0, atol=1e-6)
    torch.testing.assert_close(found["means"][:, 1], -truth["means"][:, 2])


@pytest.mark.parametrize(
    "options", [[], ["--score", "opacity", "--selection", "top"], ["--score", "response", "--selection", "band"]]
)
def test_prune_keeps_rows_as_they_are(tmp_path: Path, options: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    source, out = tmp_path / "in.ply", tmp_path / "out.ply"
    write_ply(source, field(), comments=["SplatRenderMode: mip", "by a stranger"])
    # A property that 3DGS does not know, and an element beside the vertices.
    data = PlyData.read(source)
    rows = data["vertex"].data
    more = np.empty(len(rows), [*rows.dtype.descr, ("label", "<i4")])
    for name in rows.dtype.names:
        more[name] = rows[name]
    more["label"] = np.arange(len(rows))
    more["opacity"][3] = np.nan
    other = PlyElement.describe(np.array([(7,)], [("number", "<i4")]), "extra")
    PlyData([PlyElement.describe(more, "vertex"), other], comments=data.comments).write(str(source))

    assert run("prune", source, "-o", out, "--keep", "0.25", *options) == 0
    text = capsys.readouterr().out
    assert "50 of 200 primitives" in text
    assert "1 were not finite" in text
    found = PlyData.read(out)
    assert found.comments == ["SplatRenderMode: mip", "by a stranger"]
    assert found["extra"].data["number"].tolist() == [7]
    kept = found["vertex"].data
    assert len(kept) == 50
    assert 3 not in kept["label"]
    assert np.array_equal(kept, more[kept["label"]])
    if "opacity" in options:
        others = np.delete(more["opacity"], [3, *kept["label"]])
        assert kept["opacity"].min() >= others.max()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["prune", "nothing.ply", "-o", "a.ply"], "nothing.ply cannot be read"),
        (["prune", "in.ply", "-o", "a.ply", "--keep", "0"], "keep_ratio is 0.0"),
        (["prune", "in.ply", "-o", "a.spz"], "not named .ply"),
        (["prune", "in.ply", "-o", "no/a.ply"], "no is no folder"),
        (["export", "in.ply", "-o", "a.splat"], "not named .ply or .spz or .sog"),
        (["export", "in.ply", "-o", "no/a.sog"], "no is no folder"),
        (["export", "in.ply", "-o", "a.ply"], "not a run's config.yml"),
        (["export", "nothing.sundae", "-o", "a.ply"], "nothing.sundae cannot be read"),
    ],
)
def test_refusals_are_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    says: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    write_ply(Path("in.ply"), field())
    assert run(*arguments) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert says in line
    assert [path.name for path in tmp_path.iterdir()] == ["in.ply"]
