"""The container of packed scenes: the description of the format, the checks by it, and sections beyond their limits."""

import json
from copy import deepcopy
from typing import get_args, get_type_hints

import numpy as np
import pytest
import torch
from documents import put
from limits import refused
from packed_scenes import full_scene, resection, restate

from sundae_ns.core.errors import PackError
from sundae_ns.core.gaussians import MAX_SH_DEGREE
from sundae_ns.head.head import HeadConfig
from sundae_ns.io.pack import container
from sundae_ns.io.pack.container import FORMAT, LIMITS, fault, parsed
from sundae_ns.io.pack.packed_scene import fit_scene, read_scene, write_fitted
from sundae_ns.scene.scene import Background

HEAD = {"mode": "residual", "size": "tiny", "pixel_unshuffle": 1, "num_features": 3, "precision": "bf16"}
MODEL = {"sh_degree": 2, "rasterize_mode": "classic", "background_color": "black"}
MODEL |= {"head": HEAD, "trained_focal": [5, 6]}
ATTRIBUTES = {
    "means": {"codec": "blocks", "bits": 13, "block": 1024},
    "quats": {"codec": "xyz", "step": 0.008},
    **{name: {"codec": "transform", "step": 0.05} for name in ("scales", "opacities", "features_dc")},
    "features_rest": {"codec": "transform", "step": 0.02, "width": 24},
    "head": {"codec": "channels", "weights": 4, "tensors": [["a", [2, 2]], ["b", [2]]]},
}
POSE = [[1.0, 0, 0, 3], [0, 0.6, -0.8, 1e9], [0, 0.8, 0.6, 0]]
START = {"pose": POSE, "intrinsics": [9, 9.5, -3, 0], "size": [640, 480.0]}
HEADER = {"primitives": 40, "attributes": ATTRIBUTES, "source": {"method": "sundae"}}
HEADER |= {"up": [0, 0.6, -0.82], "start": START}
SECTION = {"name": "means/low", "dtype": "<f4", "shape": [1, 3], "parts": [3, 3, 3, 3], "sha256": 64 * "0"}
VALID = {"container": {"sections": [SECTION, {**SECTION, "name": "means/high"}]}, "header": HEADER, "model": MODEL}


@pytest.mark.parametrize("schema", VALID)
def test_valid_values_pass(schema):
    assert fault(VALID[schema], FORMAT[schema]) is None


WRONG = {
    "header": {
        "primitives": [0, 2.5],
        "source": [[]],
        "attributes/means": [None],
        "attributes/means/bits": [3, 17],
        "attributes/means/block": [1048577],
        "attributes/opacities/step": [1e39],
        "attributes/scales/codec": [None, ["transform"]],
        "attributes/quats/step": [1.5],
        "attributes/features_rest/width": [10],
        "attributes/head/tensors": [[]],
        "attributes/head/tensors/0/0": ["a\n"],
        "attributes/head/tensors/1/1": [[2, 0]],
        "attributes/head/tensors/1": [["b", [2], 3]],
        "up": [None, [0, 0, 0], [0, 0, 1, 0], [0, 1e-200, 0]],
        "up/1": [1e30],
        "start": [None],
        "start/pose": [POSE[:2], [POSE[1], POSE[0], POSE[2]], [[1.06, 0, 0, 0], *POSE[1:]]],
        "start/pose/0/3": [1e30],
        "start/intrinsics/1": [0],
        "start/intrinsics/2": [-1e10],
        "start/size/0": [0],
        "start/size/1": [480.5],
    },
    "container": {"sections/1/dtype": ["|O"], "sections/1/sha256": [64 * "g"], "sections/1/shape": [[]]},
    "model": {"sh_degree": [5], "head/precision": ["fp64"], "trained_focal/0": [1e30], "trained_focal": [[5]]},
}
CASES = [(schema, *case) for schema, places in WRONG.items() for case in places.items()]


@pytest.mark.parametrize(("schema", "place", "values"), CASES)
def test_the_first_wrong_place_is_named(schema, place, values):
    for value in values:
        changed = deepcopy(VALID[schema])
        put(changed, {place: value})
        assert fault(changed, FORMAT[schema], "x").startswith("x." + place.replace("/", ".")), value


