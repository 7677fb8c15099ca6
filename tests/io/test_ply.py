"""The .ply of Gaussians and of points: layout, what other programs write, and refusals in one line."""

import numpy as np
import pytest
import torch
from foreign_files import columns_of, small_field, write_columns
from limits import refused, verdict
from plyfile import PlyData, PlyElement

from sundae_ns.core.gaussians import SPLAT_NAMES, sanitise
from sundae_ns.io.formats import read_gaussian_file
from sundae_ns.io.ply import (
    Marks,
    comments_of,
    has_own_columns,
    keep_vertices,
    ply_marks,
    read_ply,
    read_point_cloud,
    write_ply,
)

XYZ = np.array([[0.5, -1.25, 2.0], [3.0, 4.0, -5.5]], np.float32)
RGB = np.array([[0, 128, 255], [10, 20, 30]], np.uint8)


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
@pytest.mark.parametrize("n", [0, 1, 150])
def test_round_trip_is_exact(tmp_path, n, degree):
    params = small_field(n, degree)
    params["scales"] += 8  # in millimetres
    given = {name: torch.nn.Parameter(value.double()) for name, value in params.items()}
    write_ply(tmp_path / "a.ply", {**given, "features": torch.zeros(n, 13)})
    back = read_ply(tmp_path / "a.ply")
    assert tuple(back) == SPLAT_NAMES
    for name, value in params.items():
        assert back[name].dtype == torch.float32
        assert back[name].is_contiguous()
        assert torch.equal(back[name], value), name


def test_columns_are_those_of_3dgs(tmp_path):
    params = small_field(9, 3)
    write_ply(tmp_path / "a.ply", params)
    counts = {"f_dc_": 3, "f_rest_": 45, "opacity": None, "scale_": 3, "rot_": 4}
    names = [f"{name}{i}" if count else name for name, count in counts.items() for i in range(count or 1)]
    columns = columns_of(tmp_path / "a.ply")
    assert [*columns] == ["x", "y", "z", "nx", "ny", "nz", *names]
    assert {column.dtype for column in columns.values()} == {np.dtype("<f4")}
    rest = params["features_rest"].transpose(1, 2).flatten(1)  # all of red, then green, then blue
    parts = [params["means"], torch.zeros(9, 3), params["features_dc"], rest, params["opacities"], params["scales"]]
    expected = torch.cat([*parts, params["quats"]], dim=1).numpy()
    assert np.array_equal(np.stack([*columns.values()], axis=1), expected)
    assert ply_marks(tmp_path / "a.ply") == Marks()


def _columns(change, **options):
    return lambda path: write_columns(path, change(columns_of(path)), **options)


def _big_endian_doubles(columns):
    more = {"segment": np.zeros(9, "<i4"), "semantic_0": np.ones(9), "sh_degree": np.ones(9)}
    return more | {name: columns[name].astype(">f8") for name in sorted(columns, reverse=True)}


def _header(old, new, newline=b"\n"):
    def change(path):
        header, end, rows = path.read_bytes().partition(b"end_header\n")
        assert old in header + end
        path.write_bytes((header + end).replace(old, new, 1).replace(b"\n", newline) + rows + bytes(9))

    return change


def _text(path, line_end=b"\n"):
    data = PlyData.read(str(path), mmap=False)
    data.text = True
    data.write(str(path))
    path.write_bytes(path.read_bytes().replace(b"\n", line_end))


def _faces(path):
    corners = np.empty(2, [("vertex_indices", "O")])
    corners["vertex_indices"] = [np.arange(3, dtype=np.int32)] * 2
    vertices = PlyData.read(str(path), mmap=False)["vertex"]
    PlyData([vertices, PlyElement.describe(corners, "face")]).write(str(path))


FACES = b"element face %d\nproperty list uchar uint vertex_indices\n"
COMMENT = "comment Küche, 東京, end_header\n".encode() + b"comment \xff\xe9\nelement"
SAME = {
    "more properties, doubles, another order": _columns(_big_endian_doubles, byte_order=">"),
    "text": _text,
    "text of old Macs, with empty lines": lambda path: _text(path, b"\r\r"),
    "faces": _faces,
    "no faces": _header(b"end_header", FACES % 0 + b"end_header"),
    "no faces first": _header(b"element", FACES % 0 + b"element"),
    "harmonics and colours": _header(
        b"nx\nproperty float ny\nproperty float nz", b"red\nproperty float green\nproperty float blue"
    ),
    "other letters": _header(b"element", COMMENT),
    "capital letters": _header(b"element vertex 9\nproperty float x", b"ELEMENT Vertex 9\nproperty FLOAT X"),
    "blank lines": _header(b"element vertex 9", b"\n" * 90_000 + b"element vertex 9"),
    "an indent and a sign": _header(b"element vertex 9", b"\t element  vertex +9"),
    "an indented coefficient": _header(b"property float f_rest_20", b"  property  float f_rest_20"),
    "spaces at the ends of lines": _header(b"element", b"element", b" \n"),
    "lines of DOS": _header(b"element", COMMENT, b"\r\n"),
    "lines of old Macs": _header(b"element", COMMENT, b"\r"),
}


