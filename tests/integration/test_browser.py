"""The viewer in a real browser: ``ns-viewer`` on the tiny run, looked at and operated in a headless Chromium.

Screenshots are compared with pictures of the loaded model by the page's own camera. In between lie JPEG at quality 75
and the browser's enlarging to the size of its canvas, done here by the same bilinear filter.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from chromium import CHROMIUM, browser, needs_chromium
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.utils import colormaps
from nerfstudio.utils.eval_utils import eval_setup
from nerfstudio.viewer.utils import CameraState, get_camera
from PIL import Image
from viser import transforms

from harness.viewer_page import Server, ViewerPage
from sundae_ns.plugin.viewer import previewed_rule
from sundae_ns.pruning.decision import prune_gaussians
from sundae_ns.pruning.rule import kept_count
from sundae_ns.scene.render import GaussianSource, render_view

pytestmark = [pytest.mark.browser, needs_chromium]
SIDE = 256  # Longer side of pictures after "Fast" has been pressed, pixels
FAR = 48
MEAN, SHARE = 3.0, 0.02
"""Bounds of the mean difference of screenshot and render, in steps of 255, and of the share of pixels off by FAR."""


@pytest.fixture
def server(tiny, tmp_path):
    """``ns-viewer`` on the tiny run."""
    command = ("ns-viewer", "--load-config", tiny.config)
    server = Server(command, tmp_path / "viewer.log", "Caching / undistorting")
    yield server
    server.stop()


@pytest.fixture
def page():
    with ViewerPage(CHROMIUM, 640, 400) as page:
        yield page


def camera_of(page):
    """nerfstudio's camera for the page's, as its viewer makes it."""
    seen = page.camera
    rotation = transforms.SO3(wxyz=np.array(seen.wxyz)) @ transforms.SO3.from_x_radians(np.pi)
    position = torch.tensor(seen.position, dtype=torch.float64) / 10
    pose = torch.cat([torch.tensor(rotation.as_matrix()), position[:, None]], dim=1)
    width, height = page.images[-1]
    return get_camera(CameraState(seen.fov, seen.aspect, pose, CameraType.PERSPECTIVE), height, width)


def scene(page):
    """What the page last showed of the scene ``[H, W, 3]``, to 255, the axes in its lower left corner blackened."""
    left, top, width, height = page.canvas()
    seen = page.seen[top : top + height, left : left + width].astype(float)
    seen[-80:, :80] = 0
    return seen


def differences(seen, picture):
    """Mean difference of what is seen and a picture ``[H, W, C]``, and the share of pixels that are far off."""
    options = colormaps.ColormapOptions(normalize=True)
    shown = (colormaps.apply_colormap(picture, options) * 255).to(torch.uint8).numpy()
    height, width, _ = seen.shape
    expected = np.asarray(Image.fromarray(shown).resize((width, height), Image.Resampling.BILINEAR), dtype=float)
    expected[-80:, :80] = 0
    error = np.abs(seen - expected)
    return float(error.mean()), float((error.max(axis=2) > FAR).mean())


def test_every_control_does_what_it_says(tiny, server, page):
    _, pipeline, _, _ = eval_setup(tiny.config, test_mode="test")
    model = pipeline.model
    browser.wait_for(server.listens, "ns-viewer", 120)
    page.open(server.address)
    browser.wait_for(lambda: bool(page.images), "the first picture", 60)
    page.press("Hide Train Cams")
    page.settle(lambda: page.press("Fast"), SIDE)
    page.settle(lambda: page.drag(200, 250, 140, 230), SIDE)
    page.rest()
    found = {}

    @torch.no_grad()
    def outputs():
        model.set_background(torch.tensor([38, 42, 55]) / 255)  # what the viewer's menu is set to at first
        return dict(model.eval().get_outputs_for_camera(camera_of(page)))

    expected = outputs()
    first = scene(page)
    found["at first"] = differences(first, expected["rgb"])
    names = page.options("Output type")
    # The viewer itself adds the depth that it hands to the browser.
    assert set(names) == {*expected, "gl_z_buf_depth"}
    seen = {}
    for name in (*names[1:], names[0]):
        page.settle(lambda name=name: page.choose("Output type", name), SIDE)
        seen[name] = scene(page)
        if name in expected:
            found[name] = differences(seen[name], expected[name])

    # So short a training gives the head little to say, less than JPEG; but the same picture stays nearly the same,
    # also where an earlier one, of lower quality, is still on show.
    page.settle(lambda: page.tick("Neural compensation", False), SIDE)
    off = scene(page)
    found["head off"] = differences(off, expected["base_rgb"])
    said = np.abs(off - first).mean()
    assert said > 0
    assert np.abs(off - seen["base_rgb"]).mean() < 0.3 * said

    def as_at_first():
        page.rest(0.2)
        return bool(np.abs(scene(page) - first).mean() < 0.3 * said)

    page.settle(lambda: page.tick("Neural compensation", True), SIDE)
    browser.wait_for(as_at_first, "the picture with the head", 20)

    keep_ratio = page.settle(lambda: page.slide("Keep ratio", 0.1), SIDE)
    assert 0.05 < keep_ratio < 0.15
    rule = previewed_rule(model.config.pruning, "as configured")
    count = kept_count(keep_ratio, model.num_points)
    weights = model.contribution(pipeline.datamanager, count if rule.uses_detail else None)
    pruned = prune_gaussians(model.state.gaussians, rule, count, weights)
    assert pruned.decision.values is not None
    settings = replace(model.render_settings(training=False), head=None)
    with torch.no_grad():
        preview, _ = render_view(
            GaussianSource(pruned.gaussians), model.camera_of(camera_of(page)), expected["background"][0, 0], settings
        )
    previewed = scene(page)
    found["preview"] = differences(previewed, preview["rgb"])
    assert differences(previewed, expected["base_rgb"])[0] > 2 * found["preview"][0]
    page.settle(lambda: page.slide("Keep ratio", 1.1), SIDE)
    browser.wait_for(as_at_first, "the picture without preview", 20)

    print("\n".join(f"{name}: mean {mean:.2f}, far off {far:.4f}" for name, (mean, far) in found.items()))
    assert all(mean < MEAN and far < SHARE for mean, far in found.values()), found
    assert page.errors == []
    assert not server.complaints(), server.output()[-3000:]
