"""A codec rounds to the values that a reader decodes, bit for bit, also for values to which it was not fitted."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from fields import random_field
from hard_values import KINDS, drifted, hard_values
from hypothesis import given
from hypothesis import strategies as st
from packed_scenes import full_scene

from sundae_ns.core.errors import PackError
from sundae_ns.io.pack import entropy, quantize
from sundae_ns.io.pack.codecs import HeadCodec, Sensitivity, estimated_bits
from sundae_ns.io.pack.config import PackConfig
from sundae_ns.io.pack.packed_scene import PackedScene, fit_scene, read_scene, write_fitted, write_scene

hard = given(st.sampled_from(KINDS[:5]), st.integers(1, 500), st.integers(0, 2**16))


@hard
def test_weights(kind, n, seed):
    x, share = hard_values(kind, n, 18, seed).reshape(n, 2, 3, 3), 2.0 ** -(seed % 9)
    codec = HeadCodec({"w": quantize.weight_steps(torch.from_numpy(x), share)}, {"w": torch.tensor([1.0, 2.0**0.25])})
    for y in (x, drifted(x, seed)):
        _, levels, arrays = codec.encode({"w": torch.from_numpy(y)})
        steps = torch.from_numpy(arrays["steps"])[:, None] * torch.from_numpy(arrays["columns"])
        found = quantize.weights_at(torch.from_numpy(levels.reshape(x.shape)), steps)
        assert torch.equal(codec.rounded("w", torch.from_numpy(y)), found)


COARSE = {"scale_step": 0.5, "rotation_step": 0.1, "feature_step": 0.5, "head_step": 0.14, "harmonics_step": 0.1}
CONFIGS = [{"block": 100}, {**COARSE, "position_bits": 10}, {"head_step": 0.01, "feature_step": 0.001}]


@pytest.mark.parametrize("config", CONFIGS)
def test_a_file_holds_the_values_rounded_in_training(tmp_path, config):
    fitted, codecs = fit_scene(full_scene(), PackConfig(**config))
    g = torch.Generator().manual_seed(1)
    moved = {name: value + 0.02 * torch.randn(value.shape, generator=g) for name, value in fitted.gaussians.items()}
    head = {name: 1.1 * value for name, value in fitted.head.items()}
    write_fitted(tmp_path / "a.sundae", PackedScene(moved, head), codecs)
    found = read_scene(tmp_path / "a.sundae")
    rounded, rounded_head = codecs.rounded(moved), codecs.rounded_head(head)
    assert torch.equal(found.gaussians["means"], fitted.gaussians["means"])
    for name in codecs.gaussians:
        assert torch.equal(found.gaussians[name], rounded[name]), name
        assert not torch.equal(rounded[name], moved[name]), name
    assert found.head.keys() == head.keys()
    for name, value in found.head.items():
        assert torch.equal(value, rounded_head[name]), name


def without(name):
    whole = full_scene()
    return PackedScene({key: value for key, value in whole.gaussians.items() if key != name}, whole.head)


@pytest.mark.parametrize("other", [full_scene(650), without("features"), PackedScene(full_scene().gaussians)])
def test_codecs_of_another_scene_are_refused(tmp_path, other):
    _, codecs = fit_scene(full_scene())
    with pytest.raises(PackError, match="another scene"):
        write_fitted(tmp_path / "a.sundae", other, codecs)
    assert not list(tmp_path.iterdir())


def test_other_steps_keep_grids_and_bases(tmp_path):
    """Of a scene that has moved since, whose own bases would be others."""
    present = PackConfig(block=100, position_bits=11, head_step=0.1)
    fitted, codecs = fit_scene(full_scene(), present)
    moved = replace(fitted, gaussians={name: drifted_tensor(value) for name, value in fitted.gaussians.items()})
    wanted = replace(present, scale_step=0.2, rotation_step=0.002, head_step=0.8, position_bits=16, block=1024)
    other = codecs.with_steps(wanted, moved.gaussians, moved.head)
    assert other.blocks is codecs.blocks
    assert other.config == replace(wanted, position_bits=11, block=100)
    for name, codec in codecs.gaussians.items():
        factor = {"scales": 0.2 / 0.05, "quats": 0.002 / 0.008}.get(name, 1.0)
        found = other.gaussians[name]
        assert found.step == pytest.approx(factor * codec.step), name
        if isinstance(codec, quantize.Transform):
            assert isinstance(found, quantize.Transform)
            assert torch.equal(found.basis, codec.basis)
            assert torch.equal(found.mean, codec.mean)
    # Half of the largest weight, not eight tenths.
    torch.testing.assert_close(other.head.rows["a.weight"], 5 * codecs.head.rows["a.weight"])
    same = codecs.with_steps(present, moved.gaussians, moved.head)
    for number, these in enumerate((codecs, same, other)):
        write_fitted(tmp_path / f"{number}.sundae", moved, these)
    assert (tmp_path / "0.sundae").read_bytes() == (tmp_path / "1.sundae").read_bytes()
    found, shown = read_scene(tmp_path / "2.sundae").gaussians, other.rounded(moved.gaussians)
    assert all(torch.equal(found[name], shown[name]) for name in other.gaussians)


def test_steps_that_are_too_fine_for_a_row_become_larger():
    rows = hard_values("normal", 50, 3, 0)
    codec = quantize.fit_transform(rows, 0.01)
    rows[7] = 1e5
    finer = codec.with_step(0.0001, rows)
    assert finer.step > 0.005
    assert np.abs(finer.rounded(torch.from_numpy(rows)).numpy() - rows).max() < 0.1


def drifted_tensor(values):
    return torch.from_numpy(drifted(values.flatten(1).numpy(), 0)).reshape(values.shape)


@pytest.mark.gpu
def test_rounding_is_the_same_on_a_gpu():
    """Levels are equal; values differ in the last bits, because a GPU rounds roots, quotients and sums differently."""
    fitted, codecs = fit_scene(full_scene(), PackConfig(feature_step=0.3))
    cuda = torch.device("cuda")
    on_cpu, on_gpu = codecs.rounded(fitted.gaussians), codecs.to(cuda).rounded(_moved(fitted.gaussians, cuda))
    for name in codecs.gaussians:
        torch.testing.assert_close(on_gpu[name].cpu(), on_cpu[name], rtol=1e-6, atol=1e-6, msg=name)
    head = codecs.to(cuda).rounded_head(_moved(fitted.head, cuda))
    for name, value in codecs.rounded_head(fitted.head).items():
        torch.testing.assert_close(head[name].cpu(), value, rtol=1e-6, atol=0, msg=name)


def _moved(tensors, device):
    return {name: value.to(device) for name, value in tensors.items()}


def test_weights_that_show_less_are_coarser_at_the_same_total_error():
    g = torch.Generator().manual_seed(0)
    head = {name: torch.randn(8, 8, 3, 3, generator=g) for name in ("a.weight", "b.weight")}
    shown = {name: torch.rand(8, 8, generator=g, dtype=torch.float64) + 0.5 for name in head}
    shown["b.weight"] /= 64
    original = PackedScene(random_field(50), head)
    errors, sizes = [], []
    for sensitivity in (None, Sensitivity({}, shown)):
        _, codecs = fit_scene(replace(original, sensitivity=sensitivity), PackConfig(head_step=0.02))
        moved = {name: codecs.head.rounded(name, value) - value for name, value in head.items()}
        errors.append(sum(float((shown[name] * moved[name].square().sum((2, 3))).sum()) for name in head))
        levels = codecs.head.encode(head)[1]
        sizes.append(len(entropy.encode_levels(levels, entropy.predecessors(len(levels)))))
    assert errors[1] == pytest.approx(errors[0], rel=0.25)
    assert sizes[1] < 0.9 * sizes[0]
    share = [float(codecs.head.steps(name).mean()) for name in head]
    assert share[1] == pytest.approx(8 * share[0], rel=0.25)


@pytest.mark.parametrize("seen", [[], ["b.weight"]], ids=["nothing", "the last layer"])
def test_a_head_that_does_nothing_yet_is_packed(tmp_path, seen):
    """The last layer of a head starts at zero, so no feature and no other weight shows."""
    g = torch.Generator().manual_seed(0)
    head = {name: torch.randn(8, 8, 3, 3, generator=g) for name in ("a.weight", "b.weight")}
    shown = {name: torch.full((8, 8), float(name in seen), dtype=torch.float64) for name in head}
    gaussians = random_field(50)
    forms = {"features": torch.zeros(2 * gaussians["features"].shape[1:], dtype=torch.float64)}
    scene = PackedScene(gaussians, head, sensitivity=Sensitivity(forms, shown))
    write_scene(tmp_path / "a.sundae", scene, PackConfig(head_step=0.02))
    found = read_scene(tmp_path / "a.sundae")
    assert (found.gaussians["features"].std(dim=0) > 0).all()
    for name, value in head.items():
        most = value.flatten(1).abs().amax(dim=1)[:, None, None, None]
        assert ((found.head[name] - value).abs() <= 0.6 * most / 2).all()


def estimated_scene(n=2000):
    field, g = random_field(n), torch.Generator().manual_seed(1)
    field["scales"], field["features"][:, :3] = field["means"] - 5, field["means"]  # near those of neighbours
    return PackedScene(field, {"a.weight": torch.randn(32, 32, 3, 3, generator=g), "a.bias": torch.zeros(32)})


@pytest.mark.parametrize("factor", [0.5, 1.0, 4.0])
def test_the_estimate_is_near_the_size(tmp_path, factor):
    options = {name: factor * getattr(PackConfig(), name) for name in ("scale_step", "harmonics_step", "feature_step")}
    fitted, codecs = fit_scene(estimated_scene(), replace(PackConfig(), **options))
    found = estimated_bits(codecs, fitted.gaussians, fitted.head)
    sections = write_fitted(tmp_path / "a.sundae", fitted, codecs).sections
    assert set(found) == {*codecs.gaussians, "head"}
    for name, bits in found.items():
        assert 0.985 < float(bits) / (8 * sections[f"{name}/levels"]) < 1.15, name


def test_steps_against_the_gradient_make_a_smaller_file(tmp_path):
    fitted, codecs = fit_scene(estimated_scene(), PackConfig())
    before = write_fitted(tmp_path / "a.sundae", fitted, codecs)
    leaves = {name: fitted.gaussians[name].clone().requires_grad_() for name in codecs.gaussians}
    optimizer = torch.optim.Adam(leaves.values(), lr=0.003)
    for _ in range(30):
        optimizer.zero_grad()
        torch.stack(list(estimated_bits(codecs, leaves, {}).values())).sum().backward()
        optimizer.step()
    moved = {name: leaves.get(name, value).detach() for name, value in fitted.gaussians.items()}
    after = write_fitted(tmp_path / "b.sundae", replace(fitted, gaussians=moved), codecs)
    for name in ("features_rest", "features", "scales"):
        assert after.sections[f"{name}/levels"] < 0.999 * before.sections[f"{name}/levels"], name


def test_one_primitive_and_no_head():
    fitted, codecs = fit_scene(PackedScene(random_field(1)))
    assert all(torch.isfinite(bits) for bits in estimated_bits(codecs, fitted.gaussians, {}).values())