@pytest.mark.parametrize("form", SAME)
def test_other_forms_are_the_same_gaussians(tmp_path, form, recwarn):
    params, path = small_field(9, degree=2), tmp_path / "a.ply"
    write_ply(path, params)
    SAME[form](path)
    values = read_gaussian_file(path)[0].gaussians
    assert all(torch.equal(values[name], params[name]) for name in SPLAT_NAMES)
    assert torch.equal(read_point_cloud(path)[0], params["means"])
    assert not recwarn.list
    if has_own_columns(path):
        for count, cut in ((8, params), (3, {**params, "features_rest": params["features_rest"][:, :3]})):
            given = None if count == 8 else {name: value[5:] for name, value in cut.items()}
            assert verdict(lambda g=given: keep_vertices(path, tmp_path / "b.ply", torch.arange(9) > 4, g), 1) is None
            assert all(torch.equal(value, cut[name][5:]) for name, value in read_ply(tmp_path / "b.ply").items())


@pytest.mark.parametrize("name", ["filter_3D", "3d_filter", "mip_filter3D_0"])
def test_the_filter_of_mip_splatting_is_fused_and_never_stale(tmp_path, name):
    """As its ``get_scaling_with_3D_filter`` and ``get_opacity_with_3D_filter``."""
    params, path, n = small_field(9), tmp_path / "a.ply", 9
    write_ply(path, params)
    widths = np.linspace(0, 0.3, n, dtype=np.float32)
    write_columns(path, {**columns_of(path), name: widths})
    read = read_ply(path)
    before, width = params["scales"].exp().square(), torch.from_numpy(widths)[:, None].square()
    torch.testing.assert_close(read["scales"].exp(), (before + width).sqrt(), rtol=1e-6, atol=0)
    share = (before.prod(dim=1) / (before + width).prod(dim=1)).sqrt()[:, None]
    torch.testing.assert_close(read["opacities"].sigmoid(), params["opacities"].sigmoid() * share, rtol=1e-5, atol=0)
    assert torch.equal(read["opacities"][0], params["opacities"][0])
    mask = torch.arange(n) > 4
    keep_vertices(path, tmp_path / "copied.ply", mask)
    keep_vertices(path, tmp_path / "merged.ply", mask, {name: value[mask] for name, value in read.items()})
    for copy in ("copied.ply", "merged.ply"):
        for key, value in read_ply(tmp_path / copy).items():
            torch.testing.assert_close(value, read[key][mask], rtol=1e-6, atol=1e-6)
    assert columns_of(tmp_path / "merged.ply")[name].tolist() == [0] * 4


def test_2dgs_is_flat_and_opacities_of_bytes_are_shares(tmp_path):
    params, path = small_field(5), tmp_path / "a.ply"
    write_ply(path, params)
    write_columns(path, columns_of(path) | {"opacity": np.array([0, 51, 102, 204, 255], np.uint8)})
    assert not has_own_columns(path)  # a merge would write logits into the bytes
    _without("scale_2")(path)
    read = sanitise(read_ply(path))
    assert (read.flat, read.dropped) == (5, 0)
    assert torch.equal(read.gaussians["scales"][:, :2], params["scales"][:, :2])
    opacities = read.gaussians["opacities"].sigmoid()[:, 0]
    torch.testing.assert_close(opacities, torch.tensor([0, 0.2, 0.4, 0.8, 1]), atol=2e-6, rtol=0)


ANTIALIASED = """anti-aliased = on|AntiAliasing: 1.0|antialias: yes|Antialiased|rasterize_mode mip|--antialiasing|\
train_flags: --antialiasing --eval|antialiasing = True # 3dgs|mip-splatting: 1|SplatRenderMode: MipSplatting"""
UPWARDS = """up: 0 0 2|upAxis=Z|Up vector [0, 0, 1]|UP_DIRECTION (0; 0; 1)|vertical axis: z-up|world_up 0 0 1 (ENU)|\
z-up|Vertical axis: z (x east, y north)|up_axis: "z"|Coordinate system: Z up, right-handed|axes: right-hand, +z is up"""
ALL_MARKS = Marks(True, True, (0.6, 0.0, 0.8), (1e6 / 3, 0.1, -4e6))