def test_names_are_unique_and_heads_have_no_other_option():
    twice = [["a", [2, 2]], ["a", [2]]]
    header = {**HEADER, "attributes": {**ATTRIBUTES, "head": {**ATTRIBUTES["head"], "tensors": twice}}}
    assert fault(header, FORMAT["header"]) == "attributes.head.tensors"
    assert fault({"sections": [SECTION, SECTION]}, FORMAT["container"]) == "sections"
    many = {**SECTION, "parts": [1] * 10**5}  # no loop of Python over them
    assert fault({"sections": [many]}, FORMAT["container"]) is None
    assert fault({"sections": [{**many, "parts": [*many["parts"], -1]}]}, FORMAT["container"]) == "sections.0.parts"
    assert fault({**MODEL, "head": {**HEAD, "other": 4}}, FORMAT["model"]) == "head"
    assert fault({**MODEL, "other": 4}, FORMAT["model"]) is None
    assert fault({key: value for key, value in MODEL.items() if key != "sh_degree"}, FORMAT["model"]) == "sh_degree"


def test_the_format_lists_what_the_code_knows():
    model = FORMAT["model"]["properties"]
    kinds = get_type_hints(HeadConfig)
    for name in ("size", "precision"):
        assert set(model["head"]["properties"][name]["enum"]) == set(get_args(kinds[name]))
    assert set(model["head"]["properties"]["mode"]["enum"]) == set(get_args(kinds["mode"])) - {"auto", "off"}
    assert set(model["background_color"]["enum"]) == set(get_args(Background))
    assert model["sh_degree"]["maximum"] == MAX_SH_DEGREE
    widths = FORMAT["header"]["properties"]["attributes"]["properties"]["features_rest"]["properties"]["width"]["enum"]
    assert widths == [3 * ((degree + 1) ** 2 - 1) for degree in range(1, MAX_SH_DEGREE + 1)]


def test_headers_are_json_of_utf8_with_numbers_of_float64():
    assert parsed(b' {"a": [1, 2.5, 1E2]}\n') == {"a": [1, 2.5, 100.0]}
    deepest = LIMITS["depth"]
    assert parsed(b"[" * deepest + b"]" * deepest)
    assert parsed(b"1" + b"0" * 300)
    wrong = [b"[" * (deepest + 1) + b"]" * (deepest + 1), b"[" * 100_000, b"1" + b"0" * 400, b"1" + b"0" * 5000]
    wrong += [b"NaN", b"1e999", b"-1e999", b"01", b"{} {}", "{}".encode("utf-16"), b"\xef\xbb\xbf{}", b'"\xff"']
    for text in (*wrong, b'"\xed\xa0\x80"'):  # a surrogate
        with pytest.raises((ValueError, RecursionError), match=r"\w"):
            parsed(text)


SECTIONS = {
    "an image without width": ("cameras/sizes", np.array([[64, 48], [0, 24]], np.uint32)),
    "a focal length of 0": ("cameras/intrinsics", np.array([[0, 1, 0, 0], [1, 1, 0, 0]], np.float64)),
    "a focal length beyond float32": ("cameras/intrinsics", np.array([[1, 1, 0, 0], [1, 1e300, 0, 0]], np.float64)),
    "a mean whose sums overflow": ("scales/mean", np.full(3, 3e38, np.float32)),
    "an image of 16,385 pixels": ("cameras/sizes", np.array([[16385, 48], [32, 24]], np.uint32)),
    "a camera too few": ("cameras/sizes", np.array([[64, 48]], np.uint32)),
    "a pose that is infinite": ("cameras/poses", np.full((2, 3, 4), np.inf, np.float32)),
    "a basis of another size": ("features_rest/basis", np.zeros(80, np.int8)),
    "a mean of another size": ("features_rest/mean", np.zeros(8, np.float32)),
    "a mean that is not finite": ("scales/mean", np.full(3, np.nan, np.float32)),
    "levels of another dtype": ("opacities/levels", np.zeros(9, np.int8)),
    "levels in two dimensions": ("opacities/levels", np.zeros((1, 9), np.uint8)),
    "gaps of another dtype": ("means/gaps", np.zeros(9, np.uint16)),
    "a head without its last bias": ("head/plain", np.zeros(3, np.float32)),
    "a head with a step too few": ("head/steps", np.zeros(3, np.float32)),
    "a head with a column too few": ("head/columns", np.zeros(2, np.float32)),
    "weights that are not finite": ("head/steps", np.full(4, np.nan, np.float32)),
    "weights beyond float32": ("head/steps", np.full(4, 3e38, np.float32)),
    "too few blocks": ("means/low", np.zeros((0, 3), np.float32)),
}


