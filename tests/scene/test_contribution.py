"""What each Gaussian contributes to the training pictures."""

import sys
from unittest.mock import Mock

import pytest
import torch
from fields import random_field

import sundae_ns as sn
from sundae_ns.core.errors import DataError
from sundae_ns.core.gaussians import Gaussians
from sundae_ns.pruning.scores import pixel_detail
from sundae_ns.rasterize.interface import blending_weights, rasterize
from sundae_ns.scene.render import GaussianSource, contribution, pass_inputs

N = 60  # Gaussians of a model that is built without a count


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_contribution_is_the_weight_in_the_pictures(build, datamanager, mode):
    torch.set_num_threads(2)  # two views at a time
    model = build(rasterize_mode=mode)
    # Thinner than a pixel, where the two modes differ by far.
    model.gauss_params["scales"].data[:30] = -6.0
    model.gauss_params["means"].data[4] = torch.tensor([0.0, 0.0, 50.0])
    total = model.contribution(datamanager)
    assert total.shape == (N,)
    assert not total.requires_grad
    assert (total >= 0).all()
    assert total[4] == 0
    model.eval()
    with torch.no_grad():
        alphas = [model.get_outputs_for_camera(camera)["accumulation"] for camera, _ in datamanager.training_views()]
    assert float(total.sum()) == pytest.approx(float(torch.stack(alphas).sum()), rel=1e-4)


@pytest.mark.parametrize("count", [None, N // 2])
def test_what_masks_leave_out_of_training_asks_for_no_primitives(build, datamanager, count):
    """The two halves of an image add up to the whole; many Gaussians contribute to one half only."""
    model = build()
    model.gauss_params["scales"].data[:] = -4.0
    whole = model.contribution(datamanager, count)
    left = (torch.arange(40) < 20).expand(32, 40)[..., None]
    parts = []
    for datamanager.mask in (left, ~left):
        parts.append(model.contribution(datamanager, count))
    torch.testing.assert_close(parts[0] + parts[1], whole)
    for only, other in (parts, parts[::-1]):
        assert ((only == 0) & (other > 0)).any()
    datamanager.mask = torch.ones_like(left)
    torch.testing.assert_close(model.contribution(datamanager, count), whole)
    for datamanager.mask in (left[:-1], left[..., 0], left[:1]):
        with pytest.raises(DataError, match="its view is 40 x 32 px"):
            model.contribution(datamanager, count)


@pytest.mark.parametrize("masked", [False, True])
def test_weights_by_detail_are_those_of_an_image_and_a_second_pass(masked):
    scene = sn.Scene(Gaussians(random_field(60, features=0)))
    camera, settings = sn.virtual_cameras(scene, 1, size=40)[0], scene.settings()
    mask = torch.rand(40, 40, 1, generator=torch.Generator().manual_seed(0)) < 0.5 if masked else None
    found = contribution(GaussianSource(scene.gaussians), [(camera, mask)], scene.background, settings, 20)
    image = sn.render(scene, camera)
    visible = rasterize(pass_inputs(scene.gaussians, camera, settings), backend=settings.backend).radii > 0
    pixels = pixel_detail(image.rgb, 20 / 60 * float(visible.sum()))
    pixels = pixels if mask is None else pixels * mask[..., 0]
    expected = blending_weights(pass_inputs(scene.gaussians, camera, settings), pixels, backend=settings.backend)
    assert float(expected.max()) > 0.1
    torch.testing.assert_close(found, expected)
    assert not any(value.requires_grad for value in scene.gaussians.values())


def test_a_prune_weighs_detail_for_the_count_that_it_keeps(build, training_of, monkeypatch):
    training = training_of(build(pruning={"mode": "continuous", "start": 3, "stop": 3, "target_gaussians": 15}))
    spy = Mock(side_effect=pixel_detail)
    monkeypatch.setattr(sys.modules[contribution.__module__], "pixel_detail", spy)
    counts = []
    for step in range(6):
        training.step(step)
        counts.append(training.model.num_points)
    assert counts == [60, 60, 60, 15, 15, 15]
    # All Gaussians are visible in each of three views, and 15 of them stay.
    assert [call.args[1] for call in spy.call_args_list] == [15.0] * 3
