"""Images of the model: its outputs, crops, the background, other scales, and full memory."""

from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox

from sundae_ns.core.errors import MemoryExhaustedError
from sundae_ns.core.gaussians import Gaussians
from sundae_ns.head.head import resize
from sundae_ns.scene.render import GaussianSource, pass_inputs, render_view

N = 60  # Gaussians of a model that is built without a count
VIEWER_KEYS = {"rgb": 3, "base_rgb": 3, "depth": 1, "accumulation": 1, "features": 3, "response": 1, "background": 3}


@pytest.mark.parametrize("size", [(30, 30), (31, 47), (97, 33)])
@pytest.mark.parametrize("mode", ["residual", "features", "off"])
@torch.no_grad()
def test_every_output_can_be_shown(build, perturb, camera, mode, size):
    outputs = perturb(build(head={"mode": mode})).eval().get_outputs_for_camera(camera(*size))
    shapes = {name: value.shape for name, value in outputs.items()}
    assert shapes == {name: (*size[::-1], count) for name, count in VIEWER_KEYS.items()}
    for name, value in outputs.items():
        assert value.dtype == torch.float32, name
        assert torch.isfinite(value).all(), name
    for name in ("rgb", "base_rgb", "accumulation", "features", "response"):
        assert ((outputs[name] >= 0) & (outputs[name] <= 1)).all(), name
    assert outputs["response"].max() > 0
    assert (outputs["features"].std() > 0) == (mode != "off")


