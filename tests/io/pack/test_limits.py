"""Limits of options, headers and sections: values at each limit are accepted, values just beyond it are refused."""

import hashlib
import json
import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from fields import random_field

from sundae_ns.core.errors import ConfigError, PackError
from sundae_ns.io.pack import container
from sundae_ns.io.pack.config import PackConfig
from sundae_ns.io.pack.packed_scene import PackedScene, read_scene, write_scene

Json = dict[str, Any]
LIMITS = {
    # below the minimum, minimum, maximum, above the maximum
    "position_bits": (3, 4, 16, 17),
    "block": (15, 16, 1 << 20, (1 << 20) + 1),
} | {
    f"{name}_step": (0.99e-4, 1e-4, 1.0, 1.01)
    for name in ("scale", "rotation", "color", "opacity", "harmonics", "feature", "head")
}


def scene():
    g = torch.Generator().manual_seed(1)
    head = {"a.weight": torch.randn(4, 3, 3, 3, generator=g), "a.bias": torch.randn(4, generator=g)}
    cameras = {
        "poses": torch.eye(4)[:3].repeat(2, 1, 1),
        "intrinsics": torch.tensor([[50.0, 51.0, 32.0, 24.0]]).double().repeat(2, 1),
        "sizes": torch.tensor([[64, 48], [32, 24]]),
    }
    return PackedScene(random_field(40, degree=1, features=3), head, cameras)


@pytest.mark.parametrize("name", LIMITS)
def test_options_are_accepted_up_to_their_limits(tmp_path, name):
    below, least, most, above = LIMITS[name]
    for value in (below, above):
        with pytest.raises(ConfigError, match=name.replace("_", "-")):
            PackConfig(**{name: value}).validate()
    sizes = []
    for value in (least, most):
        path = tmp_path / f"{value}.sundae"
        write_scene(path, scene(), PackConfig(**{name: value}))
        found = read_scene(path)
        assert {k: v.shape for k, v in found.gaussians.items()} == {k: v.shape for k, v in scene().gaussians.items()}
        assert all(torch.isfinite(value).all() for value in found.gaussians.values())
        sizes.append(path.stat().st_size)
    if name != "block":
        assert (sizes[0] < sizes[1]) == name.endswith("bits")


def restated(path, change):
    """Change the header of a file and keep its checksum valid."""
    content = path.read_bytes()
    (length,) = struct.unpack("<I", content[12:16])
    meta = json.loads(content[48 : 48 + length])
    change(meta)
    text = json.dumps(meta).encode()
    path.write_bytes(
        content[:12] + struct.pack("<I", len(text)) + hashlib.sha256(text).digest() + text + content[48 + length :]
    )


def resectioned(path, name, array):
    """Replace a section of a file and keep all checksums valid."""
    header = container.read_header(path)
    meta = {key: value for key, value in header.meta.items() if key != "sections"}
    path.write_bytes(container.encode(meta, {**container.read_sections(path, header), name: array})[0])


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


@pytest.mark.parametrize("case", SECTIONS)
def test_sections_beyond_the_limits_are_refused(tmp_path, case):
    path = tmp_path / "a.sundae"
    write_scene(path, scene())
    name, array = SECTIONS[case]
    assert name in container.read_header(path).sections
    resectioned(path, name, array)
    with pytest.raises(PackError):
        read_scene(path)


def test_sections_at_the_limits_are_read(tmp_path):
    path = tmp_path / "a.sundae"
    write_scene(path, scene())
    resectioned(path, "cameras/sizes", np.array([[16384, 1], [1, 16384]], np.uint32))
    found = read_scene(path)
    assert found.cameras is not None
    assert found.cameras["sizes"].tolist() == [[16384, 1], [1, 16384]]


