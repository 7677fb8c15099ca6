"""Error bounds of every attribute, and codecs that round to what a reader decodes, bit for bit, for any value."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from fields import random_field
from hard_values import KINDS, drifted, hard_values
from hypothesis import given
from hypothesis import strategies as st
from packed_scenes import full_scene

from sundae_ns.core.covariance import covariances
from sundae_ns.core.errors import PackError
from sundae_ns.io import coordinates
from sundae_ns.io.pack import codecs as module
from sundae_ns.io.pack import entropy
from sundae_ns.io.pack.codecs import HeadCodec, Sensitivity, estimated_bits
from sundae_ns.io.pack.config import PackConfig
from sundae_ns.io.pack.packed_scene import PackedScene, fit_scene, read_scene, write_fitted

hard = given(st.sampled_from(KINDS), st.integers(1, 700), st.integers(0, 2**16))
less_hard = given(st.sampled_from(KINDS[:5]), st.integers(1, 500), st.integers(0, 2**16))


def ulp(x):
    """Unit in the last place of float32: the rounding of the result and of a product before it."""
    return np.spacing(np.abs(x).astype(np.float32)).astype(np.float64)


@hard
def test_separate_inverts_interleave(kind, n, seed):
    cells = np.random.default_rng(seed).integers(0, 2**coordinates.MAX_BITS, (n, 3)).astype(np.uint64)
    codes = coordinates.interleave(cells)
    for axis in range(3):
        assert np.array_equal(coordinates.separate(codes, axis), cells[:, axis])
    assert sorted(coordinates.scene_order(hard_values(kind, n, 3, seed))[0]) == list(range(n))


def test_scene_order_keeps_neighbours_together_despite_a_far_primitive():
    means = np.random.default_rng(0).random((4096, 3)).astype(np.float32)
    means[7] = 1e6
    others = np.delete(means, 7, axis=0)
    ordered = [m[coordinates.scene_order(m)[0]] for m in (others, means)]
    steps = [np.median(np.linalg.norm(np.diff(m, axis=0), axis=1)) for m in (means, *ordered)]
    assert steps[1] < steps[0] / 5
    assert steps[2] < 1.5 * steps[1]
    assert coordinates.scene_order(others * [1000, 1, 1])[1] == 4095, "of a street too"


@hard
def test_positions(kind, n, seed):
    bits, size = 4 + seed % 13, 16 + seed % 200
    x = hard_values(kind, n, 3, seed)
    x = x[coordinates.scene_order(x)[0]]
    packed, order = module.quantize_positions(x, bits, size)
    assert sorted(order) == list(range(n))
    found = packed.positions(bits, size).astype(np.float64)
    half = (packed.high.astype(np.float64) - packed.low) / (2**bits - 1) / 2
    assert (np.abs(found - x[order]) <= half[np.arange(n) // size] * (1 + 1e-9) + ulp(x[order])).all()
    assert ((packed.codes[1:] >= packed.codes[:-1]) | (np.arange(1, n) % size == 0)).all()
    assert (packed.codes < np.uint64(1 << 3 * bits)).all()


def angles(a, b):
    a, b = (q / np.linalg.norm(q, axis=1, keepdims=True) for q in (a, b))
    near = np.minimum(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
    return 4 * np.arcsin(np.minimum(near / 2, 1))


def through_rotations(q, step):
    """Quaternions after a round trip, of axes turned for the smallest rotation."""
    turned, _ = module.aligned(q, np.zeros((len(q), 3), np.float32))
    _, levels, _ = module.Rotations(step).encode(turned)
    return module.quats_at(torch.from_numpy(levels), step).numpy()


def hard_quaternions(n, seed, length):
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(n, 4))
    q[rng.random(n) < 0.2] = rng.choice([-0.5, 0.5], size=4)  # corners, where all four are the largest
    q[rng.random(n) < 0.1] = [0, 0, -1, 0]
    return (q * length).astype(np.float32)


@given(st.integers(1, 300), st.integers(0, 2**16), st.sampled_from([1e-15, 1.0, 1e15]))
def test_aligned_ellipsoids_are_the_same(n, seed, length):
    q, scales = hard_quaternions(n, seed, length), hard_values("normal", n, 3, seed)
    turned, moved = module.aligned(q, scales)
    pairs = [[torch.from_numpy(each).double() for each in pair] for pair in ((turned, moved), (q, scales))]
    after, before = (covariances(logs.exp(), quats / quats.norm(dim=1, keepdim=True)) for quats, logs in pairs)
    torch.testing.assert_close(after, before, rtol=1e-4, atol=1e-5)
    assert (turned[:, 0] > 0.853).all()  # cos(62.8 degrees / 2)
    assert np.array_equal(np.sort(moved), np.sort(scales))


@given(st.integers(1, 500), st.integers(0, 2**16), st.sampled_from([1e-4, 0.008, 0.1, 1.0]))
def test_rotations(n, seed, step):
    q = hard_quaternions(n, seed, 1.0)
    turned, _ = module.aligned(q, np.zeros((n, 3), np.float32))
    found = through_rotations(q, step)
    assert np.array_equal(module.Rotations(step).rounded(torch.from_numpy(turned)).numpy(), found)
    assert np.allclose(np.linalg.norm(found, axis=1), 1, atol=1e-6)
    if step < 0.5:
        assert angles(turned.astype(np.float64), found.astype(np.float64)).max() <= module.rotation_bound(step) + 2e-6


def test_the_bound_of_rotations_is_nearly_reached():
    q = np.random.default_rng(0).normal(size=(100_000, 4)).astype(np.float32)
    turned, _ = module.aligned(q, np.zeros((len(q), 3), np.float32))
    worst = angles(turned.astype(np.float64), through_rotations(q, 0.01).astype(np.float64)).max()
    assert 0.85 * module.rotation_bound(0.01) < worst <= module.rotation_bound(0.01)
    assert (module._normalized(torch.from_numpy(q).double())[:, 0] >= 0).all(), "w is not stored"
    # A quaternion of length zero is the identity.
    assert np.array_equal(through_rotations(np.zeros((2, 4), np.float32), 0.01), [[1, 0, 0, 0]] * 2)


@hard
def test_weights(kind, n, seed):
    x = hard_values(kind, n, 18, seed).reshape(n, 2, 3, 3)
    steps = module.weight_steps(torch.from_numpy(x), 1 / 127)[:, None]
    found = module.weights_at(module.weight_levels(torch.from_numpy(x), steps), steps).double().numpy()
    error, step = np.abs(found - x).reshape(n, -1), steps.numpy()[:, 0]
    assert (error <= step[:, None] / 2 * (1 + 1e-6) + ulp(x.reshape(n, -1))).all()
    assert (step <= np.abs(x.reshape(n, -1)).max(axis=1) / 127 * (1 + 1e-6) + 1e-44).all()


@hard
def test_transform(kind, n, seed):
    x = hard_values(kind, n, 9, seed)
    codec = module.fit_transform(x, 0.03)
    for values in (drifted(x, seed), x):  # rounding is what a reader decodes, bit for bit
        _, levels, arrays = codec.encode(values)
        mean, basis = (torch.from_numpy(arrays[name]) for name in ("mean", "basis"))
        found = module.rows_at(torch.from_numpy(levels), mean, basis.reshape(9, 9), codec.step).double().numpy()
        assert np.array_equal(codec.rounded(torch.from_numpy(values)).numpy(), found)
        assert np.abs(levels).max() <= entropy.LARGEST
    # Sums of nine products in float32.
    slack = 20 * ulp(np.linalg.norm(x.astype(np.float64), axis=1, keepdims=True))
    assert (np.abs(found - x) <= codec.bound + slack).all()
    assert codec.bound < codec.step / 2 * 3.2
    if np.abs(x).max() < 1000:
        assert codec.step == 0.03


def test_one_that_is_far_away_leaves_all_others_in_their_place():
    field = random_field(3000, degree=0)
    far = {**field, "means": field["means"].index_fill(0, torch.tensor([1500]), 1e6)}
    found = module.fit_codecs(far, {}, PackConfig(), Sensitivity({}, {}))[0]["means"]
    assert (torch.cdist(field["means"], found).amin(dim=1) > 0.01).sum() < 16


def test_narrow_gaussians_take_finer_cells_before_smaller_blocks():
    field = {**random_field(3000, degree=0), "scales": torch.full((3000, 3), -8.0)}
    config = module.fit_codecs(field, {}, PackConfig(position_bits=10), Sensitivity({}, {}))[1].config
    assert min(config.position_bits - 10, config.block - 512) > 0
    field["scales"] = torch.full((3000, 3), -3.0).index_fill(0, torch.arange(100), -30.0)
    assert module.fit_codecs(field, {}, PackConfig(), Sensitivity({}, {}))[1].config == PackConfig()


@pytest.mark.parametrize("kind", ["normal", "outliers"])
def test_a_transform_decorrelates_columns(kind):
    rng = np.random.default_rng(0)
    x = np.repeat(hard_values(kind, 2000, 3, 0), 3, axis=1) + rng.normal(0, 0.001, (2000, 9)).astype(np.float32)
    _, levels, _ = module.fit_transform(x, 0.03, centred=False).encode(x)
    zeros = (levels == 0).mean(axis=0)
    assert (zeros[3:] > 0.98).all()
    assert (zeros[:3] < 0.2).all()


def test_rows_of_zeros_stay_exact():
    x = hard_values("normal", 200, 9, 0) + 1
    x[::2] = 0
    assert not module.fit_transform(x, 0.03, centred=False).rounded(torch.from_numpy(x))[::2].any()


def test_a_form_makes_errors_that_show_smaller():
    """At as many bits: less than half of the errors by the form, and larger errors in its least direction."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(4000, 6)).astype(np.float32)
    axes = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    form = axes * np.array([1, 1, 1, 0.1, 0.1, 0.02]) @ axes.T
    plain, weighted = module.fit_transform(x, 0.1), module.fit_transform(x, 0.1, form=torch.from_numpy(form))
    errors = [codec.rounded(torch.from_numpy(x)).double().numpy() - x for codec in (plain, weighted)]
    seen = [np.einsum("ni,ij,nj->n", error, form, error).mean() for error in errors]
    bits = [np.log2(1 + np.abs(codec.encode(x)[1])).mean() for codec in (plain, weighted)]
    assert bits[1] < bits[0]
    assert 0.5 < seen[1] / (0.1**2 / 12 * np.trace(form)) < 1.3
    assert np.abs(errors[1] @ axes[:, 5]).mean() > 1.5 * np.abs(errors[0] @ axes[:, 5]).mean()
    identity = module.fit_transform(x, 0.1, form=torch.eye(6, dtype=torch.float64) * 7)
    assert np.abs(identity.rounded(torch.from_numpy(x)).numpy() - x).max() < identity.bound * (1 + 1e-5)