@pytest.mark.parametrize(
    ("comments", "marks"),
    [
        (["SplatRenderMode: mip"], Marks(antialiased=True)),
        (["  SPLATRENDERMODE:  MIP  "], Marks(antialiased=True)),
        (["antialiased 1"], Marks(antialiased=True)),
        *(([mark], Marks(antialiased=True)) for mark in ANTIALIASED.split("|")),
        (["anti_aliasing: off", "render_mode: classic"], Marks()),
        (["antialias" + 50_000 * "!" + "b c"], Marks(antialiased=True)),  # a regular expression may take minutes
        (["antialiased 1", "SplatRenderMode: default"], Marks()),
        (["SplatRenderMode: default", "Antialiased 1"], Marks(antialiased=True)),
        (["antialiased 0", "SplatRenderMode: 2dgs", "antialiased edges are nice"], Marks()),
        (["Vertical axis: 0 -2 0"], Marks(up=(0.0, -1.0, 0.0))),
        (["vertical AXIS: 3, 0, 4"], Marks(up=(0.6, 0.0, 0.8))),
        *(([mark], Marks(up=(0.0, -1.0, 0.0))) for mark in ("Vertical axis: -y", "axes: -y up", "worldUpVec=0,-2,0")),
        *(([mark], Marks(up=(0.0, 0.0, 1.0))) for mark in UPWARDS.split("|")),
        (["up to 3 0 0", "Updated: 0 0 1"], Marks()),
        (["Exported from Brush", "Vertical axis: y"], Marks(up=(0.0, -1.0, 0.0))),
        (["Vertical axis: 0 0 0", "Vertical axis of a column", "Offset: nan 0 0"], Marks()),
        (["Vertical axis: up"], Marks()),
        (["first", "Coordinates: nerfstudio model"], Marks(in_model_frame=True)),
        (["Generated by Nerstudio 1.1.5"], Marks(in_model_frame=True)),
        (["not Coordinates: nerfstudio model"], Marks()),
        (comments_of(ALL_MARKS), ALL_MARKS),
    ],
)
def test_marks_of_a_header(tmp_path, comments, marks):
    write_ply(tmp_path / "a.ply", small_field(3), comments=comments)
    assert verdict(lambda: ply_marks(tmp_path / "a.ply"), 50_000) is None
    assert ply_marks(tmp_path / "a.ply") == marks
    content = (tmp_path / "a.ply").read_bytes()
    for word in (b"\nobj_info ", b"\nCOMMENT ", b"\ncomment\t"):
        (tmp_path / "a.ply").write_bytes(content.replace(b"\ncomment ", word))
        assert ply_marks(tmp_path / "a.ply") == marks


def _without(*names):
    return _columns(lambda columns: {name: column for name, column in columns.items() if name not in names})


def _with(*names, without=" "):
    """With further properties, and without those of a prefix."""
    more = dict.fromkeys(names, np.zeros(7, "f4"))
    return _columns(lambda columns: {n: column for n, column in columns.items() if not n.startswith(without)} | more)


def _lists(columns):
    corners = np.empty(7, "O")
    corners[:] = [np.arange(3, dtype=np.int32)] * 7
    return columns | {"corners": corners}


