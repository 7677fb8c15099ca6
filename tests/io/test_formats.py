"""Files for other viewers: kinds, round trips of every format, refusals, and splat-transform if it is installed."""

import gzip
import json
import shutil
import subprocess
from contextlib import suppress
from dataclasses import replace

import hypothesis.strategies as st
import pytest
import torch
from fields import assert_close, assert_moved, matched
from foreign_files import columns_of, small_field, write_columns, write_gsplat
from hypothesis import HealthCheck, given, settings

import sundae_ns as sn
from sundae_ns.core.errors import CheckpointError, DataError
from sundae_ns.core.gaussians import SPLAT_NAMES, Gaussians, bytes_of, sh_degree
from sundae_ns.head.head import bytes_of_module
from sundae_ns.io.config_file import check_run
from sundae_ns.io.formats import kind_of, read_gaussian_file, read_gaussians, write_for_viewers, write_levels
from sundae_ns.io.pack.packed_scene import PackedScene, fit_scene, write_fitted
from sundae_ns.io.ply import Marks, keep_vertices, read_ply, read_point_cloud, write_ply
from sundae_ns.io.spz import fractional_bits

PROGRAM = shutil.which("splat-transform")
# Half a step of each format, plus rounding; codebooks by their worst case.
NEAR, SHARES = dict.fromkeys(SPLAT_NAMES, 1e-5), {"opacities": 0.5 / 255 + 1e-6}
TOLERANCES = {
    ".ply": {"opacities": 1e-6, "quats": 1e-6},
    ".glb": NEAR,
    ".spz": NEAR | SHARES | {"scales": 0.0313, "quats": 0.002, "features_dc": 0.0134, "features_rest": 0.0079},
    ".sog": dict.fromkeys(NEAR, 0.02) | SHARES | {"means": 1e-4, "quats": 0.0085},
}


@pytest.mark.parametrize("kind", TOLERANCES)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(n=st.integers(1, 300), degree=st.integers(0, 3), marks=st.tuples(st.booleans(), st.booleans()))
def test_what_is_written_is_read(tmp_path, kind, n, degree, marks):
    truth, path = small_field(n, degree), tmp_path / f"a{kind}"
    antialiased, in_model_frame = marks
    written = write_for_viewers(path, truth, Marks(antialiased, in_model_frame))
    content = path.read_bytes()
    write_for_viewers(path, truth, Marks(antialiased, in_model_frame))
    assert path.read_bytes() == content
    assert len(written["means"]) == n
    sanitised, read = read_gaussian_file(path)
    assert_close(sanitised.gaussians, truth, TOLERANCES[kind])
    assert read.antialiased == antialiased
    assert read.in_model_frame == in_model_frame


@pytest.mark.skipif(PROGRAM is None, reason="no splat-transform: npm install -g @playcanvas/splat-transform")
@pytest.mark.parametrize("kind", [".ply", ".spz", ".sog", "/lod-meta.json"])
@pytest.mark.parametrize(("degree", "antialiased"), [(3, True), (0, False)])
def test_another_program_reads_the_same_scene(tmp_path, kind, degree, antialiased):
    truth, file, back = small_field(300, degree), tmp_path / f"a{kind}", tmp_path / "back.ply"
    if kind in TOLERANCES:
        write_for_viewers(file, truth, Marks(antialiased))
    else:  # the first levels are others
        write_levels(file.parent, [small_field(600, degree), truth, small_field(30, degree)], Marks(antialiased))
    words = [str(PROGRAM), "--quiet", *([] if kind in TOLERANCES else ["--select-lod", "1"]), str(file), str(back)]
    subprocess.run(words, check=True, capture_output=True, timeout=120)
    sanitised, marks = read_gaussian_file(back)
    assert_close(sanitised.gaussians, truth, TOLERANCES.get(kind, TOLERANCES[".sog"]))
    assert marks.antialiased == antialiased


