"""Prunes of scenes: the refit of a pruned field, the count for a loss, and memory."""

import math
from unittest.mock import Mock

import pytest
import torch
from fields import random_field
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

import sundae_ns as sn
from sundae_ns.core import covariance
from sundae_ns.core.gaussians import Gaussians, sh_to_rgb
from sundae_ns.pruning import merge
from sundae_ns.pruning.decision import prune_gaussians
from sundae_ns.scene import prune_scene as module
from sundae_ns.scene.prune_scene import count_for_drop, refit

N = 1500


def scene(encoding="harmonics"):
    """A ball with stripes."""
    points = torch.nn.functional.normalize(torch.randn(N, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    made = sn.Scene.from_points(points, 0.5 + 0.4 * (6 * points).sin())
    made.gaussians["opacities"][:], made.gaussians["scales"][:] = 2.0, math.log(0.05)
    if encoding == "harmonics":
        return made
    colors = sh_to_rgb(made.gaussians["features_dc"]).logit()
    return sn.Scene(Gaussians({**made.gaussians, "features_dc": colors}, encoding))


def pruned(full):
    weights = torch.ones(N, device=full.device)
    return prune_gaussians(full.gaussians, sn.PruneRule(selection="pairs"), 150, weights).gaussians


@pytest.mark.parametrize("encoding", ["harmonics", "logits"])
def test_a_refit_matches_views_that_it_was_not_given(encoding, monkeypatch):
    full = scene(encoding)
    small, cameras = pruned(full), sn.virtual_cameras(full, 32, size=32)
    values = {name: value.clone() for name, value in small.items()}
    found = refit(small, full.gaussians, cameras, full.settings())
    assert all(torch.equal(small[name], value) for name, value in values.items())
    assert found.encoding == encoding
    assert found.num_gaussians == 150
    assert not any(value.requires_grad for value in found.values())
    held_out = sn.virtual_cameras(full, 8, seed=1, size=32)
    before, after = (sn.measure(sn.Scene(gaussians), full, held_out).psnr for gaussians in (small, found))
    assert after > before + 1
    monkeypatch.setitem(module.REFIT, "cpu", (2, 1, 0.7))
    one, again = (refit(small, full.gaussians, cameras[:8], full.settings()) for _ in range(2))
    assert all(torch.equal(one[name], again[name]) for name in one)


@pytest.mark.usefixtures("short_prunes")
def test_a_field_that_matches_already_is_unchanged():
    full = scene()
    cameras = sn.virtual_cameras(full, 4, size=24)
    assert refit(full.gaussians, full.gaussians, cameras, full.settings()) is full.gaussians


def test_a_refit_that_diverges_is_dropped():
    full = scene()
    small, cameras = pruned(full), sn.virtual_cameras(full, 16, size=24)
    images = module._blended(full.gaussians, cameras, full.settings())
    assert refit(small, full.gaussians, cameras, full.settings(), images=images) is not small
    for i in torch.randperm(16, generator=torch.Generator().manual_seed(0))[8:].tolist():  # others judge
        images[i].fill_(math.nan)
    assert refit(small, full.gaussians, cameras, full.settings(), images=images) is small


@pytest.mark.usefixtures("short_prunes")
def test_large_views_are_rendered_small(monkeypatch):
    full, spy = scene(), Mock(side_effect=module._blended)
    monkeypatch.setattr(module, "REFIT_PIXELS", 24 * 24)
    monkeypatch.setattr(module, "_blended", spy)
    cameras = [*sn.virtual_cameras(full, 2, size=96), *sn.virtual_cameras(full, 1, size=12)]
    refit(pruned(full), full.gaussians, cameras, full.settings())
    rendered = [camera for call in spy.call_args_list for camera in call.args[1]]
    assert {(camera.width, camera.height) for camera in rendered} == {(24, 24), (12, 12)}


def test_images_are_those_of_the_renderer():
    full = scene()
    cameras = [*sn.virtual_cameras(full, 2, size=24), *sn.virtual_cameras(full, 1, size=12)]
    for camera, image in zip(cameras, module._blended(full.gaussians, cameras, full.settings()), strict=True):
        truth = sn.render(full, camera)
        torch.testing.assert_close(image[..., 3:], truth.accumulation)
        torch.testing.assert_close(image[..., :3] + (1 - image[..., 3:]) * full.background, truth.rgb)


@pytest.mark.gpu
@pytest.mark.parametrize("encoding", ["harmonics", "logits"])
def test_a_gpu_takes_the_views_of_a_step_together(encoding):
    full = scene(encoding).to("cuda")
    full.gaussians["scales"][:, 0] += 0.7  # rotations of balls have no gradient but noise
    settings, cameras = full.settings(), [camera.to("cuda") for camera in sn.virtual_cameras(full, 40, size=48)]
    names = ("means", "scales", "quats", "opacities", "features_dc")
    values = {name: full.gaussians[name].clone().requires_grad_() for name in names}
    gaussians, weights = full.gaussians.replaced(values), torch.rand(4, 48, 48, 4, device="cuda")
    together = module._blended(gaussians, cameras[:4], settings)
    apart = [module._blended(gaussians, [camera], settings)[0] for camera in cameras[:4]]
    losses = [(torch.stack(images) * weights).sum() for images in (together, apart)]
    gradients = [torch.autograd.grad(loss, list(values.values())) for loss in losses]
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-3 * float(other.abs().max()))
    small = pruned(full)
    found = refit(small, full.gaussians, cameras, settings)
    before, after = (sn.measure(sn.Scene(one), full, cameras[:8]).psnr for one in (small, found))
    assert after > before + 1


def test_prune_refits_after_merges_by_pairs_alone(monkeypatch):
    full, called = scene(), []
    monkeypatch.setattr("sundae_ns.scene.prune_scene.refit", lambda small, *_, **__: called.append(small) or small)
    cameras = sn.virtual_cameras(full, 2, size=24)
    for rule in (sn.PruneRule(selection="systematic"), sn.PruneRule(redistribution="none"), None):
        assert not called
        sn.prune(full, keep=0.1, cameras=cameras, rule=rule)
    assert [small.num_gaussians for small in called] == [150]


@pytest.mark.usefixtures("short_prunes")
@pytest.mark.parametrize("drop", [1.0, 6.0])
def test_the_count_meets_the_tolerated_loss(drop):
    points = torch.nn.functional.normalize(torch.randn(1000, 3), dim=1)
    ball = sn.Scene.from_points(points, (points + 1) / 2)
    ball.gaussians["opacities"][:] = 3.0
    turns = torch.arange(16) * 0.4
    eyes = torch.stack([2.5 * turns.cos(), 2.5 * turns.sin(), 0.1 * turns], dim=1)
    cameras = [sn.Camera.look_at(eye, (0, 0, 0), width=36, height=36) for eye in eyes]
    kept, curve = count_for_drop(ball, drop, cameras, sn.PruneRule())
    counts = [count for count, _ in curve]
    assert counts == [1000 // 2 ** (i + 1) for i in range(len(counts))]
    assert counts[-1] <= kept <= 2 * counts[-1] + 1
    shown = [camera for i, camera in enumerate(cameras) if i % 8]
    small = sn.prune(ball, count=kept, cameras=shown, rule=sn.PruneRule())
    error = 10 ** (-sn.measure(small, ball, cameras[::8]).psnr / 10)
    tolerated = 1e-3 * (10 ** (drop / 10) - 1)
    assert tolerated / 2 < error < 2 * tolerated


class Doubles(TorchDispatchMode):
    """Collects the numbers of elements of the float64 tensors that are made."""

    def __init__(self):
        super().__init__()
        self.sizes = []

    def __torch_dispatch__(self, function, types, arguments=(), options=None):
        made = function(*arguments, **(options or {}))
        for value in tree_leaves(made):
            if isinstance(value, torch.Tensor) and value.dtype == torch.float64:
                self.sizes.append(value.numel())
        return made


def test_values_between_are_computed_in_parts(monkeypatch):
    """Of twenty million Gaussians, each number of an edge in float64 takes 2.6 GB."""
    for part, name, size in ((covariance, "ROWS", 64), (merge, "ROWS", 64), (covariance, "PAIRS", 1024)):
        monkeypatch.setattr(part, name, size)
    weights = torch.rand(N, generator=torch.Generator().manual_seed(0))
    with Doubles() as found:
        prune_gaussians(random_field(N), sn.PruneRule(selection="systematic"), N // 10, weights)
    assert max(found.sizes) == 6 * N  # the covariances
    assert found.sizes.count(6 * N) < 5
