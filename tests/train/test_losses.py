"""Terms of the loss, and what learns by them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from sundae_ns.plugin.model import SundaeModel
from sundae_ns.train.step import StepLosses, image_losses

Build = Callable[..., SundaeModel]
Perturb = Callable[[SundaeModel], SundaeModel]
MakeCamera = Callable[..., Cameras]
MakeBatch = Callable[..., dict[str, Tensor]]
TrainingOf = Callable[[SundaeModel], Any]


@pytest.mark.parametrize("mode", ["residual", "features"])
def test_head_and_field_learn_together(
    build: Build, perturb: Perturb, camera: MakeCamera, batch: MakeBatch, mode: str
) -> None:
    model = perturb(build(head={"mode": mode}))
    model.train()
    outputs = model.get_outputs(camera())
    losses = model.get_loss_dict(outputs, batch())
    assert set(losses) == {"main_loss", "base_loss"}
    assert all(isinstance(value, Tensor) for value in losses.values())
    torch.stack(list(losses.values())).sum().backward()
    for name, value in (*model.gauss_params.items(), *model.head.named_parameters()):  # type: ignore[union-attr]
        assert value.grad is not None, name
        assert torch.isfinite(value.grad).all(), name
        assert value.grad.any(), name


def test_masked_pixels_do_not_count(build: Build, perturb: Perturb, camera: MakeCamera, batch: MakeBatch) -> None:
    model = perturb(build(ssim_lambda=0.0))
    model.eval()
    outputs, target = model.get_outputs(camera()), batch()
    mask = torch.zeros(32, 40, 1, dtype=torch.bool)
    mask[:, :20] = True
    losses = model.get_loss_dict(outputs, {**target, "mask": mask})
    target["image"][:, 20:] = 0
    for name, value in model.get_loss_dict(outputs, {**target, "mask": mask}).items():
        assert torch.equal(value, losses[name])
    truth = target["image"].float() / 255
    expected = (outputs["rgb"] - truth).abs()[:, :20].sum() / truth.numel()
    torch.testing.assert_close(losses["main_loss"], expected)


@pytest.mark.parametrize("term", ["rms", "l1"])
def test_after_the_prune_the_root_of_the_mean_square_takes_the_place_of_l1(
    build: Build, perturb: Perturb, camera: MakeCamera, batch: MakeBatch, term: str
) -> None:
    model = perturb(build(loss_after_prune=term))
    model.eval()
    outputs, target = model.get_outputs(camera()), batch()
    error = outputs["rgb"] - target["image"].float() / 255
    l1, rms = error.abs().mean(), error.square().mean().sqrt()
    before = model.get_loss_dict(outputs, target)
    model.state.pruning["num_prunes"] = 1
    after = model.get_loss_dict(outputs, target)
    change = 0.8 * (rms - l1) if term == "rms" else torch.zeros(())
    torch.testing.assert_close(after["main_loss"] - before["main_loss"], change, atol=1e-5, rtol=0)
    assert change.abs() > 0.01 or term == "l1"
    assert torch.equal(after["base_loss"], before["base_loss"])
    model.state.densify_until = model.state.schedule_step + 1  # continuous pruning, while the field grows
    assert torch.equal(model.get_loss_dict(outputs, target)["main_loss"], before["main_loss"])


def test_a_pruned_field_has_a_prior_that_counts_once(
    build: Build, perturb: Perturb, camera: MakeCamera, batch: MakeBatch
) -> None:
    """Twice as many training images halve its weight in the loss of one."""
    model = perturb(build(prior_after_prune=0.6))
    model.eval()
    outputs, target = model.get_outputs(camera()), batch()
    assert "opacity_loss" not in model.get_loss_dict(outputs, target)
    model.state.pruning["num_prunes"] = 1
    for count in (1, 2, 4):
        model.losses = StepLosses(model.config, model.ssim, count)
        found = model.get_loss_dict(outputs, target)
        opacities, scales = model.gauss_params["opacities"].sigmoid(), model.gauss_params["scales"].exp()
        torch.testing.assert_close(found["opacity_loss"], 0.6 / count * opacities.mean())
        torch.testing.assert_close(found["scale_loss"], 0.6 / count * scales.mean())
    model.losses = StepLosses(build(prior_after_prune=0.0).config, model.ssim, 1)
    assert set(model.get_loss_dict(outputs, target)) == {"main_loss", "base_loss"}


def test_equal_images_have_a_gradient_of_zero(build: Build) -> None:
    image = torch.full((20, 20, 3), 0.5, requires_grad=True)
    loss, _ = image_losses(image, None, image.detach(), build().ssim, 0.2, squares=True)
    assert loss < 1e-3
    assert torch.autograd.grad(loss, image)[0].abs().max() < 1e-6


def test_images_smaller_than_the_window_of_ssim(build: Build, camera: MakeCamera, batch: MakeBatch) -> None:
    model = build().eval()
    outputs = model.get_outputs(camera(9, 8))
    loss = model.get_loss_dict(outputs, batch(9, 8))["main_loss"]
    truth = batch(9, 8)["image"].float() / 255
    torch.testing.assert_close(loss, (outputs["rgb"] - truth).abs().mean())