@pytest.mark.parametrize("name", ["means/gaps", "quats/levels", "features_rest/levels", "head/levels"])
def test_a_stream_of_other_numbers_is_refused(tmp_path, name):
    path = tmp_path / "a.sundae"
    for stream in (
        np.zeros(0, np.uint8),
        np.zeros(50, np.uint8),
        np.full(50, 255, np.uint8),
        np.arange(256, dtype=np.uint8),
    ):
        write_scene(path, scene())
        resectioned(path, name, stream)
        with pytest.raises(PackError, match="a stream does not end with its last number"):
            read_scene(path)


@pytest.mark.parametrize(
    ("shape", "fits"),
    [
        ([4, 3, 3, 3], True),
        ([4, 3, 9], True),
        ([4, 3, 9, 1, 1], True),
        ([4, 3, 9, 1, 1, 1], False),
        ([4, 27], False),
        ([4, 3, 10], False),
    ],
)
def test_shapes_of_the_head(tmp_path, shape, fits):
    path = tmp_path / "a.sundae"
    write_scene(path, scene())
    restated(path, lambda meta: meta["attributes"]["head"].update(tensors=[["a.bias", [4]], ["a.weight", shape]]))
    if fits:
        assert list(read_scene(path).head["a.weight"].shape) == shape
    else:
        with pytest.raises(PackError):
            read_scene(path)


def test_cameras_that_readers_refuse_are_not_written(tmp_path):
    cameras = scene().cameras
    assert cameras is not None
    cameras["intrinsics"][0, 0] = -50.0
    with pytest.raises(PackError, match="intrinsics"):
        write_scene(tmp_path / "a.sundae", replace(scene(), cameras=cameras))


def test_whole_numbers_may_be_written_as_real_ones(tmp_path):
    path = tmp_path / "a.sundae"
    write_scene(path, scene())
    truth = read_scene(path)

    def real(meta):
        meta["primitives"] = float(meta["primitives"])
        for about in meta["attributes"].values():
            about |= {key: float(about[key]) for key in ("bits", "block", "width", "weights") if key in about}
        meta["attributes"]["head"]["tensors"] = [
            [n, [float(s) for s in shape]] for n, shape in meta["attributes"]["head"]["tensors"]
        ]
        for section in meta["sections"]:
            section |= {key: [float(value) for value in section[key]] for key in ("shape", "parts")}

    restated(path, real)
    found = read_scene(path)
    assert all(torch.equal(found.gaussians[name], value) for name, value in truth.gaussians.items())
    assert all(torch.equal(found.head[name], value) for name, value in truth.head.items())


def test_a_header_too_long_for_readers_is_not_written(tmp_path):
    path = tmp_path / "a.sundae"
    meta = {"name": "x" * container.MAX_HEADER}
    with pytest.raises(PackError, match="the header takes"):
        write_scene(path, replace(scene(), meta=meta))
    assert not list(tmp_path.iterdir())


def test_a_file_removed_after_its_header_was_read_is_reported(tmp_path):
    path = tmp_path / "a.sundae"
    write_scene(path, scene())
    header = container.read_header(path)
    path.unlink()
    with pytest.raises(PackError, match=r"cannot be read \(No such file"):
        container.read_sections(path, header)


def test_a_head_that_compresses_too_well_is_padded(tmp_path):
    path = tmp_path / "a.sundae"
    head = {"a.weight": torch.zeros(1000, 3500)}
    report = write_scene(path, PackedScene(scene().gaussians, head))
    unpacked = 4 * head["a.weight"].numel()
    assert report.sections["padding"] > 0
    assert container.SPARE + container.MAX_RATIO * report.bytes >= unpacked
    assert torch.equal(read_scene(path).head["a.weight"], head["a.weight"])


def test_a_nan_in_the_header_is_not_written(tmp_path):
    """Readers refuse a header with NaN."""
    with pytest.raises(ValueError, match="JSON"):
        write_scene(tmp_path / "a.sundae", replace(scene(), meta={"scale": float("nan")}))
    assert not list(tmp_path.iterdir())