@pytest.mark.parametrize(("kind", "degree"), [(".ply", 4), (".spz", 3), (".sog", 3), (".glb", 3)])
def test_a_field_is_sanitised_and_its_degree_cut_to_the_format(tmp_path, kind, degree, caplog):
    gaussians = small_field(300, 4)
    gaussians["means"][3, 0] = torch.nan
    gaussians["scales"][7, 1], gaussians["scales"][9, 1] = torch.inf, -torch.inf  # the second is flat
    gaussians["quats"][0], gaussians["quats"][1] = 0, torch.tensor([0.0, 1e-30, 0.0, 0.0])
    written = write_for_viewers(tmp_path / f"a{kind}", gaussians)
    assert (len(written["means"]), sh_degree(written["features_rest"])) == (298, degree)
    assert caplog.messages[:1] == [f"a {kind} holds no harmonics above SH degree 3; a .ply does"] * (degree < 4)
    found = matched(read_gaussian_file(tmp_path / f"a{kind}")[0].gaussians, {"means": gaussians["means"][:1]})
    torch.testing.assert_close(found["quats"].abs(), torch.eye(4)[:1], rtol=0, atol=0.006)


def test_colours_of_models_of_sh_degree_0(tmp_path):
    gaussians = small_field(degree=0)
    write_for_viewers(tmp_path / "a.ply", Gaussians(gaussians, "logits"))
    colors = 0.5 + 0.28209479 * read_ply(tmp_path / "a.ply")["features_dc"]
    torch.testing.assert_close(colors, gaussians["features_dc"].sigmoid(), rtol=0, atol=1e-6)


