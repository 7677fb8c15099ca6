"""Metrics of the model's pictures, and that LPIPS costs nothing until it is asked for."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any

import pytest
import torch
import torchmetrics.image
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from sundae_ns.core.camera import crop_image
from sundae_ns.core.metrics import psnr
from sundae_ns.plugin.model import SundaeModel

Build = Callable[..., SundaeModel]
Perturb = Callable[[SundaeModel], SundaeModel]
MakeCamera = Callable[..., Cameras]
MakeBatch = Callable[..., dict[str, Tensor]]


def test_metrics_with_and_without_the_head(
    build: Build, perturb: Perturb, camera: MakeCamera, batch: MakeBatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = perturb(build()).eval()
    monkeypatch.setattr(model.lpips, "_failed", True)
    with torch.no_grad():
        outputs = model.get_outputs_for_camera(camera())
    metrics, images = model.get_image_metrics_and_images(outputs, batch())
    assert set(metrics) == {"gaussian_count"} | {a + b for a in ("psnr", "psnr_fitted", "ssim") for b in ("", "_base")}
    assert all(type(value) is float for value in metrics.values())
    truth = batch()["image"].float() / 255
    for suffix, name in (("", "rgb"), ("_base", "base_rgb")):
        mse = ((outputs[name] - truth) ** 2).mean()
        assert metrics["psnr" + suffix] == pytest.approx(float(-10 * mse.log10()), abs=1e-4)
    assert metrics["psnr"] != metrics["psnr_base"]
    assert metrics["psnr_fitted"] > metrics["psnr"]
    assert images["img"].shape == (32, 80, 3)
    # A picture with alpha is composited over the background that it was rendered with.
    assert torch.isfinite(torch.tensor(model.get_image_metrics_and_images(outputs, batch(channels=4))[0]["psnr"]))


def test_metrics_of_a_step_cost_nothing_until_they_are_looked_at(
    build: Build, perturb: Perturb, camera: MakeCamera, batch: MakeBatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = perturb(build()).train()
    outputs, asked = model.get_outputs(camera()), []
    monkeypatch.setattr("sundae_ns.plugin.model.psnr", lambda *pictures: asked.append(pictures) or psnr(*pictures))
    metrics = model.get_metrics_dict(outputs, batch())
    assert set(metrics) == {"psnr", "psnr_base", "gaussian_count"}
    assert not asked
    rgb, graph = outputs["rgb"].detach().clamp(0, 1), weakref.ref(outputs["rgb"])
    truth = crop_image(batch()["image"].float() / 255, outputs["window"])  # as mirrored as the picture
    del outputs  # what the picture was made from goes with it
    assert graph() is None
    mse = ((rgb - truth) ** 2).mean()
    assert float(metrics["psnr"]) == pytest.approx(float(-10 * mse.log10()), abs=1e-4)
    assert metrics["psnr"] != metrics["psnr_base"]
    assert len(asked) == 2


@pytest.mark.parametrize("training", [True, False])
def test_late_metrics_are_of_the_step_they_were_asked_in(
    build: Build, perturb: Perturb, camera: MakeCamera, batch: MakeBatch, training: bool
) -> None:
    options = {"num_downscales": 2, "resolution_schedule": 3000, "background_color": "black"}
    model = perturb(build(**options)).train(training)

    def asked() -> Any:
        with torch.no_grad():
            return model.get_metrics_dict(model.get_outputs(camera()), batch())

    at_once, later = asked(), asked()
    expected = [float(at_once[name]) for name in ("psnr", "psnr_base")]
    model.train(not training)  # a viewer's thread, or an evaluation, in between
    model.step = 9000
    assert [float(later[name]) for name in ("psnr", "psnr_base")] == expected


def test_lpips_is_not_built_and_not_saved(build: Build, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("LPIPS was built")

    monkeypatch.setattr(torchmetrics.image.LearnedPerceptualImagePatchSimilarity, "__init__", refuse)
    model = build()
    assert not [name for name in model.state_dict() if "lpips" in name]
    assert not [name for name, _ in model.named_modules() if "lpips" in name]
    # The field, the head and nerfstudio's empty marker of the device; nothing else costs bytes.
    known = ("gauss_params.", "networks.head.", "device_indicator_param", "_extra_state", "ssim.", "camera_optimizer.")
    assert not [name for name in model.state_dict() if not name.startswith(known)]
