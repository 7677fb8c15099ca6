import importlib
import sys
import types
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from sundae_ns.core.errors import DataError
from sundae_ns.core.gaussians import SPLAT_NAMES
from sundae_ns.io.ply import is_nerfstudio_ply, read_ply, read_point_cloud, write_ply


def _gaussians(n=7, degree=3, seed=0):
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    return {
        "means": normal(n, 3),
        "scales": normal(n, 3),
        "quats": normal(n, 4),
        "features_dc": normal(n, 3),
        "features_rest": normal(n, (degree + 1) ** 2 - 1, 3),
        "opacities": normal(n, 1),
    }


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
@pytest.mark.parametrize("n", [0, 1, 50])
def test_round_trip_is_exact(tmp_path, n, degree):
    params = _gaussians(n, degree)
    write_ply(tmp_path / "a.ply", {**params, "features": torch.zeros(n, 13)})
    back = read_ply(tmp_path / "a.ply")
    assert tuple(back) == SPLAT_NAMES
    for name, value in params.items():
        assert back[name].dtype == torch.float32
        assert back[name].is_contiguous()
        assert torch.equal(back[name], value), name


def test_parameters_of_any_kind_are_written_as_float32(tmp_path):
    params = {name: torch.nn.Parameter(value.double()) for name, value in _gaussians().items()}
    write_ply(tmp_path / "a.ply", params)
    back = read_ply(tmp_path / "a.ply")
    assert all(torch.equal(back[name], params[name].detach().float()) for name in SPLAT_NAMES)


def test_layout(tmp_path):
    params = _gaussians(n=3, degree=1)
    write_ply(tmp_path / "a.ply", params, comments=["SplatRenderMode: mip"])
    data = PlyData.read(str(tmp_path / "a.ply"))
    assert data.byte_order == "<"
    assert data.comments == ["SplatRenderMode: mip"]
    vertex = data["vertex"]
    expected = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 " + " ".join(f"f_rest_{i}" for i in range(9))
    expected += " opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    assert [prop.name for prop in vertex.properties] == expected.split()
    # Channel-major: three coefficients of red, then those of green.
    np.testing.assert_array_equal(vertex["f_rest_1"], params["features_rest"][:, 1, 0])
    np.testing.assert_array_equal(vertex["f_rest_3"], params["features_rest"][:, 0, 1])
    np.testing.assert_array_equal(vertex["rot_0"], params["quats"][:, 0])


def test_same_vertices_as_nerfstudio_exports(tmp_path, monkeypatch):
    # The exporter needs open3d for meshes only, and open3d cannot be imported on every machine.
    monkeypatch.setitem(sys.modules, "open3d", types.ModuleType("open3d"))
    monkeypatch.delitem(sys.modules, "nerfstudio.scripts.exporter", raising=False)
    from nerfstudio.models.splatfacto import SplatfactoModel

    exporter = importlib.import_module("nerfstudio.scripts.exporter")
    params = _gaussians(n=9, degree=3)
    model = SplatfactoModel.__new__(SplatfactoModel)
    torch.nn.Module.__init__(model)
    model.gauss_params = torch.nn.ParameterDict(params)
    model.config = SimpleNamespace(sh_degree=3)
    pipeline = SimpleNamespace(model=model)
    monkeypatch.setattr(exporter, "eval_setup", lambda *_, **__: (None, pipeline, None, None))
    exporter.ExportGaussianSplat(load_config=tmp_path, output_dir=tmp_path).main()
    monkeypatch.delitem(sys.modules, "nerfstudio.scripts.exporter")

    write_ply(tmp_path / "ours.ply", params)
    ours, theirs = (PlyData.read(str(tmp_path / name))["vertex"].data for name in ("ours.ply", "splat.ply"))
    assert ours.dtype == theirs.dtype
    assert ours.tobytes() == theirs.tobytes()
    assert is_nerfstudio_ply(tmp_path / "splat.ply")
    assert not is_nerfstudio_ply(tmp_path / "ours.ply")


