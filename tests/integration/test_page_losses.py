"""The exported page where WebGPU or WebGL2 is missing, refused or lost."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chromium import bench_page, browser, needs_chromium
from packed_scenes import KINDS, write_kind
from pages import SAID, SECONDS, STOP, WEBGL, opened, rested

from sundae_ns.io.pack.packed_scene import read_scene
from sundae_ns.scene.load_save import packed_file
from sundae_ns.scene.page import write_page

pytestmark = [pytest.mark.browser, needs_chromium]
image, psnr, truths = bench_page.image, bench_page.psnr, bench_page.truths

DEVICES = """
window.devices = [];
const request = GPUAdapter.prototype.requestDevice;
GPUAdapter.prototype.requestDevice = async function (...words) {
  const device = await request.apply(this, words);
  devices.push(device);
  //
  return device;
};
"""
"""Keeps the devices of the page, for tests to end."""
NO_WEBGL = "HTMLCanvasElement.prototype.getContext = () => null;"
REFUSALS = {
    "no adapter": "navigator.gpu.requestAdapter = async () => null",
    "no answer about adapters": "navigator.gpu.requestAdapter = async () => { throw new Error('blocked') }",
    "no device": "GPUAdapter.prototype.requestDevice = async () => { throw new Error('refused') }",
    "a device that is lost at once": DEVICES.replace("//", "device.destroy();"),
    "no canvas": """
        const found = HTMLCanvasElement.prototype.getContext;
        HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
          return kind === 'webgpu' ? null : found.call(this, kind, ...rest);
        }""",
}
"""How WebGPU fails at the start, as scripts."""


def check_base_colours(page: Any, packed: Path) -> None:
    """The page draws by WebGL2 and says so."""
    assert page.evaluate("[sundae.state, sundae.drawn]") == ["ready", "webgl"]
    assert page.evaluate(SAID).endswith("base colours; the compensation head is not shown.")
    assert page.evaluate("document.getElementById('head-label').hidden")
    assert page.evaluate("document.getElementById('poster').hidden")
    # Quads have no tiles, and their sums are rounded to bytes; the worst is 50.0.
    for camera, truth in enumerate(truths(read_scene(packed))):
        assert psnr(image(page, camera, True), truth["base_rgb"]) > 47


def test_without_webgpu_the_page_shows_base_colours(tmp_path: Path) -> None:
    packed = write_kind(tmp_path / "a.sundae", KINDS["residual"])
    write_page(tmp_path / "a.html", *packed_file(packed), title="a")
    with opened((tmp_path / "a.html").as_uri(), flags=WEBGL) as page:
        assert page.evaluate(SAID).startswith("This browser has no WebGPU")
        check_base_colours(page, packed)


@pytest.mark.parametrize("refusal", REFUSALS)
def test_a_gpu_that_fails_at_the_start_leaves_base_colours(refusal: str, tmp_path: Path) -> None:
    packed = write_kind(tmp_path / "a.sundae", KINDS["residual"])
    write_page(tmp_path / "a.html", *packed_file(packed), title="a")
    with opened((tmp_path / "a.html").as_uri(), before=REFUSALS[refusal]) as page:
        check_base_colours(page, packed)


@pytest.mark.parametrize("loss", ["the device", "an error of its work", "the GPU process"])
def test_a_lost_gpu_leaves_camera_and_controls(loss: str, tmp_path: Path) -> None:
    packed = write_kind(tmp_path / "a.sundae", KINDS["residual"])
    write_page(tmp_path / "a.html", *packed_file(packed), title="a")
    with opened((tmp_path / "a.html").as_uri(), before=DEVICES) as page:
        assert page.evaluate("sundae.drawn") == "webgpu"
        page.evaluate("{ head.click(); scale.value = 80; scale.dispatchEvent(new Event('input')) }")
        rested(page)  # the panel covers so small a page
        page.drag(80, 60, 110, 70)
        browser.wait_for(lambda: page.evaluate(STOP) == "free", "another view", SECONDS)
        seen = rested(page)
        if loss == "the device":
            page.evaluate("devices[0].destroy()")
        elif loss == "an error of its work":
            page.evaluate("{ devices[0].createBuffer({ size: 16, usage: 0 }); devices[0].queue.submit([]) }")
        else:
            page.call("Browser.crashGpuProcess", browser=True)
        browser.wait_for(lambda: page.evaluate("sundae.drawn") == "webgl", "the other drawer", SECONDS)
        assert "lost the GPU" in page.evaluate(SAID)
        assert page.evaluate(f"[{STOP}, document.getElementById('scale-value').textContent]") == ["free", "80%"]
        # Both drawers show base colours; the worst is 0.6.
        assert np.abs(rested(page) - seen).mean() < 2
        check_base_colours(page, packed)
        page.drag(80, 60, 110, 70)
        browser.wait_for(lambda: np.abs(rested(page) - seen).mean() > 4, "another view", SECONDS)


def test_a_gpu_lost_without_webgl_leaves_the_image(tmp_path: Path) -> None:
    packed = write_kind(tmp_path / "a.sundae", KINDS["residual"])
    write_page(tmp_path / "a.html", *packed_file(packed), title="a")
    with opened((tmp_path / "a.html").as_uri(), before=DEVICES) as page:
        page.evaluate(f"{{ {NO_WEBGL} devices[0].destroy() }}")
        browser.wait_for(lambda: page.evaluate("sundae.state") == "failed", "the end", SECONDS)
        assert "WebGL2 is missing too" in page.evaluate(SAID)
        assert page.evaluate("[poster.hidden, stage.hidden, panel.hidden]") == [False, True, True]


def test_a_lost_webgl_context_is_opened_again(tmp_path: Path) -> None:
    packed = write_kind(tmp_path / "a.sundae", KINDS["residual"])
    write_page(tmp_path / "a.html", *packed_file(packed), title="a")
    lose = "document.querySelector('canvas').getContext('webgl2').getExtension('WEBGL_lose_context').loseContext()"
    with opened((tmp_path / "a.html").as_uri(), flags=WEBGL) as page:
        for _ in range(2):
            frames = page.evaluate("sundae.frames")
            page.evaluate(lose)
            browser.wait_for(lambda: page.evaluate("sundae.frames") > frames, "a frame", SECONDS)  # noqa: B023
            check_base_colours(page, packed)
        page.evaluate(lose)
        browser.wait_for(lambda: page.evaluate("sundae.state") == "failed", "the end", SECONDS)
        assert page.evaluate("[poster.hidden, stage.hidden, panel.hidden]") == [False, True, True]


def test_without_webgl_the_page_shows_an_image(tmp_path: Path) -> None:
    packed = write_kind(tmp_path / "a.sundae", KINDS["residual"])
    write_page(tmp_path / "a.html", *packed_file(packed), title="a")
    flags = ["--disable-features=WebGPU", "--disable-3d-apis"]
    with opened((tmp_path / "a.html").as_uri(), state="failed", flags=flags) as page:
        assert "no WebGPU, and WebGL2 is missing too" in page.evaluate(SAID)
        assert page.evaluate("[poster.hidden, poster.naturalWidth, poster.naturalHeight]") == [False, 50, 37]