def write_survey(path, far):
    """Write a .ply with centres in double, 50 units around a place far away; returns them."""
    means = far + 50 * torch.rand(300, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    means[:, 0].round_()  # float32 holds these
    write_ply(path, small_field())
    write_columns(path, columns_of(path) | dict(zip("yz", means.T[1:].numpy())) | {"x": means[:, 0].float().numpy()})
    return means


@pytest.mark.parametrize("kind", [*TOLERANCES, ".sundae"])
def test_survey_coordinates_are_moved_stated_and_kept(tmp_path, kind, caplog):
    truth = write_survey(tmp_path / "a.ply", 4e6)
    scene = sn.load(tmp_path / "a.ply")
    assert "lies where float32 is too coarse; its coordinates are less 4000032 " in caplog.text
    offset = -torch.tensor(scene.meta["frame"]["transform"], dtype=torch.float64)[:, 3]
    torch.testing.assert_close(scene.gaussians["means"].double() + offset, truth, rtol=0, atol=2e-6)
    scene = replace(scene, up=(0.6, 0.0, 0.8))
    sn.save(scene, tmp_path / f"b{kind}")
    back = sn.load(tmp_path / f"b{kind}")
    assert back.up == pytest.approx(scene.up, abs=1e-7)
    assert back.meta["frame"] == scene.meta["frame"]
    error = torch.cdist(scene.gaussians["means"].double(), back.gaussians["means"].double()).amin(dim=1).max()
    assert error < {".ply": 1e-9, ".glb": 1e-5, ".spz": 1e-5}.get(kind, 0.01)
    assert not back.in_model_frame
    # Cameras of the survey see the moved scene, and rows of the file keep their doubles.
    camera = {"fl_x": 50, "fl_y": 50, "cx": 32, "cy": 24, "w": 64, "h": 48}
    pose = [[1, 0, 0, 4e6 + 1], [0, 1, 0, 4e6], [0, 0, 1, 4e6], [0, 0, 0, 1]]
    (tmp_path / "c.json").write_text(json.dumps({**camera, "frames": [{"transform_matrix": pose}]}))
    assert sn.cameras_of(tmp_path / "c.json", back if kind == ".sundae" else scene)[0].center[0] == 4e6 + 1 - offset[0]


def test_rows_of_a_survey_keep_their_digits_in_text_that_states_floats_and_in_a_prune(tmp_path):
    truth, mask, path = write_survey(tmp_path / "a.ply", 5e5), torch.arange(300) < 200, tmp_path / "text.ply"
    write_columns(path, columns_of(tmp_path / "a.ply"), text=True)
    path.write_bytes(path.read_bytes().replace(b"property double ", b"property float "))
    scene = sn.load(path)
    means = scene.gaussians["means"].double() + torch.tensor(scene.offset, dtype=torch.float64)
    torch.testing.assert_close(means, truth, rtol=0, atol=2e-6)
    moved, _ = read_gaussian_file(tmp_path / "a.ply")
    keep_vertices(tmp_path / "a.ply", tmp_path / "b.ply", mask, moved.gaussians.rows(mask))
    means = read_point_cloud(tmp_path / "b.ply", precise=True)[0]
    torch.testing.assert_close(means, truth[mask], rtol=0, atol=2e-6)
    warm, in_model_frame = read_gaussians(tmp_path / "a.ply")
    torch.testing.assert_close(warm["means"], truth, rtol=0, atol=2e-6)
    assert not in_model_frame


def test_up_is_stated_else_by_convention_and_kept(tmp_path, caplog):
    write_ply(tmp_path / "a.ply", small_field(), comments=["Vertical axis: 3 0 4"])
    stated = sn.load(tmp_path / "a.ply")
    assert stated.up == (0.6, 0.0, 0.8)
    assert not caplog.messages
    for kind in (".ply", ".sog", ".spz", ".sundae"):
        sn.save(stated, tmp_path / f"b{kind}")
        assert sn.load(tmp_path / f"b{kind}").up == (0.6, 0.0, 0.8)
    for up in (stated.up, (0.0, 0.0, 1.0)):
        keep_vertices(tmp_path / "a.ply", tmp_path / "c.ply", torch.arange(300) > 9, up=up)
        assert sn.load(tmp_path / "c.ply").up == up
        assert (b"Vertical axis: 0 0 1" in (tmp_path / "c.ply").read_bytes()) == (up != stated.up)
    write_ply(tmp_path / "c.ply", small_field())
    assert sn.load(tmp_path / "c.ply").up == (0, -1, 0)
    (line,) = caplog.messages
    assert line.endswith("c.ply states no upward direction; it is 0 -1 0, as files of its kind have")
    write_gsplat(tmp_path / "d.pt", small_field() | {"means": small_field()["means"].double() + 4e6})
    assert sn.load(tmp_path / "d.pt").up == (0, 0, 1)
    assert len(sn.load(tmp_path / "d.pt").gaussians["means"].unique()) > 800, "not rounded before it is moved"
    sn.save(replace(stated, in_model_frame=True, up=None), tmp_path / "e.ply", upright=True)
    assert sn.load(tmp_path / "e.ply").up == (0, -1, 0)
    for in_model_frame, up in ((False, (0, -1, 0)), (True, (0, 0, 1))):
        write_for_viewers(tmp_path / "f.glb", small_field(), Marks(in_model_frame=in_model_frame))
        assert sn.load(tmp_path / "f.glb").up == up


@pytest.mark.parametrize(("name", "change"), [("features_dc", 1e37), ("opacities", 1e37), ("scales", -60)])
@pytest.mark.parametrize("kind", [*TOLERANCES, ".sundae"])
def test_what_cannot_be_loaded_is_not_saved(tmp_path, kind, name, change):
    gaussians, path = small_field(), tmp_path / f"a{kind}"
    gaussians[name] *= change  # logarithms of widths become 120 to 240
    with suppress(sn.SundaeError):
        sn.save(sn.Scene(Gaussians(gaussians)), path)
    faint = int((gaussians["opacities"] < -6).sum()) if kind == ".sundae" else 0  # a pack leaves them out
    assert not path.exists() or sn.load(path).num_gaussians == 300 - faint


def test_upright_rotates_z_to_minus_y(tmp_path):
    write_for_viewers(tmp_path / "b.ply", small_field(), Marks(offset=(1.0, 2.0, 3.0)), upright=True)
    sanitised, marks = read_gaussian_file(tmp_path / "b.ply")
    assert marks == Marks(up=(0.0, -1.0, 0.0), offset=(1.0, -3.0, 2.0))
    assert_moved(sanitised.gaussians, small_field(), torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))


