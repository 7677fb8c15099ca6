"""The exported page as a person uses it: panel, keys, fingers, links, pictures, and the camera at rest."""

from __future__ import annotations

import base64
import io
import json
import threading
from collections.abc import Iterator
from functools import partial
from http.server import ThreadingHTTPServer

import numpy as np
import pytest
from chromium import CHROMIUM, bench_page, browser, needs_chromium
from packed_scenes import KINDS, write_kind
from pages import SECONDS, SIZE, STOP, WEBGL, Quiet, hold, opened, rested, touch
from PIL import Image

from sundae_ns.scene.load_save import packed_file
from sundae_ns.scene.page import write_page

pytestmark = [pytest.mark.browser, needs_chromium]
image, psnr, truths = bench_page.image, bench_page.psnr, bench_page.truths


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a folder with a page and its scene."""
    folder = tmp_path_factory.mktemp("site")
    write_page(folder, *packed_file(write_kind(folder / "a.sundae", KINDS["residual"])), title="A b/c")
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=folder)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


WEIGHTS = """
window.weights = [];
const write = GPUQueue.prototype.writeBuffer;
GPUQueue.prototype.writeBuffer = function (buffer, offset, data, ...rest) {
  if (buffer.label === 'image') weights.push(new Float32Array(data, 28, 1)[0]);
  return write.call(this, buffer, offset, data, ...rest);
};
"""
"""Records the weight of the head's correction in each image."""


def test_the_head_fades_in_once_the_camera_rests(site: str) -> None:
    key = {"key": "w", "code": "KeyW"}
    with opened(site, before=WEIGHTS) as page:
        rested(page)
        page.evaluate("weights.length = 0")
        frames = page.evaluate("sundae.frames")
        page.call("Input.dispatchKeyEvent", {"type": "keyDown", **key})
        browser.wait_for(lambda: page.evaluate("sundae.frames") > frames + 4, "images of a moving camera", SECONDS)
        found = page.evaluate("[sundae.still, weights, document.querySelector('canvas').width]")
        page.call("Input.dispatchKeyEvent", {"type": "keyUp", **key})
        # A software adapter takes longer than a thirtieth of a second.
        assert found[0] is False
        assert set(found[1]) == {0}
        assert found[2] < SIZE[0]
        rested(page)
        weights = page.evaluate("weights")
        assert weights == sorted(weights)
        assert weights[-1] == 1
        assert page.evaluate("document.querySelector('canvas').width") == SIZE[0]
        # Neither a switch nor a moved camera is shown with the correction at once.
        page.evaluate("weights.length = 0; head.click()")
        rested(page)
        assert set(page.evaluate("weights")) == {0}
        page.evaluate("weights.length = 0; head.click()")
        browser.wait_for(lambda: page.evaluate("weights.at(-1)") == 1, "the head", SECONDS)
        assert page.evaluate("weights[0]") == 0


PINCH = [[(70, 60), (90, 60)], [(60, 60), (100, 60)], [(50, 60), (110, 60)]]


@pytest.mark.parametrize("drawn", ["webgpu", "webgl"])
def test_fingers_turn_and_zoom(drawn: str, site: str) -> None:
    def linked() -> list[float]:
        page.evaluate("document.getElementById('link').click()")
        return [float(word) for word in page.evaluate("location.hash").removeprefix("#camera=").split(",")]

    with opened(site, flags=browser.WEBGPU if drawn == "webgpu" else WEBGL) as page:
        assert page.evaluate("sundae.drawn") == drawn
        rested(page)
        assert linked() == [1]
        touch(page, (80, 60), (110, 60))
        browser.wait_for(lambda: len(linked()) > 1, "the turn", SECONDS)  # frames in software take seconds
        turned = linked()
        for i, points in enumerate(PINCH):
            event = {"type": "touchMove" if i else "touchStart", "touchPoints": [{"x": x, "y": y} for x, y in points]}
            page.call("Input.dispatchTouchEvent", event)
        page.call("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
        nearer = 0.8 * np.linalg.norm(turned[3:6])
        browser.wait_for(lambda: np.linalg.norm(linked()[3:6]) < nearer, "the zoom", SECONDS)


def test_the_panel_of_a_phone(site: str) -> None:
    with opened(site, flags=WEBGL, size=(390, 844)) as page:
        assert "W A S D" in page.evaluate("panel.innerText")
    with browser.Browser(CHROMIUM, 390, 844, WEBGL) as page:
        phone = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}
        page.call("Emulation.setDeviceMetricsOverride", phone)
        page.call("Emulation.setTouchEmulationEnabled", {"enabled": True, "maxTouchPoints": 2})
        page.open(site)
        browser.wait_for(lambda: page.evaluate("window.sundae?.state === 'ready'"), "the page", SECONDS)
        hint = page.evaluate("panel.innerText")
        assert "One finger turns" in hint
        assert "W A S D" not in hint
        assert "Fly" not in hint
        height = "panel.getBoundingClientRect().height"
        assert 100 < page.evaluate(height) <= 844 / 3
        assert page.evaluate("panel.scrollHeight <= panel.clientHeight")
        page.evaluate("panel.querySelector('summary').click()")
        assert page.evaluate(height) < 60


