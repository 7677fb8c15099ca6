"""Distillation of a scene into a smaller one."""

import pytest
import torch

import sundae_ns as sn
from sundae_ns.core.errors import CheckpointError
from sundae_ns.plugin.distill import Distillation


@pytest.fixture(scope="module")
def ball():
    """Points on a sphere, coloured in patches."""
    points = torch.nn.functional.normalize(torch.randn(1500, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    scene = sn.Scene.from_points(points, (points * 4).sin() / 2 + 0.5)
    scene.gaussians["opacities"][:] = 3.0
    return scene


@pytest.fixture(scope="module")
def cameras():
    turns = torch.arange(12) * 0.5
    eyes = torch.stack([2.5 * turns.cos(), 2.5 * turns.sin(), turns.sin()], dim=1)
    return [sn.Camera.look_at(eye, (0, 0, 0), width=40, height=40) for eye in eyes]


def test_it_is_better_than_the_prune_alone(ball, cameras, monkeypatch):
    """A scene that the near plane would hide; other cameras than those of the steps judge."""
    monkeypatch.setattr("sundae_ns.plugin.distill.CAMERAS", 16)
    teacher = sn.transform(ball, scale=1e-3)
    made = sn.distill(teacher, keep=0.2, steps=100, head=False, size=40)
    pruned = sn.prune(teacher, keep=0.2, cameras=sn.virtual_cameras(teacher, 8, size=40))
    assert made.num_gaussians == pruned.num_gaussians == 300
    quality, base = (sn.measure(sn.transform(one, scale=1e3), ball, cameras).psnr for one in (made, pruned))
    assert quality > base + 2


def test_it_is_the_same_for_a_seed_and_for_every_default_dtype(ball, cameras):
    found = []
    for seed, dtype in ((0, torch.float32), (0, torch.float64), (1, torch.float32)):
        torch.set_default_dtype(dtype)
        ball.gaussians["means"].requires_grad_(dtype == torch.float64)
        made = Distillation(ball, keep=0.1, cameras=cameras, steps=5, seed=seed)
        made.train(lambda *_: True)
        torch.set_default_dtype(torch.float32)
        found.append(made.scene().gaussians["means"])
    assert torch.equal(found[0], found[1])
    assert not torch.equal(found[0], found[2])


@pytest.mark.parametrize("pays", [False, True])
def test_a_head_is_kept_where_it_pays_and_a_resumed_training_ends_alike(pays, ball, cameras, tmp_path, monkeypatch):
    for name in ("LEAST_GAIN", "GAIN_PER_DOUBLING"):
        monkeypatch.setattr(f"sundae_ns.train.choice.{name}", -1000.0 if pays else 1000.0)

    def begun(**other):
        return Distillation(**{"scene": ball, "keep": 0.1, "cameras": cameras, "steps": 20, **other})

    whole, first, second = begun(), begun(), begun()
    assert whole.train(lambda *_: True)
    assert whole.gain is not None
    result = whole.result()
    assert (result.head is not None, "features" in result.gaussians) == (pays, pays)
    if pays:
        assert result.trained_focal == (cameras[0].focal, cameras[0].focal)
        image = sn.render(result, cameras[0])
        assert not torch.equal(image.rgb, image.base_rgb)
    assert not first.train(lambda done, total: done < total - 1)
    assert first.step == 19
    first.save(tmp_path / "partial")
    second.load(tmp_path / "partial")
    assert second.train(lambda *_: True)
    for name, value in result.gaussians.items():
        assert torch.equal(value, second.result().gaussians[name]), name
    moved = sn.transform(ball, scale=1.1)
    for other in ({"keep": 0.2}, {"scene": moved}, {"cameras": cameras[::-1]}, {"head": False}):
        with pytest.raises(CheckpointError, match="of this scene and options .other cameras, options or .*; remove it"):
            begun(**other).load(tmp_path / "partial")
    (tmp_path / "partial").write_bytes(b"nothing")
    with pytest.raises(CheckpointError, match="partial is not a checkpoint"):
        begun().load(tmp_path / "partial")


@pytest.mark.parametrize(("name", "value"), [("steps", 0), ("keep", 2.0), ("seed", 1.5), ("size", 0), ("cameras", 0)])
def test_impossible_options_are_refused(name, value, ball, cameras):
    with pytest.raises(sn.SundaeError, match=f"{name} is {value}|'{value}' is no camera"):
        sn.distill(ball, **{"cameras": cameras, name: value})
