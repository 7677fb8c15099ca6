"""Packed scenes: round trip, error bounds, sizes and refusals."""

import hashlib
import json
import zlib

import numpy as np
import pytest
import torch
from fields import matched, random_field
from packed_scenes import full_scene

from sundae_ns.core.errors import ConfigError, PackError
from sundae_ns.io.pack import container
from sundae_ns.io.pack.codecs import aligned, rotation_bound
from sundae_ns.io.pack.config import STEPS, PackConfig
from sundae_ns.io.pack.container import read_header
from sundae_ns.io.pack.packed_scene import PackedScene, fit_scene, read_scene, write_fitted


@pytest.mark.parametrize("config", [PackConfig(), PackConfig(head_step=0.005, position_bits=16)])
def test_everything_is_decoded_within_the_stated_bounds(tmp_path, config):
    given = full_scene(meta={"model": {"sh_degree": 2}, "name": "überall"})
    path, truth = tmp_path / "a.sundae", dict(given.gaussians)
    for name in ("b.sundae", "a.sundae"):
        write_fitted(tmp_path / name, *fit_scene(given, config))
    assert path.read_bytes() == (tmp_path / "b.sundae").read_bytes()
    scene = read_scene(path)
    assert scene.meta == given.meta
    assert all(torch.equal(scene.cameras[name], value) for name, value in given.cameras.items())
    about = read_header(path).meta["attributes"]
    found = matched(scene.gaussians, truth)
    # The axes of ellipsoids come in another order.
    quats, scales = aligned(truth["quats"].numpy(), truth["scales"].numpy())
    truth["scales"] = torch.from_numpy(scales)
    assert [*found] == [*truth]
    for name in ("scales", "features_dc", "features_rest", "opacities", "features"):
        assert found[name].shape == truth[name].shape
        bound = torch.tensor(about[name]["bound"])
        off = (found[name] - truth[name]).abs()
        assert (off <= bound + 1e-5).all(), name
        assert off.max() > 0.3 * bound.min(), name
    assert (found["means"] - truth["means"]).abs().max() < 7 / 2**config.position_bits
    turned = (found["quats"] * torch.from_numpy(quats)).sum(dim=1).abs().clamp(max=1)
    assert 2 * torch.arccos(turned).max() <= rotation_bound(config.rotation_step) + 1e-3
    assert torch.equal(scene.head["a.bias"], given.head["a.bias"])
    off = (scene.head["a.weight"] - given.head["a.weight"]).abs().reshape(4, -1)
    largest = given.head["a.weight"].reshape(4, -1).abs().amax(dim=1, keepdim=True)
    assert (off <= largest * config.head_step / 2 * 1.001).all()


@pytest.mark.parametrize("n", [1, 2, 17])
@pytest.mark.parametrize(("degree", "features"), [(0, 0), (3, 13), (4, 1)])
def test_small_fields(tmp_path, n, degree, features):
    truth = random_field(n, degree, features)
    report = write_fitted(tmp_path / "a.sundae", *fit_scene(PackedScene(truth)))
    scene = read_scene(tmp_path / "a.sundae")
    assert {name: value.shape for name, value in scene.gaussians.items()} == {k: v.shape for k, v in truth.items()}
    assert (scene.head, scene.cameras, scene.meta) == ({}, None, {})
    assert report.bytes == (tmp_path / "a.sundae").stat().st_size
    assert (sum(report.bits.values()) - report.bits["all"]) * n / 8 == pytest.approx(report.bytes)
    if n == 1:  # constant attributes are exact
        exact = {"means", "opacities", "features"} & truth.keys()
        assert all(torch.equal(scene.gaussians[name], truth[name]) for name in exact)


CONSTANT = {name: value.expand(32_000, *value.shape[1:]) for name, value in random_field(1, 3, 13).items()}
REPETITIVE = [PackedScene(CONSTANT), PackedScene(random_field(40), {"a.weight": torch.zeros(1000, 2300)})]


@pytest.mark.parametrize("scene", REPETITIVE, ids=["field", "head"])
def test_a_scene_that_compresses_too_well_is_padded(tmp_path, scene):
    report = write_fitted(tmp_path / "a.sundae", *fit_scene(scene))
    unpacked = 4 * sum(value.numel() for value in (*scene.gaussians.values(), *scene.head.values()))
    assert unpacked > container.SPARE
    assert report.sections["padding"] > 0
    assert report.bytes - report.sections["header"] < 1.05 * (unpacked - container.SPARE) / container.MAX_RATIO
    found = read_scene(tmp_path / "a.sundae")
    if scene.head:
        assert torch.equal(found.head["a.weight"], scene.head["a.weight"])
    else:
        assert all(torch.equal(found.gaussians[name], CONSTANT[name]) for name in ("means", "opacities", "features"))


