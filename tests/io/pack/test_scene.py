"""Packed scenes: round trip, error bounds, sizes and refusals."""

import hashlib
import json
import zlib

import numpy as np
import pytest
import torch
from fields import random_field

from sundae_ns.core.errors import PackError
from sundae_ns.io.pack import container, quantize
from sundae_ns.io.pack.config import PackConfig
from sundae_ns.io.pack.container import read_header
from sundae_ns.io.pack.packed_scene import PackedScene, read_scene, write_scene


def head():
    g = torch.Generator().manual_seed(1)
    return {"net.a.weight": torch.randn(4, 3, 3, 3, generator=g), "net.a.bias": torch.randn(4, generator=g)}


def cameras(n=3):
    return {
        "poses": torch.eye(4)[:3].repeat(n, 1, 1),
        "intrinsics": torch.tensor([[500.25, 501.5, 319.5, 239.5]]).double().repeat(n, 1),
        "sizes": torch.tensor([[640, 480]]).repeat(n, 1),
    }


def matched(found, truth):
    """``found`` in the order of ``truth``, by the nearest centre."""
    nearest = torch.cdist(truth["means"], found["means"]).argmin(dim=1)
    assert len(nearest.unique()) == len(nearest)
    return {name: value[nearest] for name, value in found.items()}


@pytest.mark.parametrize("config", [PackConfig(), PackConfig(head_step=0.005, position_bits=16)])
def test_everything_is_decoded_within_the_stated_bounds(tmp_path, config):
    path, truth = tmp_path / "a.sundae", random_field()
    meta = {"model": {"sh_degree": 2}, "name": "überall"}
    write_scene(path, PackedScene(truth, head(), cameras(), meta), config)
    scene = read_scene(path)
    assert scene.meta == meta
    assert scene.cameras is not None
    for name, value in cameras().items():
        assert torch.equal(scene.cameras[name], value), name
    about = read_header(path).meta["attributes"]
    found = matched(scene.gaussians, truth)
    # The axes of ellipsoids come in another order.
    quats, scales = quantize.aligned(truth["quats"].numpy(), truth["scales"].numpy())
    truth["scales"] = torch.from_numpy(scales)
    assert list(found) == list(
        {name: None for name in ("means", "scales", "quats", "features_dc", "features_rest")}
    ) + [
        "opacities",
        "features",
    ]
    for name in ("scales", "features_dc", "features_rest", "opacities", "features"):
        assert found[name].shape == truth[name].shape
        bound = torch.tensor(about[name]["bound"])
        off = (found[name] - truth[name]).abs()
        assert (off <= bound + 1e-5).all(), name
        assert off.max() > 0.3 * bound.min(), name
    assert (found["means"] - truth["means"]).abs().max() < 7 / 2**config.position_bits
    turned = (found["quats"] * torch.from_numpy(quats)).sum(dim=1).abs().clamp(max=1)
    assert 2 * torch.arccos(turned).max() <= quantize.rotation_bound(config.rotation_step) + 1e-3
    assert torch.equal(scene.head["net.a.bias"], head()["net.a.bias"])
    off = (scene.head["net.a.weight"] - head()["net.a.weight"]).abs().reshape(4, -1)
    largest = head()["net.a.weight"].reshape(4, -1).abs().amax(dim=1, keepdim=True)
    assert (off <= largest * config.head_step / 2 * 1.001).all()


@pytest.mark.parametrize("n", [1, 2, 17])
@pytest.mark.parametrize(("degree", "features"), [(0, 0), (3, 13), (4, 1)])
def test_small_fields(tmp_path, n, degree, features):
    truth = random_field(n, degree, features)
    report = write_scene(tmp_path / "a.sundae", PackedScene(truth))
    scene = read_scene(tmp_path / "a.sundae")
    assert {name: value.shape for name, value in scene.gaussians.items()} == {k: v.shape for k, v in truth.items()}
    assert (scene.head, scene.cameras, scene.meta) == ({}, None, {})
    assert report.bytes == (tmp_path / "a.sundae").stat().st_size
    assert sum(report.bits.values()) * n / 8 == pytest.approx(report.bytes)


def test_constant_attributes_are_exact(tmp_path):
    one = random_field(1)
    truth = {name: value.repeat(40, *([1] * (value.ndim - 1))) for name, value in one.items()}
    write_scene(tmp_path / "a.sundae", PackedScene(truth))
    found = read_scene(tmp_path / "a.sundae").gaussians
    for name in ("means", "opacities", "features"):
        assert torch.equal(found[name], truth[name]), name


def test_a_scene_that_compresses_too_well_is_padded(tmp_path):
    path = tmp_path / "a.sundae"
    one = random_field(1, 3, 13)
    truth = {name: value.expand(60_000, *value.shape[1:]) for name, value in one.items()}
    report = write_scene(path, PackedScene(truth))
    unpacked = 4 * sum(value.numel() for value in truth.values())
    assert unpacked > container.SPARE
    assert report.sections["padding"] > 0
    assert report.bytes < 1.05 * (unpacked - container.SPARE) / container.MAX_RATIO
    assert torch.equal(read_scene(path).gaussians["means"], truth["means"])


