"""The training step: nerfstudio's two halves and the whole step, its inputs, and the views of its cameras."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from sundae_ns.core.camera import Camera
from sundae_ns.plugin.model import SundaeModel
from sundae_ns.train.step import StepInputs

Build = Callable[..., SundaeModel]
OPTIONS: tuple[dict[str, Any], ...] = ({}, {"head": {"mode": "off"}}, {"head": {"max_train_pixels": 20 * 24}})


@pytest.mark.parametrize("options", OPTIONS, ids=["head", "no-head", "window"])
def test_both_halves_are_the_whole_step(
    build: Build, perturb: Callable[..., SundaeModel], camera: Any, batch: Any, options: dict[str, Any]
) -> None:
    """To the bit, with its gradients."""
    model = perturb(build(background_color="black", **options)).train()
    found: list[tuple[dict[str, Tensor], list[Tensor]]] = []
    for whole in (False, True):
        if whole:
            inputs = model.step_inputs(camera(), batch())
            loss, _, result = model.training_step(inputs, model.render_settings(training=True))
            terms, images = result.losses, result.images
        else:
            outputs = model.get_outputs(camera())
            terms = model.get_loss_dict(outputs, batch())  # type: ignore[arg-type]
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


@pytest.mark.parametrize("mask", [None, torch.rand(4, 5, 1)], ids=["whole", "masked"])
@pytest.mark.parametrize("rates", [None, torch.rand(7)], ids=["no-rates", "rates"])
def test_inputs_of_a_recording_take_those_of_a_step(mask: Tensor | None, rates: Tensor | None) -> None:
    def made(shift: float) -> StepInputs:
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


def test_the_view_of_a_training_camera_is_made_once(
    build: Build, camera: Any, batch: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At each resolution; a camera that the datamanager does not know, or that is optimised, is read anew."""
    model = build(num_downscales=1, resolution_schedule=5).train()
    made: list[int] = []
    camera_of = SundaeModel.camera_of

    def counted(self: SundaeModel, seen: Any, downscale: int = 1) -> Camera:
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
    model.get_outputs(camera())
    model.get_outputs(camera())
    assert made == [2, 2, 1, 1, 1, 1]
    model.camera_optimizer.config = replace(model.camera_optimizer.config, mode="SO3xR3")
    monkeypatch.setattr(model.camera_optimizer, "apply_to_camera", lambda seen: seen.camera_to_worlds)
    model._cameras.clear()
    for _ in range(2):
        model.get_outputs(known)
    assert made == [2, 2, 1, 1, 1, 1, 1, 1]
