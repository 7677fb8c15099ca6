"""Pictures of the model: every output, with the head and without, crops, other scales, and a device without room."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.utils import colormaps
from torch import Tensor

from sundae_ns.core.camera import Crop, crop_image
from sundae_ns.core.errors import MemoryExhaustedError
from sundae_ns.core.gaussians import Gaussians
from sundae_ns.head.head import resize
from sundae_ns.method_configs import sundae
from sundae_ns.plugin.model import SundaeModel
from sundae_ns.scene.render import GaussianSource, render_view

Build = Callable[..., SundaeModel]
Perturb = Callable[[SundaeModel], SundaeModel]
MakeCamera = Callable[..., Cameras]
TrainingOf = Callable[[SundaeModel], Any]

N = 60
"""Gaussians of a model that is built without a count."""
VIEWER_KEYS = {"rgb": 3, "base_rgb": 3, "depth": 1, "accumulation": 1, "features": 3, "response": 1, "background": 3}


@pytest.mark.parametrize("size", [(30, 30), (31, 47), (97, 33)])
@pytest.mark.parametrize("mode", ["residual", "features", "off"])
@torch.no_grad()
def test_every_output_can_be_shown(
    build: Build, perturb: Perturb, camera: MakeCamera, mode: str, size: tuple[int, int]
) -> None:
    model = perturb(build(head={"mode": mode})).eval()
    outputs = model.get_outputs_for_camera(camera(*size))
    assert {name: value.shape for name, value in outputs.items()} == {
        name: (size[1], size[0], channels) for name, channels in VIEWER_KEYS.items()
    }
    for name, value in outputs.items():
        assert value.dtype == torch.float32, name
        assert torch.isfinite(value).all(), name
        shown = colormaps.apply_colormap(value, colormaps.ColormapOptions(normalize=name == "depth"))
        assert shown.shape == (size[1], size[0], 3)
    for name in ("rgb", "base_rgb", "accumulation", "features", "response"):
        assert ((outputs[name] >= 0) & (outputs[name] <= 1)).all(), name
    assert outputs["response"].max() > 0
    assert (outputs["features"].std() > 0) == (mode != "off")


@torch.no_grad()
def test_depth_is_splatted_when_it_is_looked_at(
    build: Build, perturb: Perturb, camera: MakeCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same depth as in one pass with the colours, of what was drawn: in a box, of what lies in the box."""
    model = perturb(build(head={"mode": "residual"})).eval()
    box = OrientedBox(torch.eye(3), torch.tensor([0.0, 0.0, 0.0]), torch.tensor([1.0, 1.0, 1.0]))
    cam, background = model.camera_of(camera()), model._get_background_color()
    rasterise, passes = model.backend.rasterize, []
    monkeypatch.setattr(model.backend, "rasterize", lambda inputs: passes.append(inputs) or rasterise(inputs))
    found = []
    for crop in (None, box):
        outputs = model.get_outputs_for_camera(camera(), crop)
        assert outputs["rgb"].shape[-1] == 3
        assert [p.render_depth for p in passes] == [False]
        inside = slice(None) if crop is None else crop.within(model.means).squeeze(-1)
        part = GaussianSource(Gaussians({k: v[inside] for k, v in model.state.gaussians.items()}))
        images, _ = render_view(part, cam, background, model.render_settings(training=False))
        seen = images["accumulation"] > 0
        passes.clear()
        found.append(outputs["depth"])
        assert [p.render_depth for p in passes] == [True]
        torch.testing.assert_close(found[-1][seen], images["depth"][seen])
        passes.clear()
    assert not torch.equal(*found)


