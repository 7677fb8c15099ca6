"""The .ply of Gaussians and of points: layout, what other programs write, and refusals in one line."""

from __future__ import annotations

import importlib
import sys
import types
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from foreign_files import small_field
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from sundae_ns.core.errors import DataError
from sundae_ns.core.gaussians import SPLAT_NAMES
from sundae_ns.io.ply import MODEL_FRAME, is_nerfstudio_ply, ply_comments, read_ply, read_point_cloud, write_ply

XYZ = np.array([[0.5, -1.25, 2.0], [3.0, 4.0, -5.5]], np.float32)
RGB = np.array([[0, 128, 255], [10, 20, 30]], np.uint8)


def write_rows(path: Path, columns: dict[str, NDArray[Any]], **options: Any) -> None:
    rows = np.empty(len(next(iter(columns.values()))), [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    PlyData([PlyElement.describe(rows, "vertex")], **options).write(str(path))


def rows_of(path: Path) -> NDArray[Any]:
    return np.asarray(PlyData.read(str(path), mmap=False)["vertex"].data)


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
@pytest.mark.parametrize("n", [0, 1, 50])
def test_round_trip_is_exact(tmp_path: Path, n: int, degree: int) -> None:
    params = small_field(n, degree)
    given = {name: torch.nn.Parameter(value.double()) for name, value in params.items()}
    write_ply(tmp_path / "a.ply", {**given, "features": torch.zeros(n, 13)})
    back = read_ply(tmp_path / "a.ply")
    assert tuple(back) == SPLAT_NAMES
    for name, value in params.items():
        assert back[name].dtype == torch.float32
        assert back[name].is_contiguous()
        assert torch.equal(back[name], value), name


def test_layout(tmp_path: Path) -> None:
    params = small_field(3, 1)
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


def test_same_vertices_as_nerfstudio_exports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # The exporter needs open3d for meshes only, and open3d cannot be imported on every machine.
    monkeypatch.setitem(sys.modules, "open3d", types.ModuleType("open3d"))
    monkeypatch.delitem(sys.modules, "nerfstudio.scripts.exporter", raising=False)
    from nerfstudio.models.splatfacto import SplatfactoModel

    exporter = importlib.import_module("nerfstudio.scripts.exporter")
    params = small_field(9, 3)
    model: Any = SplatfactoModel.__new__(SplatfactoModel)
    torch.nn.Module.__init__(model)
    model.gauss_params = torch.nn.ParameterDict(params)
    model.config = SimpleNamespace(sh_degree=3)
    pipeline = SimpleNamespace(model=model)
    monkeypatch.setattr(exporter, "eval_setup", lambda *_, **__: (None, pipeline, None, None))
    exporter.ExportGaussianSplat(load_config=tmp_path, output_dir=tmp_path).main()
    monkeypatch.delitem(sys.modules, "nerfstudio.scripts.exporter")

    write_ply(tmp_path / "ours.ply", params)
    ours, theirs = (rows_of(tmp_path / name) for name in ("ours.ply", "splat.ply"))
    assert ours.dtype == theirs.dtype
    assert ours.tobytes() == theirs.tobytes()
    assert is_nerfstudio_ply(tmp_path / "splat.ply")
    assert not is_nerfstudio_ply(tmp_path / "ours.ply")


def test_other_properties_types_and_orders_are_read(tmp_path: Path) -> None:
    params = small_field(4)
    write_ply(tmp_path / "a.ply", params)
    rows = rows_of(tmp_path / "a.ply")
    columns = {name: rows[name].astype(">f8") for name in sorted(rows.dtype.names or (), reverse=True)}
    write_rows(tmp_path / "b.ply", {"segment": np.zeros(4, "<i4"), **columns}, byte_order=">")
    back = read_ply(tmp_path / "b.ply")
    assert all(torch.equal(back[name], params[name]) for name in SPLAT_NAMES)


def test_harmonics_come_before_colours(tmp_path: Path) -> None:
    """Some programs write both, the colours for viewers of points."""
    write_ply(tmp_path / "a.ply", small_field())
    content = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "b.ply").write_bytes(content.replace(b"nx", b"red", 1).replace(b"ny", b"green").replace(b"nz", b"blue"))
    assert torch.equal(read_ply(tmp_path / "b.ply")["features_dc"], small_field()["features_dc"])


@pytest.mark.parametrize("newline", [b"\n", b"\r\n"])
def test_a_header_with_other_letters(tmp_path: Path, newline: bytes) -> None:
    params = small_field()
    write_ply(tmp_path / "a.ply", params)
    header, end, rows = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    comment = "comment Aufnahme: Küche, 東京, end_header\n".encode()
    changed = header.replace(b"element", comment + b"comment \xff\xe9\nelement", 1) + end
    (tmp_path / "b.ply").write_bytes(changed.replace(b"\n", newline) + rows)
    values = read_ply(tmp_path / "b.ply")
    assert all(torch.equal(values[name], params[name]) for name in SPLAT_NAMES)
    assert ply_comments(tmp_path / "b.ply")[0] == "Aufnahme: Küche, 東京, end_header"


def _without(*names: str) -> Callable[[Path], object]:
    def write(path: Path) -> None:
        rows = rows_of(path)
        write_rows(path, {name: rows[name] for name in rows.dtype.names or () if name not in names})

    return write


def _ascii(path: Path) -> None:
    data = PlyData.read(str(path), mmap=False)
    data.text = True
    data.write(str(path))


WRONG: dict[str, tuple[Callable[[Path], object], str]] = {
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
    "no opacity": (_without("opacity"), "lacks opacity"),
    "no scale": (_without("scale_2"), "lacks scale_2"),
    "no last coefficient": (_without("f_rest_8"), "8 f_rest"),
    "no first coefficient": (_without("f_rest_0"), "8 f_rest"),
    "no blue coefficients": (_without("f_rest_6", "f_rest_7", "f_rest_8"), "6 f_rest"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_files_are_refused_in_one_line(tmp_path: Path, wrong: str) -> None:
    change, cause = WRONG[wrong]
    path = tmp_path / "a.ply"
    write_ply(path, small_field(7))
    change(path)
    with pytest.raises(DataError, match=cause) as caught:
        read_ply(path)
    assert "\n" not in str(caught.value)


def _lists(path: Path, element: str) -> None:
    """Give the vertices, or another element, a list property."""
    rows = rows_of(path).copy()
    corners = np.empty(len(rows), [("corners", "O")])
    corners["corners"] = [np.arange(3, dtype=np.int32)] * len(rows)
    if element == "vertex":
        write_rows(path, {**{name: rows[name] for name in rows.dtype.names or ()}, "corners": corners["corners"]})
    else:
        elements = [PlyElement.describe(rows, "vertex"), PlyElement.describe(corners, element)]
        PlyData(elements).write(str(path))


@pytest.mark.parametrize("kind", ["vertex", "face", "ascii"])
def test_what_is_read_row_by_row_is_refused_by_the_header(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    path = tmp_path / "a.ply"
    write_ply(path, small_field(7))
    _ascii(path) if kind == "ascii" else _lists(path, kind)
    if kind == "face":  # of points, they are ignored
        assert torch.equal(read_point_cloud(path)[0], small_field(7)["means"])
    monkeypatch.setattr(PlyData, "read", lambda *_: pytest.fail("the rows were read"))
    with pytest.raises(
        DataError, match="ascii" if kind == "ascii" else f"property corners of each {kind} .* is a list"
    ):
        read_ply(path)
    if kind == "vertex":
        with pytest.raises(DataError, match="is a list"):
            read_point_cloud(path)


# -------------------------------------------------------------------------------------------------------------- points


def points_and_colors(
    path: Path, colors: NDArray[Any] | None, names: str = "red green blue", **options: Any
) -> tuple[list[Any], list[Any]]:
    """What is read of a .ply of ``XYZ`` with these colours."""
    columns = {} if colors is None else dict(zip(names.split(), colors.T, strict=True))
    write_rows(path, {**dict(zip("xyz", XYZ.T, strict=True)), **columns}, **options)
    points, rgb = read_point_cloud(path)
    assert (points.dtype, rgb.dtype) == (torch.float32, torch.uint8)
    return points.tolist(), rgb.tolist()


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize(
    ("dtype", "white"),
    [
        *(("u1", 255), ("u2", 65535), ("i4", 65535), ("i4", 255), ("u2", 255)),
        *(("f4", 1), ("f4", 255), ("f8", 255), ("f4", 65535), ("f8", 1)),
    ],
)
def test_colours_of_all_ranges(tmp_path: Path, dtype: str, white: int, text: bool) -> None:
    colors = RGB / 255 * white
    given = (colors if dtype[0] == "f" else colors.round()).astype(dtype)
    assert points_and_colors(tmp_path / "a.ply", given, text=text) == (XYZ.tolist(), RGB.tolist())


@pytest.mark.parametrize("names", ["r g b", "diffuse_red diffuse_green diffuse_blue", "Red Green Blue", "R G B"])
@pytest.mark.parametrize("dtype", ["u1", "f4"])
def test_colours_of_other_names(tmp_path: Path, names: str, dtype: str) -> None:
    assert points_and_colors(tmp_path / "a.ply", RGB.astype(dtype), names)[1] == RGB.tolist()


def test_other_colours(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    harmonics = ((RGB / 255 - 0.5) / 0.28209479177387814).astype("f4")
    assert points_and_colors(path, harmonics, "f_dc_0 f_dc_1 f_dc_2")[1] == RGB.tolist()
    above_white = np.array([[1.01, 0.5, 0.0], [0.2, 1.0, 0.1]], "f4")
    assert points_and_colors(path, above_white)[1] == [[255, 128, 0], [51, 255, 26]]
    assert points_and_colors(path, None) == (XYZ.tolist(), [[128] * 3] * 2)


def test_precise_positions(tmp_path: Path) -> None:
    far = [5_412_330.123, 1e-9, -4e6 - 0.1]
    write_rows(tmp_path / "a.ply", {name: np.array([value]) for name, value in zip("xyz", far, strict=True)})
    assert read_point_cloud(tmp_path / "a.ply", precise=True)[0].tolist() == [far]


@pytest.mark.parametrize("text", [False, True])
def test_a_cloud_with_a_comment_in_utf_8(tmp_path: Path, text: bool) -> None:
    points_and_colors(tmp_path / "a.ply", RGB, text=text)
    content = (tmp_path / "a.ply").read_bytes().replace(b"element", "comment Küche 東京\nelement".encode(), 1)
    (tmp_path / "b.ply").write_bytes(content)
    points, colors = read_point_cloud(tmp_path / "b.ply")
    assert (points.tolist(), colors.tolist()) == (XYZ.tolist(), RGB.tolist())


def test_files_without_points_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot be read"):
        read_point_cloud(tmp_path / "gone.ply")
    write_rows(tmp_path / "a.ply", {"x": np.zeros(2), "y": np.zeros(2)})
    with pytest.raises(DataError, match="without x, y and z"):
        read_point_cloud(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("lines", "in_model_frame"),
    [
        (("ply", "comment first", f"comment {MODEL_FRAME}"), True),
        (("ply", "comment Generated by Nerstudio 1.1.5"), True),
        (("ply",), False),
        (("ply", f"comment not {MODEL_FRAME}"), False),
        (("txt", f"comment {MODEL_FRAME}"), False),
        (None, False),
    ],
)
def test_frame_of_the_coordinates(tmp_path: Path, lines: tuple[str, ...] | None, in_model_frame: bool) -> None:
    if lines is not None:
        content = [lines[0], "format binary_little_endian 1.0", *lines[1:], "element vertex 0", "end_header", ""]
        (tmp_path / "a.ply").write_text("\n".join(content))
    assert is_nerfstudio_ply(tmp_path / "a.ply") is in_model_frame
