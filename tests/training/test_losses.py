"""Terms of the loss, and what learns by them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from sundae_ns.model import SundaeModel

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


def test_before_the_head_starts_there_is_one_loss(build: Build, training_of: TrainingOf) -> None:
    assert set(training_of(build()).step(0)) == {"main_loss"}
    assert set(training_of(build(base_loss_weight=0.0)).step(10)) == {"main_loss"}


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


def test_images_smaller_than_the_window_of_ssim(build: Build, camera: MakeCamera, batch: MakeBatch) -> None:
    model = build().eval()
    outputs = model.get_outputs(camera(9, 8))
    loss = model.get_loss_dict(outputs, batch(9, 8))["main_loss"]
    truth = batch(9, 8)["image"].float() / 255
    torch.testing.assert_close(loss, (outputs["rgb"] - truth).abs().mean())
