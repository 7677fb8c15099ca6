"""A codec rounds to the values that a reader decodes, bit for bit, also for values to which it was not fitted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from fields import random_field
from hard_values import hard_values
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from sundae_ns.errors import PackError
from sundae_ns.storage.packing import (
    PackConfig,
    Scene,
    fit_scene,
    quantize,
    read_scene,
    transform,
    write_fitted,
    write_scene,
)
from sundae_ns.storage.packing.codecs import HeadCodec
from sundae_ns.storage.packing.container import Floats

hard = given(
    st.sampled_from(["normal", "constant", "huge", "tiny", "outliers"]), st.integers(1, 500), st.integers(0, 2**16)
)


def drifted(x: Floats, seed: int) -> Floats:
    """Values after training: moved, and some out of range."""
    rng = np.random.default_rng(seed + 1)
    moved = x + 0.05 * x.std() * rng.normal(size=x.shape)
    moved[rng.random(len(x)) < 0.01] *= 3
    return moved.astype(np.float32)


@hard
def test_uniform(kind: str, n: int, seed: int) -> None:
    x = hard_values(kind, n, 3, seed)
    color = seed % 2 == 0
    codec = quantize.fit_uniform(x, 4 + seed % 13, color=color)
    for y in (x, drifted(x, seed)):
        _, arrays = codec.encode(y)
        codes = arrays["codes"]
        if color:
            codes = arrays["codes"] = np.stack([codes[0] + codes[1], codes[1], codes[2] + codes[1]])
        found = quantize.dequantize(low=codec.low.numpy(), step=codec.step.numpy(), **arrays)
        assert np.array_equal(codec.rounded(torch.from_numpy(y)).numpy(), found)
        assert codes.max() < 2**codec.bits


@given(st.integers(1, 500), st.integers(0, 2**16), st.integers(4, 16))
def test_rotations(n: int, seed: int, bits: int) -> None:
    q = hard_values("normal", n, 4, seed)
    q[::7] = [0.5, -0.5, 0.5, 0.5]
    q[::11] = 0
    codec = quantize.Rotations(bits)
    found = quantize.dequantize_rotations(**codec.encode(q)[1], bits=bits)
    assert np.array_equal(codec.rounded(torch.from_numpy(q)).numpy(), found)


@hard
def test_weights(kind: str, n: int, seed: int) -> None:
    x, bits = hard_values(kind, n, 18, seed).reshape(n, 2, 3, 3), 3 + seed % 6
    codec = HeadCodec(bits, {"w": quantize.weight_steps(torch.from_numpy(x), bits)})
    for y in (x, drifted(x, seed)):
        _, arrays = codec.encode({"w": torch.from_numpy(y)})
        codes = torch.from_numpy(arrays["weights"].reshape(x.shape))
        found = quantize.weights_at(codes, torch.from_numpy(arrays["steps"]))
        assert torch.equal(codec.rounded("w", torch.from_numpy(y)), found)
        assert codes.int().abs().max() < 2 ** (bits - 1)


@hard
def test_transform(kind: str, n: int, seed: int) -> None:
    x = hard_values(kind, n, 9, seed)
    codec = transform.fit(x, 0.03)
    for y in (x, drifted(x, seed)):
        _, arrays = codec.encode(y)
        arrays["basis"] = arrays["basis"].reshape(9, 9)
        found = transform.restore(step=codec.step, **arrays)
        assert np.array_equal(codec.rounded(torch.from_numpy(y)).numpy(), found)
        assert np.abs(arrays["codes"].astype(int)).max(initial=0) <= codec.limit


def scene(n: int = 700) -> Scene:
    g = torch.Generator().manual_seed(1)
    head = {"a.weight": torch.randn(4, 3, 3, 3, generator=g), "a.bias": torch.randn(4, generator=g)}
    return Scene(random_field(n), head)


@pytest.mark.parametrize(
    "config",
    [
        PackConfig(block=100),
        PackConfig(scale_bits=5, rotation_bits=6, feature_bits=4, head_bits=4, harmonics_step=0.1, position_bits=10),
        PackConfig(head="fp16", feature_bits=12),
    ],
)
def test_a_file_holds_the_values_rounded_in_training(tmp_path: Path, config: PackConfig) -> None:
    fitted, codecs = fit_scene(scene(), config)
    g = torch.Generator().manual_seed(1)
    moved = {name: value + 0.02 * torch.randn(value.shape, generator=g) for name, value in fitted.field.items()}
    assert codecs.head is not None
    head = {name: codecs.head.within(name, 1.1 * value) for name, value in fitted.head.items()}
    write_fitted(tmp_path / "a.sundae", Scene(moved, head), codecs)
    found = read_scene(tmp_path / "a.sundae")
    rounded, rounded_head = codecs.rounded(moved), codecs.rounded_head(head)
    assert torch.equal(found.field["means"], fitted.field["means"])
    for name in codecs.field:
        assert torch.equal(found.field[name], rounded[name]), name
        assert not torch.equal(rounded[name], moved[name]), name
    assert found.head.keys() == head.keys()
    for name, value in found.head.items():
        assert torch.equal(value, rounded_head[name]), name


def test_packing_is_fitting_and_writing(tmp_path: Path) -> None:
    write_scene(tmp_path / "a.sundae", scene(), PackConfig(feature_bits=5))
    write_fitted(tmp_path / "b.sundae", *fit_scene(scene(), PackConfig(feature_bits=5)))
    assert (tmp_path / "a.sundae").read_bytes() == (tmp_path / "b.sundae").read_bytes()


def without(name: str) -> Scene:
    whole = scene()
    return Scene({key: value for key, value in whole.field.items() if key != name}, whole.head)


@pytest.mark.parametrize("other", [scene(650), without("features"), Scene(scene().field)])
def test_codecs_of_another_scene_are_refused(tmp_path: Path, other: Scene) -> None:
    _, codecs = fit_scene(scene())
    with pytest.raises(PackError, match="another scene"):
        write_fitted(tmp_path / "a.sundae", other, codecs)
    assert not list(tmp_path.iterdir())


def test_fewer_bits_of_the_head_are_fewer_bytes(tmp_path: Path) -> None:
    big = {"a.weight": torch.randn(64, 64, 3, 3, generator=torch.Generator().manual_seed(0))}
    whole = Scene(scene().field, big)
    sizes = {}
    for bits in (8, 6, 4):
        report = write_scene(tmp_path / "a.sundae", whole, PackConfig(head_bits=bits))
        sizes[bits] = report.sections["head/weights"]
        weight, found = big["a.weight"], read_scene(tmp_path / "a.sundae").head["a.weight"]
        step = weight.flatten(1).abs().amax(dim=1) / (2 ** (bits - 1) - 1)
        assert ((found - weight).abs().flatten(1).amax(dim=1) <= step / 2 * (1 + 1e-5)).all()
    assert sizes[6] < 0.8 * sizes[8]
    assert sizes[4] < 0.7 * sizes[6]


@pytest.mark.gpu
def test_rounding_is_the_same_on_a_gpu() -> None:
    """Levels are equal; values differ in the last bits, because a GPU rounds roots, quotients and sums differently."""
    fitted, codecs = fit_scene(scene(), PackConfig(feature_bits=5))
    cuda = torch.device("cuda")
    on_cpu, on_gpu = codecs.rounded(fitted.field), codecs.to(cuda).rounded(_moved(fitted.field, cuda))
    for name in codecs.field:
        torch.testing.assert_close(on_gpu[name].cpu(), on_cpu[name], rtol=1e-6, atol=1e-6, msg=name)
    head = codecs.to(cuda).rounded_head(_moved(fitted.head, cuda))
    for name, value in codecs.rounded_head(fitted.head).items():
        torch.testing.assert_close(head[name].cpu(), value, rtol=1e-6, atol=0, msg=name)


def _moved(tensors: dict[str, Tensor], device: torch.device) -> dict[str, Tensor]:
    return {name: value.to(device) for name, value in tensors.items()}