def test_links_lead_to_views(site: str) -> None:
    copy = "{ value: { writeText: async (text) => { window.copied = text } } }"
    before = f"Object.defineProperty(navigator, 'clipboard', {copy})"
    with opened(f"{site}#camera=2", flags=WEBGL, before=before) as page:
        assert page.evaluate(STOP) == "2 of 2"
        rested(page)
        page.drag(80, 60, 110, 70)
        browser.wait_for(lambda: page.evaluate(STOP) == "free", "another view", SECONDS)
        seen = rested(page)
        page.evaluate("link.click()")
        browser.wait_for(lambda: page.evaluate("window.copied"), "the link", SECONDS)
        link = page.evaluate("copied")
        assert page.evaluate("location.href") == link
        page.evaluate("after.click()")
        browser.wait_for(lambda: page.evaluate(STOP) == "1 of 2", "a camera", SECONDS)
        assert np.abs(rested(page) - seen).mean() > 1
        page.evaluate("location.hash = '#camera=NaN'")
        page.evaluate("location.hash = '#camera=1,2,3,0,0,1e999,1'")
        assert page.evaluate(STOP) == "1 of 2"
        page.evaluate(f"location.href = {json.dumps(link)}")
        browser.wait_for(lambda: page.evaluate(STOP) == "free", "the view", SECONDS)
        assert np.abs(rested(page) - seen).mean() < 0.1
    with opened(f"{site}#camera=1e999,<b>", flags=WEBGL) as page:
        assert page.evaluate(STOP) == "1 of 2"
        assert page.evaluate("sundae.message").startswith("This browser has no WebGPU")


@pytest.mark.parametrize("drawn", ["webgpu", "webgl"])
def test_a_picture_of_what_is_seen(drawn: str, site: str) -> None:
    before = """
      const make = URL.createObjectURL;
      URL.createObjectURL = (blob) => { window.blob = blob; return make(blob) };
      HTMLAnchorElement.prototype.click = function () { window.saved = this.download };
    """
    read = "blob.arrayBuffer().then((data) => btoa(String.fromCharCode(...new Uint8Array(data))))"
    with opened(site, flags=browser.WEBGPU if drawn == "webgpu" else WEBGL, before=before) as page:
        seen = rested(page)
        page.evaluate("picture.click()")
        browser.wait_for(lambda: page.evaluate("window.saved"), "the picture", SECONDS)
        assert page.evaluate("[saved, blob.type]") == ["A_b_c.png", "image/png"]
        with Image.open(io.BytesIO(base64.b64decode(page.evaluate(read)))) as found:
            pixels = np.asarray(found.convert("RGB")).astype(int)
        pixels[0, 0] = seen[0, 0]
        assert np.abs(pixels - seen).max() <= 1
        np.testing.assert_array_equal(rested(page)[1:], seen[1:])


def test_keys(site: str) -> None:
    before = "HTMLElement.prototype.requestFullscreen = async function () { window.whole = this.tagName };"
    with opened(site, flags=WEBGL, before=before) as page:
        page.key("PageDown", 34)
        browser.wait_for(lambda: page.evaluate(STOP) == "2 of 2", "the next camera", SECONDS)
        page.key("PageUp", 33)
        browser.wait_for(lambda: page.evaluate(STOP) == "1 of 2", "the camera before", SECONDS)
        page.key("KeyF", 70)
        browser.wait_for(lambda: page.evaluate("window.whole") == "HTML", "the full screen", SECONDS)
        start = rested(page)
        hold(page, "ArrowLeft")
        assert np.abs(rested(page) - start).mean() > 1
        assert page.evaluate(STOP) == "free"
        # Arrows that move the slider do not move the camera.
        page.key("PageUp", 33)
        page.evaluate("panel.style.visibility = 'visible'; panel.open = true; scale.focus()")
        page.key("ArrowLeft", 37)
        browser.wait_for(lambda: page.evaluate("scale.value") == "95", "the slider", SECONDS)
        rested(page)
        assert page.evaluate(STOP) != "free"


def test_controls_have_names_and_loading_a_bar(site: str) -> None:
    before = """
      window.bar = [];
      const { set } = Object.getOwnPropertyDescriptor(HTMLProgressElement.prototype, 'value');
      Object.defineProperty(HTMLProgressElement.prototype, 'value', {
        set(value) { bar.push(value); set.call(this, value) },
      });
    """
    with opened(site, flags=WEBGL, size=(640, 480), before=before) as page:
        values = page.evaluate("bar")
        assert values == sorted(values)
        assert len(set(values)) > 5
        assert 0.3 < values[-1] < 1
        assert page.evaluate("progress.hidden")
        nodes = page.call("Accessibility.getFullAXTree")["nodes"]
        parts = [
            (node["role"]["value"], node.get("name", {}).get("value")) for node in nodes if not node.get("ignored")
        ]
        assert ("application", "3D view of A b/c") in parts
        roles = {"button", "checkbox", "slider", "application", "DisclosureTriangle"}
        assert roles <= {role for role, _ in parts}
        assert all(name and name.strip("‹›×") for role, name in parts if role in roles), parts