def test_packing_takes_few_bytes(tmp_path):
    """This field takes 25 bytes per Gaussian instead of 272."""
    truth = random_field(20_000, 3, 9)
    grey = torch.randn(20_000, 15, 1, generator=torch.Generator().manual_seed(0)).expand(-1, -1, 3)
    truth["features_rest"] = 0.05 * grey * torch.rand(20_000, 1, 1) ** 4
    truth["means"][:3], truth["features_rest"][:3] = 1e5, 1e4  # a few are no reason for more bytes of all
    report = write_fitted(tmp_path / "a.sundae", *fit_scene(PackedScene(truth)))
    limits = {"means": 30, "features_rest": 45, "all": 8 * 26}
    assert all(report.bits[name] < limit for name, limit in limits.items()), report.bits


def _with(**changes):
    return PackedScene(random_field() | changes)


def _spoiled(name, value):
    field = random_field()
    field[name][5, 1] = value
    return PackedScene(field), "1 of 600 Gaussians are not finite"


CAMERAS = full_scene(1).cameras
UNPACKABLE = [
    *(_spoiled(*at) for at in (("means", torch.nan), ("features", torch.inf), ("quats", -torch.inf))),
    (PackedScene(random_field(0)), "no Gaussians"),
    (PackedScene({k: v for k, v in random_field().items() if k != "quats"}), "no quats"),
    (_with(scales=torch.zeros(600, 2)), "scales has shape"),
    (_with(features_rest=torch.zeros(600, 7, 3)), "features_rest has shape"),
    (_with(features=torch.zeros(7, 3)), r"features has shape .*; it must be \[600, 3\]"),
    (_with(features=torch.zeros(600)), "features has shape"),
    (_with(features=torch.zeros(600, 0)), "features has shape"),
    (PackedScene(random_field(), {"a": torch.full((2, 2), torch.nan)}), "head has weights that are not finite"),
    (PackedScene(random_field(), cameras={**CAMERAS, "intrinsics": -CAMERAS["intrinsics"]}), "intrinsics"),
    (full_scene(40, meta={"name": "x" * container.MAX_HEADER}), "the header takes"),
]


@pytest.mark.parametrize(("scene", "words"), UNPACKABLE)
def test_scenes_that_cannot_be_packed_are_refused(tmp_path, scene, words):
    with pytest.raises(PackError, match=words):
        write_fitted(tmp_path / "a.sundae", *fit_scene(scene))
    assert not list(tmp_path.iterdir())


def test_a_nan_in_the_header_is_not_written(tmp_path):
    """Readers refuse a header with NaN."""
    with pytest.raises(ValueError, match="JSON"):
        write_fitted(tmp_path / "a.sundae", *fit_scene(full_scene(40, meta={"scale": float("nan")})))
    assert not list(tmp_path.iterdir())


# Below the least, the least, the most, above the most.
LIMITS = {"position_bits": (3, 4, 16, 17), "block": (15, 16, 1 << 20, (1 << 20) + 1)}
LIMITS |= dict.fromkeys(STEPS, (0.99e-4, 1e-4, 1.0, 1.01))


@pytest.mark.parametrize("name", LIMITS)
def test_options_are_accepted_up_to_their_limits(tmp_path, name):
    below, least, most, above = LIMITS[name]
    for value in (below, above):
        with pytest.raises(ConfigError, match=name.replace("_", "-")):
            PackConfig(**{name: value}).validate()
    sizes, given = [], full_scene(40, 1, 3)
    for value in (least, most):
        sizes.append(write_fitted(tmp_path / "a.sundae", *fit_scene(given, PackConfig(**{name: value}))).bytes)
        found = read_scene(tmp_path / "a.sundae").gaussians
        assert {key: value.shape for key, value in found.items()} == {k: v.shape for k, v in given.gaussians.items()}
        assert all(torch.isfinite(value).all() for value in found.values())
    if name != "block":
        assert (sizes[0] < sizes[1]) == name.endswith("bits")


def test_the_file_follows_its_documentation(tmp_path):
    """Decode a section by ``docs/formats.md``, without the package's reader."""
    path = tmp_path / "a.sundae"
    write_fitted(path, *fit_scene(PackedScene(random_field())))
    content = path.read_bytes()
    assert content[:8] == b"\x89SUNDAE\n"
    version, length = np.frombuffer(content[8:16], "<u4")
    assert version == 3
    header = content[48 : 48 + length]
    assert hashlib.sha256(header).digest() == content[16:48]
    meta, offset = json.loads(header), 48 + int(length)
    arrays = {}
    for section in meta["sections"]:
        end = offset + sum(section["parts"])
        assert hashlib.sha256(content[offset:end]).hexdigest() == section["sha256"]
        size = np.dtype(section["dtype"]).itemsize * int(np.prod(section["shape"])) // max(len(section["parts"]), 1)
        starts = [offset + sum(section["parts"][:i]) for i in range(len(section["parts"]))]
        frames = [content[start : start + part] for start, part in zip(starts, section["parts"])]
        planes = [frame if len(frame) == size else zlib.decompress(frame, wbits=-15) for frame in frames]
        arrays[section["name"]], offset = (section, planes), end
    assert offset == len(content)
    section, planes = arrays["means/low"]
    low = np.stack([np.frombuffer(plane, np.uint8) for plane in planes], axis=1).view("<f4").reshape(section["shape"])
    assert np.array_equal(low.min(axis=0), read_scene(path).gaussians["means"].numpy().min(axis=0))