WRONG = {
    "gone": (lambda path: path.unlink(), "cannot be read"),
    "a folder": (lambda path: (path.unlink(), path.mkdir()), "cannot be read"),
    "truncated": (lambda path: path.write_bytes(path.read_bytes()[:-5]), "not a complete"),
    "empty": (lambda path: path.write_bytes(b""), "not a complete .* .it does not begin with ply"),
    "no vertices": (lambda path: path.write_bytes(b"ply\nformat ascii 1.0\nend_header\n"), "no vertices"),
    "no opacity": (_without("opacity"), "lacks opacity"),
    "no scale": (_without("scale_1", "scale_2"), "lacks scale_1, scale_2"),
    "Beta Splatting": (_with("beta"), "Gaussians of another kernel .beta."),
    "Spacetime Gaussians": (_with("trbf_center", "motion_0"), "holds 4D Gaussians"),
    "4D Gaussians with a time": (_with("t"), "holds 4D Gaussians"),
    "4D Gaussians by their scales": (_with("scale_3"), "holds 4D Gaussians .scale_3."),
    "Student's t": (_with("nu_degree"), "Gaussians of another kernel .nu_degree."),
    "Brush's 4D": (_header(b"end_header", b"element delta_vertex_0 0\nproperty uchar x\nend_header"), "holds 4D"),
    "Scaffold-GS": (_with("scale_3", "f_anchor_feat_0", without="f_"), "network for its colours .f_anchor_feat_0."),
    "a long name": (_with("sh_coef" + 60_000 * "1" + "-", without="f_"), "harmonics by other names .sh_coef1+.; exp"),
    "harmonics of a checkpoint": (_with("features_rest_0", without="f_rest"), "by other names .features_rest_0."),
    "features for colours": (_with("color_feature_0", without="f_"), "a network for its colours"),
    "codes": (_columns(lambda c: c | {"rot_2": np.zeros(7, np.uint8)}), "has codes of a table for rot_2"),
    "lists": (_columns(_lists), "property corners of each vertex .* is a list"),
    "widths": (_columns(lambda columns: dict.fromkeys(columns, np.full(200, 0.5, "f4"))), "not their logarithms"),
    "no logs": (_columns(lambda c: dict.fromkeys(c, np.r_[0:0.1:200j]) | {"opacity": np.full(200, 3.0)}), "not their"),
    "large": (_columns(lambda c: dict.fromkeys(c, np.logspace(-1, 2, 200)) | {"opacity": np.full(200, 3.0)}), "not th"),
    "shares": (_columns(lambda c: dict.fromkeys(c, np.zeros(200)) | {"opacity": np.r_[np.nan, 0:1:199j]}), "not their"),
    "lists before": (_header(b"element", FACES % 1 + b"element"), "each face"),
    "a cut text": (lambda path: (_text(path), path.write_bytes(path.read_bytes()[:-400])), "it has 6|columns"),
    "no coefficient 8 of 9": (_with("f_rest_9", without="f_rest_8"), "9 f_rest"),
    "no blue coefficients": (_without("f_rest_6", "f_rest_7", "f_rest_8"), "6 f_rest"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_files_are_refused_in_one_line(tmp_path, wrong):
    change, words = WRONG[wrong]
    write_ply(tmp_path / "a.ply", small_field(7))
    change(tmp_path / "a.ply")
    refused(read_ply, tmp_path / "a.ply", words)


def points_and_colors(path, colors, names="red green blue", **options):
    """What is read of a .ply of ``XYZ`` with these colours."""
    columns = {} if colors is None else dict(zip(names.split(), colors.T, strict=True))
    write_columns(path, {**dict(zip("xyz", XYZ.T, strict=True)), **columns}, **options)
    points, rgb = read_point_cloud(path)
    assert (points.dtype, rgb.dtype) == (torch.float32, torch.uint8)
    return points.tolist(), rgb.tolist()


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize(
    ("dtype", "white"),
    [
        *(("u1", 255), *((kind, white) for kind in ("u2", "i4") for white in (255, 65535))),
        *((kind, white) for kind in ("f4", "f8") for white in (1, 255, 65535)),
    ],
)
def test_colours_of_all_ranges(tmp_path, dtype, white, text):
    colors = RGB / 255 * white
    given = (colors if dtype[0] == "f" else colors.round()).astype(dtype)
    assert points_and_colors(tmp_path / "a.ply", given, text=text) == (XYZ.tolist(), RGB.tolist())


@pytest.mark.parametrize("names", ["r g b", "diffuse_red diffuse_green diffuse_blue", "Red Green Blue", "R G B"])
@pytest.mark.parametrize("dtype", ["u1", "f4"])
def test_colours_of_other_names(tmp_path, names, dtype):
    assert points_and_colors(tmp_path / "a.ply", RGB.astype(dtype), names)[1] == RGB.tolist()


def test_other_colours(tmp_path):
    path = tmp_path / "a.ply"
    harmonics = ((RGB / 255 - 0.5) / 0.28209479177387814).astype("f4")
    assert points_and_colors(path, harmonics, "f_dc_0 f_dc_1 f_dc_2")[1] == RGB.tolist()
    above_white = np.array([[1.01, 0.5, 0.0], [0.2, 1.0, 0.1]], "f4")
    assert points_and_colors(path, above_white)[1] == [[255, 128, 0], [51, 255, 26]]
    assert points_and_colors(path, None) == (XYZ.tolist(), [[128] * 3] * 2)


def test_precise_positions_and_files_without_points(tmp_path):
    far = [5_412_330.123, 1e-9, -4e6 - 0.1]
    write_columns(tmp_path / "a.ply", {name: np.array([value]) for name, value in zip("xyz", far, strict=True)})
    assert read_point_cloud(tmp_path / "a.ply", precise=True)[0].tolist() == [far]
    refused(read_point_cloud, tmp_path / "gone.ply", "cannot be read")
    write_columns(tmp_path / "a.ply", {"x": np.zeros(2), "y": np.zeros(2)})
    refused(read_point_cloud, tmp_path / "a.ply", "without x, y and z")
