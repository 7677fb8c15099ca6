"""What errors of a pack do to images: predicted changes are those of renderings."""

import dataclasses
import math

import pytest
import torch
from fields import random_field

import sundae_ns as sn
from sundae_ns.head.head import CompensationHead, HeadConfig
from sundae_ns.io.pack.packed_scene import PackedScene
from sundae_ns.scene.packing import scene_of, sensitivity_of
from sundae_ns.scene.render import GaussianSource, render_view


def head():
    torch.manual_seed(0)
    state = dict(CompensationHead(HeadConfig(size="tiny", num_features=5)).state_dict())
    state["net.out.weight"] = 0.1 * torch.randn_like(state["net.out.weight"])
    return state


def cameras(n, *, turn, ahead=0.0):
    """Cameras on a circle around the origin, or on a part of it, which look at its centre, or away from there."""
    eyes = [(6 * math.sin(i * turn / n), 0.0, 6 * math.cos(i * turn / n)) for i in range(n)]
    fov = 2 * math.degrees(math.atan(16 / 40))
    return [sn.Camera.look_at(eye, (0, ahead, 0), (0, 1, 0), fov=fov, width=48, height=32) for eye in eyes]


@pytest.fixture(scope="module")
def scene():
    kind = {"mode": "residual", "size": "tiny", "pixel_unshuffle": 2, "num_features": 5, "precision": "fp32"}
    stated = {"sh_degree": 2, "rasterize_mode": "classic", "background_color": "black", "head": kind}
    gaussians = random_field(300)
    gaussians["scales"] += 2
    return scene_of(PackedScene(gaussians, head(), None, {"model": {**stated, "trained_focal": [40.0, 40.0]}}))


@torch.no_grad()
def images(scene, cameras):
    source, settings = GaussianSource(scene.gaussians), dataclasses.replace(scene.settings(), training=True)
    views = [render_view(source, camera, scene.background, settings, depth=False)[0]["rgb"] for camera in cameras]
    return torch.stack(views).double()


def changed(scene, cameras, value, size=1e-3, tries=8):
    """Mean squared change of images by random changes of a parameter, for a change of length 1 of each number."""
    before, old = images(scene, cameras), value.detach().clone()
    total = 0.0
    for _ in range(tries):
        value.data = old + size * torch.randn_like(old)
        total += float((images(scene, cameras) - before).square().sum())
    value.data = old
    return total / tries / size**2


def test_predicted_changes_are_those_of_images(scene):
    torch.manual_seed(1)
    seen = cameras(8, turn=6.28)
    found = sensitivity_of(scene, seen)
    measured = changed(scene, seen, scene.gaussians["features"])
    assert float(found.rows["features"].trace()) == pytest.approx(measured, rel=0.35)
    assert scene.head is not None
    weights = dict(scene.head.named_parameters())
    for name in ("net.encoder.0.2.weight", "net.encoder.3.0.weight", "net.out.weight"):
        predicted = float(found.head[name].sum()) * weights[name][0, 0].numel()
        assert predicted == pytest.approx(changed(scene, seen, weights[name]), rel=0.35), name
    again = sensitivity_of(scene, seen)
    assert all(torch.equal(found.rows[name], again.rows[name]) for name in found.rows)
    assert all(torch.equal(found.head[name], again.head[name]) for name in found.head)


def test_cameras_of_one_side_tell_fewer_harmonics_apart_and_those_that_see_none_give_a_form(scene):
    forms = [sensitivity_of(scene, cameras(24, turn=turn)).rows["features_rest"] for turn in (6.28, 0.1)]
    assert all(form.shape == (24, 24) for form in forms)
    values = [torch.linalg.eigvalsh(form) for form in forms]
    assert all(float(part[0]) > 0 for part in values)
    around, aside = ((part / part.sum()).clamp_min(1e-12).log().mean() for part in values)
    assert around > aside + 1
    form = sensitivity_of(scene, cameras(2, turn=0.1, ahead=1000.0)).rows["features_rest"]
    assert torch.isfinite(form).all()
    assert float(torch.linalg.eigvalsh(form)[0]) > 0