def test_packing_takes_few_bytes(tmp_path):
    """This field takes 25 bytes per Gaussian instead of 272."""
    g = torch.Generator().manual_seed(0)
    truth = random_field(20_000, 3, 9)
    truth["features_rest"] = (
        0.05 * torch.randn(20_000, 15, 1, generator=g).expand(-1, -1, 3) * torch.rand(20_000, 1, 1) ** 4
    )
    report = write_scene(tmp_path / "a.sundae", PackedScene(truth))
    assert report.bits["means"] < 30
    assert report.bits["features_rest"] < 45
    assert sum(report.bits.values()) / 8 < 26


def test_packing_is_deterministic(tmp_path):
    for name in ("a", "b"):
        write_scene(tmp_path / name, PackedScene(random_field(), head(), cameras()))
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def _with(**changes):
    return PackedScene(random_field() | changes)


def _spoiled(name, value):
    broken = random_field()
    broken[name][5, 1] = value
    return PackedScene(broken)


UNPACKABLE = [
    *((_spoiled(*at), "1 of 600 Gaussians are not finite") for at in (("means", torch.nan), ("features", torch.inf))),
    (_spoiled("quats", -torch.inf), "1 of 600 Gaussians are not finite"),
    (PackedScene(random_field(0)), "no Gaussians"),
    (PackedScene({k: v for k, v in random_field().items() if k != "quats"}), "no quats"),
    (_with(scales=torch.zeros(600, 2)), "scales has shape"),
    (_with(features_rest=torch.zeros(600, 7, 3)), "features_rest has shape"),
    (_with(features=torch.zeros(7, 3)), r"features has shape .*; it must be \[600, 3\]"),
    (_with(features=torch.zeros(600)), "features has shape"),
    (_with(features=torch.zeros(600, 0)), "features has shape"),
    (PackedScene(random_field(), {"a": torch.full((2, 2), torch.nan)}), "head has weights that are not finite"),
]


@pytest.mark.parametrize(("scene", "words"), UNPACKABLE)
def test_scenes_that_cannot_be_packed_are_refused(tmp_path, scene, words):
    with pytest.raises(PackError, match=words):
        write_scene(tmp_path / "a.sundae", scene)
    assert not list(tmp_path.iterdir())


def test_a_byte_too_many_is_refused(tmp_path):
    path = tmp_path / "a.sundae"
    write_scene(path, PackedScene(random_field(40, 1, 1)))
    path.write_bytes(path.read_bytes() + b"\0")
    with pytest.raises(PackError, match="its header states"):
        read_scene(path)


def test_another_version_has_an_error_of_its_own(tmp_path):
    path = tmp_path / "a.sundae"
    write_scene(path, PackedScene(random_field(20)))
    content = bytearray(path.read_bytes())
    for version, remedy in ((1, "pack the run again"), (2, "pack the run again"), (4, "update this program")):
        content[8] = version
        path.write_bytes(content)
        with pytest.raises(PackError, match=f"version {version} of the format, this program reads 3; {remedy}"):
            read_scene(path)
    with pytest.raises(PackError, match=r"cannot be read \(No such file"):
        read_scene(tmp_path / "b.sundae")


def test_the_file_follows_its_documentation(tmp_path):
    """Decode a section by ``docs/formats.md``, without the package's reader."""
    path = tmp_path / "a.sundae"
    write_scene(path, PackedScene(random_field()))
    content = path.read_bytes()
    assert content[:8] == b"\x89SUNDAE\n"
    version, length = np.frombuffer(content[8:16], "<u4")
    assert version == 3
    header = content[48 : 48 + length]
    assert hashlib.sha256(header).digest() == content[16:48]
    meta, offset = json.loads(header), 48 + int(length)
    arrays = {}
    for section in meta["sections"]:
        stored = content[offset : offset + sum(section["parts"])]
        assert hashlib.sha256(stored).hexdigest() == section["sha256"]
        size = np.dtype(section["dtype"]).itemsize * int(np.prod(section["shape"]))
        planes, start = [], 0
        for part in section["parts"]:
            frame = stored[start : start + part]
            whole = len(frame) * len(section["parts"]) == size
            planes.append(frame if whole else zlib.decompress(frame, wbits=-15))
            start += part
        arrays[section["name"]] = (section, planes)
        offset += len(stored)
    assert offset == len(content)
    section, planes = arrays["means/low"]
    low = np.stack([np.frombuffer(plane, np.uint8) for plane in planes], axis=1).view("<f4").reshape(section["shape"])
    assert np.array_equal(low.min(axis=0), read_scene(path).gaussians["means"].numpy().min(axis=0))