def test_other_properties_types_and_orders_are_read(tmp_path):
    params = _gaussians(n=4, degree=1)
    write_ply(tmp_path / "a.ply", params)
    vertices = PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    names = sorted(vertices.dtype.names, reverse=True)
    other = np.empty(4, dtype=[("segment", "<i4")] + [(name, ">f8") for name in names])
    for name in names:
        other[name] = vertices[name]
    PlyData([PlyElement.describe(other, "vertex")], byte_order=">").write(str(tmp_path / "b.ply"))
    back = read_ply(tmp_path / "b.ply")
    assert all(torch.equal(back[name], params[name]) for name in SPLAT_NAMES)


def _without(path, names):
    data = PlyData.read(str(path), mmap=False)["vertex"].data
    kept = [name for name in data.dtype.names if name not in names]
    PlyData([PlyElement.describe(np.array(data[kept].tolist(), [(k, "f4") for k in kept]), "vertex")]).write(str(path))


@pytest.mark.parametrize(
    ("names", "cause"),
    [
        (["opacity"], "lacks opacity"),
        (["scale_2"], "lacks scale_2"),
        (["f_rest_8"], "8 f_rest"),
        (["f_rest_0"], "8 f_rest"),
        (["f_rest_6", "f_rest_7", "f_rest_8"], "6 f_rest"),
    ],
)
def test_missing_properties(tmp_path, names, cause):
    path = tmp_path / "a.ply"
    write_ply(path, _gaussians(degree=1))
    _without(path, names)
    with pytest.raises(DataError, match=cause) as caught:
        read_ply(path)
    assert "\n" not in str(caught.value)


def _ascii(path):
    data = PlyData.read(str(path), mmap=False)
    data.text = True
    data.write(str(path))


WRONG = {
    "gone": (lambda path: path.unlink(), "cannot be read"),
    "a folder": (lambda path: (path.unlink(), path.mkdir()), "cannot be read"),
    "ascii": (_ascii, "ascii"),
    "truncated": (lambda path: path.write_bytes(path.read_bytes()[:-5]), "not a complete"),
    "empty": (lambda path: path.write_bytes(b""), "not a complete"),
    "an image": (lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n\xff\xfe" * 9), "not a complete"),
    "no vertices": (
        lambda path: path.write_bytes(b"ply\nformat binary_little_endian 1.0\nend_header\n"),
        "no vertices",
    ),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_files(tmp_path, wrong):
    change, cause = WRONG[wrong]
    path = tmp_path / "a.ply"
    write_ply(path, _gaussians())
    change(path)
    with pytest.raises(DataError, match=cause) as caught:
        read_ply(path)
    assert "\n" not in str(caught.value)


def _lists(path, element):
    """A field whose vertices, or another element, have a list property."""
    rows = PlyData.read(str(path))["vertex"].data.copy()
    faces = np.empty(len(rows), [("corners", "O")])
    faces["corners"] = [np.arange(3, dtype=np.int32)] * len(rows)
    if element == "vertex":
        more = np.empty(len(rows), [*rows.dtype.descr, ("corners", "O")])
        for name in rows.dtype.names:
            more[name] = rows[name]
        more["corners"] = faces["corners"]
        elements = [PlyElement.describe(more, "vertex")]
    else:
        elements = [PlyElement.describe(rows, "vertex"), PlyElement.describe(faces, element)]
    PlyData(elements).write(str(path))


@pytest.mark.parametrize("kind", ["vertex", "face", "ascii"])
def test_what_is_read_row_by_row_is_refused_by_the_header(tmp_path, monkeypatch, kind):
    path = tmp_path / "a.ply"
    write_ply(path, _gaussians())
    _ascii(path) if kind == "ascii" else _lists(path, kind)
    monkeypatch.setattr(PlyData, "read", lambda *_: pytest.fail("the rows were read"))
    with pytest.raises(
        DataError, match="ascii" if kind == "ascii" else f"property corners of each {kind} .* is a list"
    ):
        read_ply(path)
    if kind == "vertex":
        with pytest.raises(DataError, match="is a list"):
            read_point_cloud(path)


def test_faces_of_a_point_cloud_are_ignored(tmp_path):
    path = tmp_path / "a.ply"
    write_ply(path, _gaussians())
    _lists(path, "face")
    assert torch.equal(read_point_cloud(path)[0], _gaussians()["means"])