BAD = {"opacities": torch.zeros(300)}, {"features_rest": torch.zeros(300, 4, 3)}
REFUSED = [
    *((kind, change, "has shape") for kind in TOLERANCES for change in BAD),
    *((kind, {"means": torch.full((300, 3), torch.nan)}, "no Gaussians") for kind in [*TOLERANCES][1:]),
    (".spz", {"means": torch.full((300, 3), 1e5)}, r"1e\+05 from the origin"),
]


@pytest.mark.parametrize(("kind", "change", "words"), REFUSED)
def test_refusals_leave_the_older_file(tmp_path, kind, change, words):
    (tmp_path / f"a{kind}").write_bytes(b"older")
    with pytest.raises(DataError, match=words):
        write_for_viewers(tmp_path / f"a{kind}", {**small_field(), **change})
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"older"]


@pytest.mark.parametrize(("farthest", "bits"), [(0, 24), (0.25, 24), (1, 22), (2, 21), (-2000, 12), (2048, 11)])
def test_positions_of_a_spz_get_as_many_bits_as_fit(tmp_path, farthest, bits):
    assert fractional_bits(torch.tensor([[0.0, farthest, 0.0]])) == bits
    gaussians = small_field(50)
    gaussians["means"] *= farthest / gaussians["means"].abs().max() or 1e-9
    write_for_viewers(tmp_path / "a.spz", gaussians)
    assert len(gzip.decompress((tmp_path / "a.spz").read_bytes())) == 16 + 50 * (9 + 1 + 3 + 3 + 4 + 9)
    means = read_gaussian_file(tmp_path / "a.spz")[0].gaussians["means"]
    assert (means - gaussians["means"]).abs().max() <= 2.0 ** -(bits + 1) + 1e-7


def test_values_beyond_the_range_of_a_spz_are_named(tmp_path, caplog):
    gaussians = small_field()
    gaussians["scales"][0, 0], gaussians["features_dc"][1, 2], gaussians["features_rest"][2, 0, 0] = 7.0, 4.0, -1.5
    write_for_viewers(tmp_path / "a.spz", gaussians)
    stored = "what a .spz stores: scales by up to 1.06, features_dc by up to 0.667, features_rest by up to 0.5;"
    assert f"a.spz clamps 3 Gaussians to {stored}" in caplog.text


def test_kinds_follow_from_first_bytes(tmp_path):
    write_fitted(tmp_path / "packed.ply", *fit_scene(PackedScene(small_field(4))))
    write_ply(tmp_path / "points.sundae", small_field(4))
    for name, content in {"dos.txt": b"ply\r\nformat", "word.ply": b"plywood", "empty.sundae": b""}.items():
        (tmp_path / name).write_bytes(content)
    kinds = {"packed.ply": "packed", "points.sundae": "ply", "dos.txt": "ply"}
    kinds |= dict.fromkeys(("word.ply", "empty.sundae", "missing.sundae", "."))
    assert {name: kind_of(tmp_path / name) for name in kinds} == kinds
    with pytest.raises(CheckpointError, match=r"packed\.ply is a packed scene; give the run that was packed$"):
        check_run(tmp_path / "packed.ply")
    with pytest.raises(CheckpointError, match=r"points\.sundae is a \.ply file, which .*; give a run$"):
        check_run(tmp_path / "points.sundae")


def test_bytes_of_fields_and_modules():
    params = {"means": torch.zeros(10, 3), "features": torch.zeros(10, 13)}
    assert bytes_of(params) == bytes_of({name: value.half() for name, value in params.items()}) == 10 * 16 * 4
    a, b = torch.nn.Linear(3, 3, bias=False), torch.nn.Linear(3, 3, bias=False)
    b.weight = a.weight
    assert bytes_of_module(torch.nn.ModuleList([a, b])) == 36
    assert bytes_of_module(torch.nn.BatchNorm1d(8).half()) == 2 * 4 * 8 + 8  # counts its batches in one int64