@torch.no_grad()
def test_a_crop_without_primitives_has_the_same_keys(build: Build, perturb: Perturb, camera: MakeCamera) -> None:
    model = perturb(build()).eval()
    whole = model.get_outputs_for_camera(camera())
    far = OrientedBox.from_params((50.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    empty = model.get_outputs_for_camera(camera(), obb_box=far)
    assert list(empty) == list(whole)
    assert {name: value.shape for name, value in empty.items()} == {n: v.shape for n, v in whole.items()}
    assert torch.equal(empty["rgb"], empty["background"])
    assert not empty["accumulation"].any()
    half = OrientedBox.from_params((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), (2.0, 9.0, 9.0))
    cropped = model.get_outputs_for_camera(camera(), obb_box=half)
    assert 0 < cropped["accumulation"].sum() < whole["accumulation"].sum()
    assert torch.equal(model.get_outputs_for_camera(camera())["rgb"], whole["rgb"])


@torch.no_grad()
def test_without_the_head_the_picture_is_the_base_exactly(build: Build, perturb: Perturb, camera: MakeCamera) -> None:
    model = perturb(build()).eval()
    on = model.get_outputs_for_camera(camera())
    assert (on["rgb"] - on["base_rgb"]).abs().max() > 1e-3
    settings = model.render_settings(training=False).without_head()
    off, _ = render_view(model.source, model.camera_of(camera()), on["background"], settings)
    assert torch.equal(off["rgb"], off["base_rgb"])
    # With features in the same pass the sums are taken in another order.
    torch.testing.assert_close(off["base_rgb"], on["base_rgb"], atol=1e-6, rtol=0)
    model.step = 3
    before = model.get_outputs_for_camera(camera())
    assert torch.equal(before["rgb"], before["base_rgb"])


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@torch.no_grad()
def test_a_mirrored_window_shows_the_mirror_image(
    build: Build, perturb: Perturb, camera: MakeCamera, backend: str
) -> None:
    """Camera and truth agree: off-centre, without symmetry, at an odd width."""
    model = perturb(build(rasterizer=backend)).eval()
    model.step = 10
    cam = model.camera_of(camera(47, 31))
    cam.K[0, 2] += 2.5
    part = Crop(5, 3, 33, 20)
    settings = model.render_settings(training=False).without_head()
    for crop in (Crop(0, 0, 47, 31), part):
        plain, mirrored = (
            render_view(model.source, cam.cut(crop._replace(mirrored=one)), torch.zeros(3), settings)[0]
            for one in (False, True)
        )
        for name in ("rgb", "depth", "accumulation"):
            assert plain[name].std() > 1e-3
            error = (mirrored[name] - plain[name].flip(1)).abs()
            # Other roundings may skip a splat that is just visible, or keep it.
            assert error.max() < 0.02 * plain[name].max()
            assert (error > 2e-5).float().mean() < 0.005
    image = torch.rand(31, 47, 3)
    assert torch.equal(crop_image(image, part._replace(mirrored=True)), crop_image(image, part).flip(1))
    assert torch.equal(crop_image(image, part), image[3:23, 5:38])


@torch.no_grad()
def test_residual_head_starts_at_the_base_and_features_head_does_not_need_it(build: Build, camera: MakeCamera) -> None:
    residual, features = build(), build(head={"mode": "features"})
    residual.step = features.step = 10
    outputs = residual.eval().get_outputs_for_camera(camera())
    torch.testing.assert_close(outputs["rgb"], outputs["base_rgb"])
    first = features.eval().get_outputs_for_camera(camera())
    features.gauss_params["features_dc"].data.zero_()
    second = features.get_outputs_for_camera(camera())
    assert not torch.equal(first["base_rgb"], second["base_rgb"])
    assert torch.equal(first["rgb"], second["rgb"])


@pytest.mark.parametrize("mode", ["residual", "features"])
@pytest.mark.parametrize("factor", [1.0, 3.0])
@torch.no_grad()
def test_background_shows_where_nothing_is(
    build: Build, perturb: Perturb, camera: MakeCamera, mode: str, factor: float
) -> None:
    """Whatever the head has learnt, at its own scale and at another one."""
    model = perturb(build(head={"mode": mode})).eval()
    model.step, model.state.trained_focal = 10_000, (30.0, 30.0)
    assert model.state.head_enabled
    model.set_background(torch.tensor([0.2, 0.4, 0.6]))
    model.gauss_params["means"].data += 100.0
    picture = model.get_outputs_for_camera(at_focal(camera, factor))["rgb"]
    torch.testing.assert_close(picture, torch.tensor([0.2, 0.4, 0.6]).expand_as(picture))


@torch.no_grad()
def test_what_features_make_lies_over_the_background(build: Build, perturb: Perturb, camera: MakeCamera) -> None:
    """Once, by accumulation: between two backgrounds the picture differs by what shines through."""
    model = perturb(build(head={"mode": "features"})).eval()
    model.step = 10_000
    model.gauss_params["opacities"].data -= 3.0
    pictures = []
    for value in (0.25, 0.75):
        model.set_background(torch.full((3,), value))
        outputs = model.get_outputs_for_camera(camera())
        pictures.append((outputs["rgb"], outputs["accumulation"]))
    (dark, alpha), (light, _) = pictures
    inside = ((dark > 0) & (light < 1)).all(dim=-1, keepdim=True) & (alpha > 0.01) & (alpha < 0.99)
    assert inside.sum() > 50
    torch.testing.assert_close((light - dark)[inside[..., 0]], (0.5 * (1 - alpha))[inside].expand(3, -1).T)


def at_focal(camera: MakeCamera, factor: float) -> Cameras:
    """The test camera, its picture magnified."""
    small = camera()
    sides = {"width": round(40 * factor), "height": round(32 * factor)}
    center = {"cx": 20.0 * factor, "cy": 16.0 * factor}
    return Cameras(small.camera_to_worlds, fx=30.0 * factor, fy=30.0 * factor, **center, **sides)


@pytest.mark.parametrize("mode", ["residual", "features"])
def test_other_scales_get_the_correction_of_the_trained_one(
    build: Build, perturb: Perturb, camera: MakeCamera, mode: Any
) -> None:
    model = perturb(build(head={"mode": mode}, background_color="black")).eval()
    model.state.trained_focal = (30.0, 30.0)
    own = model.get_outputs(camera())
    correction = own["rgb"] - own["base_rgb"]
    assert correction.abs().max() > 1e-3
    double = model.get_outputs(at_focal(camera, 2))
    expected = (double["base_rgb"] + resize(correction, 64, 80)).clamp(0, 1)
    torch.testing.assert_close(double["rgb"], expected, atol=1e-5, rtol=0)
    # Within the tolerance the head sees the picture itself.
    model.state.trained_focal = (300.0, 300.0)
    near = model.get_outputs(at_focal(camera, 10.05))
    model.state.trained_focal = None
    assert torch.equal(near["rgb"], model.get_outputs(at_focal(camera, 10.05))["rgb"])


def test_the_head_remembers_its_scale(build: Build, training_of: TrainingOf) -> None:
    training = training_of(build(background_color="black"))
    for step in range(4):
        training.step(step)
    assert training.model.state.trained_focal is None  # the head took no part so far
    training.step(4)
    assert training.model.state.trained_focal == (30.0, 30.0)
    other = build(background_color="black")
    other.load_state_dict(training.model.state_dict())
    assert other.state.trained_focal == (30.0, 30.0)


class FullBackend:
    """A rasteriser on a device without room."""

    name = "full"

    def rasterize(self, *_: Any, **__: Any) -> Any:
        raise torch.cuda.OutOfMemoryError(
            "CUDA out of memory. Tried to allocate 2.50 GiB. GPU 0 has a total capacity of 79.10 GiB of which 1 MiB is "
            "free."
        )

    def spherical_harmonics(self, degree: int, directions: Tensor, coeffs: Tensor) -> Tensor:
        return torch.zeros_like(directions)


@pytest.mark.parametrize("training", [True, False], ids=["training", "rendering"])
def test_full_memory_says_how_much_and_what_to_try(build: Build, camera: MakeCamera, training: bool) -> None:
    model = build().train(training)
    model.backend = FullBackend()  # type: ignore[assignment]
    with pytest.raises(
        MemoryExhaustedError, match=rf"cannot allocate 2\.50 GiB more with {N} Gaussians; try"
    ) as caught:
        model.get_outputs_for_camera(camera())
    text = str(caught.value)
    assert "\n" not in text
    for option in ("cache-images cpu", "camera-res-scale-factor", f"max-gaussians {N // 2}"):
        assert option in text


@pytest.mark.parametrize("mode", ["residual", "features"])
def test_a_model_trained_ten_times_too_fast_may_be_bad_but_not_broken(
    build: Build, camera: MakeCamera, training_of: TrainingOf, mode: str
) -> None:
    """Field and head together, each by ten times its rate in the method."""
    model = build(head={"mode": mode, "start_at": 0}, pruning={"prune_at": 10})
    training = training_of(model)
    for name, optimizer in training.optimizers.optimizers.items():
        optimizer.param_groups[0]["lr"] = 10 * sundae.config.optimizers[name]["optimizer"].lr
    for step in range(1000 if os.environ.get("SUNDAE_ALL_SEEDS") == "1" else 100):
        training.step(step)
    outputs = model.eval().get_outputs_for_camera(camera())
    assert all(torch.isfinite(outputs[name]).all() for name in ("rgb", "base_rgb", "accumulation"))
    assert all(torch.isfinite(value).all() for value in model.parameters())