@less_hard
def test_weights_are_those_that_a_reader_decodes(kind, n, seed):
    x, share = hard_values(kind, n, 18, seed).reshape(n, 2, 3, 3), 2.0 ** -(seed % 9)
    codec = HeadCodec({"w": module.weight_steps(torch.from_numpy(x), share)}, {"w": torch.tensor([1.0, 2.0**0.25])})
    for y in (x, drifted(x, seed)):
        _, levels, arrays = codec.encode({"w": torch.from_numpy(y)})
        steps = torch.from_numpy(arrays["steps"])[:, None] * torch.from_numpy(arrays["columns"])
        found = module.weights_at(torch.from_numpy(levels.reshape(x.shape)), steps)
        assert torch.equal(codec.rounded("w", torch.from_numpy(y)), found)


COARSE = {"scale_step": 0.5, "rotation_step": 0.1, "feature_step": 0.5, "head_step": 0.14, "harmonics_step": 0.1}
CONFIGS = [{"block": 100}, {**COARSE, "position_bits": 10}, {"head_step": 0.01, "feature_step": 0.001}]


@pytest.mark.parametrize("config", CONFIGS)
def test_a_file_holds_the_values_rounded_in_training(tmp_path, config):
    shown = {"a.weight": torch.logspace(0, 3, 12, dtype=torch.float64).reshape(4, 3)}
    fitted, codecs = fit_scene(replace(full_scene(), sensitivity=Sensitivity({}, shown)), PackConfig(**config))
    assert len(codecs.head.columns["a.weight"].unique()) == 3
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
    moved = {k: torch.from_numpy(drifted(v.flatten(1).numpy(), 0)).view_as(v) for k, v in fitted.gaussians.items()}
    moved = replace(fitted, gaussians=moved)
    wanted = replace(present, scale_step=0.2, rotation_step=0.002, head_step=0.8, position_bits=16, block=1024)
    other = codecs.with_steps(wanted, moved.gaussians, moved.head)
    assert other.blocks is codecs.blocks
    assert other.config == replace(wanted, position_bits=11, block=100)
    for name, codec in codecs.gaussians.items():
        factor = {"scales": 0.2 / 0.05, "quats": 0.002 / 0.008}.get(name, 1.0)
        found = other.gaussians[name]
        assert found.step == pytest.approx(factor * codec.step), name
        if isinstance(codec, module.Transform):
            assert isinstance(found, module.Transform)
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
    codec = module.fit_transform(rows, 0.01)
    rows[7] = 1e5
    finer = codec.with_step(0.0001, rows)
    assert finer.step > 0.005
    assert np.abs(finer.rounded(torch.from_numpy(rows)).numpy() - rows).max() < 0.1


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
    errors, sizes = [], []
    for sensitivity in (Sensitivity({}, {}), Sensitivity({}, shown)):
        scene = PackedScene(random_field(50), head, sensitivity=sensitivity)
        codecs = fit_scene(scene, PackConfig(head_step=0.02))[1]
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
    write_fitted(tmp_path / "a.sundae", *fit_scene(scene, PackConfig(head_step=0.02)))
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