@torch.no_grad()
def test_depth_is_splatted_when_it_is_looked_at(build, perturb, camera, monkeypatch):
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
        assert model._response._last[0] is None, "nobody asks for it"
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
def test_a_crop_without_primitives_has_the_same_keys(model, camera):
    whole = model.get_outputs_for_camera(camera())
    far = OrientedBox.from_params((50.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    empty = model.get_outputs_for_camera(camera(), obb_box=far)
    assert [(name, value.shape) for name, value in empty.items()] == [(n, v.shape) for n, v in whole.items()]
    assert torch.equal(empty["rgb"], empty["background"])
    assert not empty["accumulation"].any()
    half = OrientedBox.from_params((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), (2.0, 9.0, 9.0))
    cropped = model.get_outputs_for_camera(camera(), obb_box=half)
    assert 0 < cropped["accumulation"].sum() < whole["accumulation"].sum()
    assert torch.equal(model.get_outputs_for_camera(camera())["rgb"], whole["rgb"])


@torch.no_grad()
def test_without_the_head_the_picture_is_the_base_exactly(model, camera):
    on = model.get_outputs_for_camera(camera())
    assert (on["rgb"] - on["base_rgb"]).abs().max() > 1e-3
    settings = replace(model.render_settings(training=False), head=None)
    off, _ = render_view(model.source, model.camera_of(camera()), on["background"], settings)
    assert torch.equal(off["rgb"], off["base_rgb"])
    # With features in the same pass the sums are taken in another order.
    torch.testing.assert_close(off["base_rgb"], on["base_rgb"], atol=1e-6, rtol=0)
    model.step = 3
    before = model.get_outputs_for_camera(camera())
    assert torch.equal(before["rgb"], before["base_rgb"])


@torch.no_grad()
def test_residual_head_starts_at_the_base_and_features_head_does_not_need_it(build, camera):
    residual, features = build().eval(), build(head={"mode": "features"}).eval()
    residual.step = features.step = 10
    outputs = residual.get_outputs_for_camera(camera())
    torch.testing.assert_close(outputs["rgb"], outputs["base_rgb"])
    first = features.get_outputs_for_camera(camera())
    features.gauss_params["features_dc"].data.zero_()
    second = features.get_outputs_for_camera(camera())
    assert not torch.equal(first["base_rgb"], second["base_rgb"])
    assert torch.equal(first["rgb"], second["rgb"])


@pytest.mark.parametrize("mode", ["residual", "features"])
@pytest.mark.parametrize("factor", [1.0, 3.0])
@torch.no_grad()
def test_background_shows_where_nothing_is(build, perturb, camera, mode, factor):
    """Whatever the head has learnt, at its own scale and at another one."""
    model = perturb(build(head={"mode": mode})).eval()
    model.step, model.state.trained_focal = 10_000, (30.0, 30.0)
    assert model.state.head_enabled
    model.set_background(torch.tensor([0.2, 0.4, 0.6]))
    model.gauss_params["means"].data += 100.0
    picture = model.get_outputs_for_camera(at_focal(camera, factor))["rgb"]
    torch.testing.assert_close(picture, torch.tensor([0.2, 0.4, 0.6]).expand_as(picture))


@torch.no_grad()
def test_what_features_make_lies_over_the_background(build, perturb, camera):
    """Once, by accumulation: between two backgrounds the picture differs by what shines through."""
    model = perturb(build(head={"mode": "features"})).eval()
    model.step = 10_000
    model.gauss_params["opacities"].data -= 3.0
    images = []
    for value in (0.25, 0.75):
        model.set_background(torch.full((3,), value))
        images.append(model.get_outputs_for_camera(camera()))
    dark, light, alpha = images[0]["rgb"], images[1]["rgb"], images[0]["accumulation"]
    inside = ((dark > 0) & (light < 1)).all(dim=-1, keepdim=True) & (alpha > 0.01) & (alpha < 0.99)
    assert inside.sum() > 50
    torch.testing.assert_close((light - dark)[inside[..., 0]], (0.5 * (1 - alpha))[inside].expand(3, -1).T)


def at_focal(camera, factor):
    """The test camera, its picture magnified."""
    small = camera()
    sides = {"width": round(40 * factor), "height": round(32 * factor)}
    center = {"cx": 20.0 * factor, "cy": 16.0 * factor}
    return Cameras(small.camera_to_worlds, fx=30.0 * factor, fy=30.0 * factor, **center, **sides)


@pytest.mark.parametrize("mode", ["residual", "features"])
def test_other_scales_get_the_correction_of_the_trained_one(build, perturb, camera, mode):
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


def test_the_head_remembers_its_scale(build, training_of):
    training = training_of(build(background_color="black"))
    for step in range(4):
        training.step(step)
    assert training.model.state.trained_focal is None  # the head took no part so far
    training.step(4)
    assert training.model.state.trained_focal == (30.0, 30.0)
    other = build(background_color="black")
    other.load_state_dict(training.model.state_dict())
    assert other.state.trained_focal == (30.0, 30.0)


@pytest.mark.parametrize("training", [True, False], ids=["training", "rendering"])
def test_full_memory_says_how_much_and_what_to_try(build, camera, training, monkeypatch):
    model = build().train(training)
    full = torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.50 GiB. GPU 0 has a total ...")
    monkeypatch.setattr(model.backend, "rasterize", Mock(side_effect=full))
    options = f"cache-images cpu .*camera-res-scale-factor .*max-gaussians {N // 2}"
    with pytest.raises(MemoryExhaustedError, match=rf"cannot allocate 2\.50 GiB more with {N} Gaussians; .*{options}"):
        model.get_outputs_for_camera(camera())


@torch.no_grad()
@pytest.mark.parametrize("n", [1, 5])
def test_one_primitive_has_no_response_to_show_and_few_have_one(build, camera, n):
    picture = build(n=n).eval().get_outputs_for_camera(camera())["response"]
    assert picture.isfinite().all()
    assert bool(picture.any()) == (n > 1)


def test_a_training_image_leaves_out_some_and_a_shown_one_none(build):
    model = build(n=4000)  # of 4 photos
    assert model.render_settings(training=True).drop_rate == 0, "the field still grows"
    model.state.pruning["num_prunes"], model.state.densify_until = 1, 0
    settings, params = (model.render_settings(training=on) for on in (True, False)), model.state.gaussians
    dropped, whole = (pass_inputs(params, None, each).opacities for each in settings)
    assert torch.equal(whole, params["opacities"].sigmoid().squeeze(1))
    assert 0.16 < (dropped == 0).float().mean() < 0.24  # six deviations
    torch.testing.assert_close(dropped[dropped > 0], (whole / 0.8).clamp(max=1)[dropped > 0])
    cases = ((4, 0.1, 0, 0.2), (32, 0.1, 1, 0), (32, None, 0, 0), (32, None, 1, 0.1))
    for model.num_train_data, model.config.pruning.keep_ratio, model.state.averages_from, rate in cases:
        assert model.render_settings(training=True).drop_rate == rate
    model.config.drop_rate = 0.3
    assert model.render_settings(training=True).drop_rate == 0.3
