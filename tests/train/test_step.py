"""The training step: both halves and the whole, its inputs, and the terms of its loss."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from pytorch_msssim import SSIM
from torch import Tensor

from sundae_ns.core.camera import Camera
from sundae_ns.plugin.model import SundaeModel
from sundae_ns.train.step import StepInputs, StepLosses, image_losses, ssim_loss, training_step

OPTIONS = ({}, {"head": {"mode": "off"}}, {"head": {"max_train_pixels": 20 * 24}})


@pytest.mark.parametrize("options", OPTIONS, ids=["head", "no-head", "window"])
def test_both_halves_are_the_whole_step(build, perturb, camera, batch, options):
    """To the bit, with its gradients."""
    model = perturb(build(background_color="black", **options)).train()
    found = []
    for whole in (False, True):
        if whole:
            inputs = model.step_inputs(camera(), batch())
            settings = model.render_settings(training=True)
            loss, _, result = training_step(model.source, model.state, model.losses, inputs, settings)
            terms, images = result.losses, result.images
        else:
            outputs = model.get_outputs(camera())
            terms = model.get_loss_dict(outputs, batch())
            images = {name: outputs[name] for name in ("rgb", "base_rgb")}
            loss = sum(terms.values(), torch.zeros(()))
        values = [value for value in model.gauss_params.values() if value.numel() and value.requires_grad]
        grads = [grad for grad in torch.autograd.grad(loss, values, allow_unused=True) if grad is not None]
        found.append(({**terms, "rgb": images["rgb"], "base_rgb": images["base_rgb"]}, grads))
    (halves, of_halves), (step, of_step) = found
    assert halves.keys() == step.keys()
    assert all(torch.equal(value, step[name]) for name, value in halves.items())
    assert len(of_halves) == len(of_step) >= 5
    assert all(torch.equal(one, other) for one, other in zip(of_halves, of_step, strict=True))


@pytest.mark.parametrize(("mask", "rates"), [(None, None), (torch.rand(4, 5, 1), torch.rand(7))], ids=["bare", "full"])
def test_inputs_of_a_recording_take_those_of_a_step(mask, rates):
    def made(shift):
        camera = Camera(torch.eye(4) + shift, torch.eye(3) + shift, 5, 4, 30.0)
        target = torch.rand(5, 4, 3).transpose(0, 1) + shift  # not contiguous
        moved = [None if one is None else one + shift for one in (mask, rates)]
        return StepInputs(camera, target, moved[0], torch.rand(3) + shift, rates=moved[1])

    first, later = made(0.0), made(1.0)
    held = first.clone()
    places = [value.data_ptr() for value in held._tensors()]
    assert held.target.is_contiguous()
    for given in (first, later):
        given.copy_to(held)
        assert places == [value.data_ptr() for value in held._tensors()]
        assert all(torch.equal(one, other) for one, other in zip(held._tensors(), given._tensors(), strict=True))
    assert (held.mask is None, held.rates is None) == (mask is None, rates is None)
    assert not set(places) & {value.data_ptr() for value in first._tensors()}


def test_the_view_of_a_training_camera_is_made_once(build, camera, batch, monkeypatch):
    """At each resolution; a camera that the datamanager does not know, or that is optimised, is read anew."""
    model = build(num_downscales=1, resolution_schedule=5).train()
    made, camera_of = [], SundaeModel.camera_of

    def counted(self, seen, downscale=1):
        made.append(downscale)
        return camera_of(self, seen, downscale)

    monkeypatch.setattr(SundaeModel, "camera_of", counted)
    known, other = camera(), camera(shift=0.3)
    known.metadata, other.metadata = {"cam_idx": 0}, {"cam_idx": 1}
    for step in (0, 1, 5, 6):
        model.step = step
        cameras = [model.step_inputs(seen, batch()).camera for seen in (known, other)]
        assert cameras[0].width == model.get_outputs(known)["rgb"].shape[1] == (40 if step >= 5 else 20)
        assert not torch.equal(cameras[0].viewmat, cameras[1].viewmat)
    assert made == [2, 2, 1, 1]
    monkeypatch.setattr(model.camera_optimizer, "apply_to_camera", lambda seen: seen.camera_to_worlds)
    for seen, mode in ((camera(), "off"), (known, "SO3xR3")):
        model.camera_optimizer.config = replace(model.camera_optimizer.config, mode=mode)
        model._cameras.clear()
        model.get_outputs(seen)
        model.get_outputs(seen)
    assert made[4:] == [1] * 4


@pytest.mark.parametrize("mode", ["residual", "features"])
def test_head_and_field_learn_together(build, perturb, camera, batch, mode):
    model = perturb(build(head={"mode": mode})).train()
    losses = model.get_loss_dict(model.get_outputs(camera()), batch())
    assert set(losses) == {"main_loss", "base_loss"}
    assert all(isinstance(value, Tensor) for value in losses.values())
    torch.stack(list(losses.values())).sum().backward()
    for name, value in (*model.gauss_params.items(), *model.head.named_parameters()):
        assert value.grad is not None, name
        assert torch.isfinite(value.grad).all(), name
        assert value.grad.any(), name


def test_masked_pixels_do_not_count(build, perturb, camera, batch):
    model = perturb(build(ssim_lambda=0.0)).eval()
    outputs, target = model.get_outputs(camera()), batch()
    mask = torch.zeros(32, 40, 1, dtype=torch.bool)
    mask[:, :20] = True
    losses = model.get_loss_dict(outputs, {**target, "mask": mask})
    target["image"][:, 20:] = 0
    for name, value in model.get_loss_dict(outputs, {**target, "mask": mask}).items():
        assert torch.equal(value, losses[name])
    truth = target["image"].float() / 255
    torch.testing.assert_close(losses["main_loss"], (outputs["rgb"] - truth).abs()[:, :20].sum() / truth.numel())


@pytest.mark.parametrize("term", ["rms", "l1"])
def test_after_the_prune_the_root_of_the_mean_square_takes_the_place_of_l1(build, perturb, camera, batch, term):
    model = perturb(build(loss_after_prune=term)).eval()
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


def test_a_pruned_field_has_a_prior_that_counts_once(build, perturb, camera, batch):
    """Twice as many training images halve its weight in the loss of one, and so does a second shard."""
    model = perturb(build(prior_after_prune=0.6)).eval()
    outputs, target = model.get_outputs(camera()), batch()
    assert "opacity_loss" not in model.get_loss_dict(outputs, target)
    model.state.pruning["num_prunes"] = 1
    for count in (1, 2, 4):
        model.losses = StepLosses(model.config, model.ssim, count)
        found = model.get_loss_dict(outputs, target)
        opacities, scales = model.gauss_params["opacities"].sigmoid(), model.gauss_params["scales"].exp()
        torch.testing.assert_close(found["opacity_loss"], 0.6 / count * opacities.mean())
        torch.testing.assert_close(found["scale_loss"], 0.6 / count * scales.mean())
    model.source = SimpleNamespace(gaussians=model.state.gaussians, total=2 * model.num_points)
    shard = model.get_loss_dict(outputs, target)
    assert all(torch.equal(2 * shard[name], found[name]) for name in ("opacity_loss", "scale_loss"))
    model.losses = StepLosses(build(prior_after_prune=0.0).config, model.ssim, 1)
    assert set(model.get_loss_dict(outputs, target)) == {"main_loss", "base_loss"}


def test_images_smaller_than_the_window_of_ssim(build, camera, batch):
    model = build().eval()
    outputs = model.get_outputs(camera(9, 8))
    loss = model.get_loss_dict(outputs, batch(9, 8))["main_loss"]
    torch.testing.assert_close(loss, (outputs["rgb"] - batch(9, 8)["image"].float() / 255).abs().mean())


SIZES = [(11, 11), (11, 40), (40, 12), (37, 53), (64, 96)]


def ssim():
    return SSIM(data_range=1.0, channel=3)


def images(height, width):
    """An image, its base colours and the target."""
    generator = torch.Generator().manual_seed(height * width)
    target = torch.rand(height, width, 3, generator=generator)
    image, base = (target + 0.05 * torch.randn(target.shape, generator=generator) for _ in range(2))
    return image.requires_grad_(), base.requires_grad_(), target


@pytest.mark.parametrize(("height", "width"), SIZES)
@pytest.mark.parametrize("weight", [0.2, 1.0])
def test_losses_of_a_step_and_gradients_are_those_of_convolutions(height, width, weight):
    image, base, target = images(height, width)
    ours = image_losses(image, base, target, ssim(), weight)
    exact = image_losses(image.double(), base.double(), target.double(), ssim(), weight)
    for value, wanted in zip(ours, exact):
        torch.testing.assert_close(value.double(), wanted, rtol=1e-6, atol=1e-6)  # worst: 1.1e-7
    grads, wanted_grads = (torch.autograd.grad(1.5 * pair[0] + 0.3 * pair[1], (image, base)) for pair in (ours, exact))
    for grad, wanted in zip(grads, wanted_grads):
        assert (grad - wanted).norm() < 5e-6 * wanted.norm()  # worst: 6e-7
        assert (grad != 0).all()


def test_equal_images_have_no_loss_and_no_gradient():
    target = images(32, 24)[2]
    image = target.clone().requires_grad_()
    rms, _ = image_losses(image, None, target, ssim(), 0.2, squares=True)
    for loss, least in ((ssim_loss(image, target), 1e-7), (rms, 1e-4)):
        assert loss.item() == pytest.approx(0, abs=least)
        assert torch.autograd.grad(loss, image)[0].abs().max() < 1e-6


def test_nan_propagates():
    image, _, target = images(32, 24)
    with torch.no_grad():
        image[16, 12, 1] = torch.nan
    loss = ssim_loss(image, target)
    (gradient,) = torch.autograd.grad(loss, image)
    assert loss.isnan()
    assert gradient[16, 12, 1].isnan()
    assert gradient[0, 0].isfinite().all()


def test_images_of_any_layout():
    image, _, target = images(40, 23)
    planes = image.detach().permute(2, 0, 1).contiguous().requires_grad_()
    loss, expected = ssim_loss(planes.permute(1, 2, 0), target.repeat(1, 2, 1)[:, :23]), ssim_loss(image, target)
    assert torch.equal(loss, expected)
    (grad,), (expected_grad,) = torch.autograd.grad(loss, planes), torch.autograd.grad(expected, image)
    assert torch.equal(grad.permute(1, 2, 0), expected_grad)