@pytest.fixture
def path(tmp_path):
    write_fitted(tmp_path / "a.sundae", *fit_scene(full_scene(40, 1, 3)))
    return tmp_path / "a.sundae"


@pytest.mark.parametrize("case", SECTIONS)
def test_sections_beyond_the_limits_are_refused(path, case):
    name, array = SECTIONS[case]
    assert name in container.read_header(path).sections
    resection(path, name, array)
    refused(read_scene, path, kind=PackError)


@pytest.mark.parametrize("name", ["means/gaps", "quats/levels", "features_rest/levels", "head/levels"])
@pytest.mark.parametrize("stream", [np.zeros(0), np.zeros(50), np.full(50, 255), np.arange(256)])
def test_a_stream_of_other_numbers_is_refused(path, name, stream):
    resection(path, name, stream.astype(np.uint8))
    refused(read_scene, path, "a stream does not end with its last number", PackError)


SHAPES = [[4, 3, 3, 3], [4, 3, 9], [4, 3, 9, 1, 1]]


@pytest.mark.parametrize("shape", [*SHAPES, [4, 3, 9, 1, 1, 1], [4, 27], [4, 3, 10]])
def test_shapes_of_the_head(path, shape):
    restate(path, {"attributes/head/tensors": [["a.bias", [4]], ["a.weight", shape]]})
    if shape in SHAPES:
        assert list(read_scene(path).head["a.weight"].shape) == shape
    else:
        refused(read_scene, path, kind=PackError)
    restate(path, {"attributes/head/tensors": [["a.weight", [1 << 27, 1]]], "attributes/head/weights": 1 << 27})
    refused(read_scene, path, "would unpack to", PackError)


def test_whole_numbers_may_be_written_as_real_ones_and_sections_may_reach_their_limits(path):
    def real(value):
        return json.loads(json.dumps(value), parse_int=float)

    truth = read_scene(path)
    restate(path, {name: real for name in ("primitives", "attributes", "sections")})
    found = read_scene(path)
    assert all(torch.equal(found.gaussians[name], value) for name, value in truth.gaussians.items())
    assert all(torch.equal(found.head[name], value) for name, value in truth.head.items())
    path.write_bytes(container.restated(path.read_bytes(), {"up": [0, 0, 1], "name": "longer"}))
    assert read_scene(path).meta == {**truth.meta, "up": [0, 0, 1], "name": "longer"}
    resection(path, "cameras/sizes", np.array([[16384, 1], [1, 16384]], np.uint32))
    assert read_scene(path).cameras["sizes"].tolist() == [[16384, 1], [1, 16384]]


def test_a_file_of_another_length_or_removed_in_between_is_reported(path):
    header = container.read_header(path)
    path.write_bytes(path.read_bytes() + b"\0")
    refused(read_scene, path, "its header states", PackError)
    path.unlink()
    for read in (lambda: container.read_sections(path, header), lambda: read_scene(path)):
        with pytest.raises(PackError, match=r"cannot be read \(No such file"):
            read()


@pytest.mark.parametrize(("version", "remedy"), [(1, "pack the run again"), (2, "pack"), (4, "update this program")])
def test_another_version_has_an_error_of_its_own(path, version, remedy):
    content = bytearray(path.read_bytes())
    content[8] = version
    path.write_bytes(content)
    refused(read_scene, path, f"version {version} of the format, this program reads 3; {remedy}", PackError)
