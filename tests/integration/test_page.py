"""The exported page in a headless Chromium with a software adapter, against Python's images of the same file.

The page's images are bytes, whose rounding alone gives 58.9 dB. ``make browser SCENE=scene.sundae`` adds a scene.
"""

from __future__ import annotations

import base64
import dataclasses
import json
import os
import threading
from collections.abc import Callable
from functools import partial
from http.server import ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from chromium import CHROMIUM, bench_page, browser, needs_chromium, needs_packages
from numpy.typing import NDArray
from packed_scenes import KINDS, write_bomb, write_kind
from pages import SAID, SECONDS, SIZE, STOP, TICKING, WEBGL, Quiet, hold, opened, rested, touch

from sundae_ns.cli.view import serve
from sundae_ns.io.pack import container
from sundae_ns.io.pack.packed_scene import read_scene, write_scene
from sundae_ns.plugin.finished_runs import load_run
from sundae_ns.scene.load_save import packed_file
from sundae_ns.scene.packing import contents_of, stated_start
from sundae_ns.scene.page import page_of, write_page

pytestmark = needs_chromium
image, psnr, truths = bench_page.image, bench_page.psnr, bench_page.truths

LEAST = 57.0
"""Lowest PSNR of an image of the page against Python's; the worst is 58.7."""
LEAST_HALF = 55.0
"""The same with the head in half precision; the worst is 57.6."""


def check(page: Any, packed: Path, cameras: list[int]) -> None:
    for camera in cameras:
        truth = truths(read_scene(packed))[camera]
        assert psnr(image(page, camera, False), truth["base_rgb"]) > LEAST
        if page.evaluate("!document.getElementById('head-label').hidden"):
            assert psnr(image(page, camera, True), truth["rgb"]) > LEAST
            assert psnr(truth["base_rgb"], truth["rgb"]) < LEAST - 20, "the head changes nothing"
        assert page.evaluate("sundae.message") == ""


def test_images_of_the_page_are_those_of_python(tmp_path: Path) -> None:
    packed = write_kind(tmp_path / "a.sundae", KINDS["residual, folded"])
    write_page(tmp_path / "a.html", *packed_file(packed), title="a")
    with opened((tmp_path / "a.html").as_uri()) as page:
        check(page, packed, [0, 1])


@pytest.mark.browser
@pytest.mark.parametrize("name", [name for name in KINDS if name != "residual, folded"])
def test_every_kind_of_scene(name: str, tmp_path: Path) -> None:
    packed = write_kind(tmp_path / "a.sundae", KINDS[name])
    write_page(tmp_path / "a.html", *packed_file(packed), title="a")
    with opened((tmp_path / "a.html").as_uri()) as page:
        check(page, packed, [0, 1])


@pytest.fixture(params=["a trained capture", "SCENE"])
def capture(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A packed capture: the tiny run, and the scene that was given to ``make browser``."""
    if request.param == "SCENE":
        given = os.environ.get("SUNDAE_BROWSER_SCENE")
        return Path(given) if given else pytest.skip("no scene was given (make browser SCENE=scene.sundae)")
    write_scene(tmp_path / "tiny.sundae", contents_of(load_run(request.getfixturevalue("tiny").folder)))
    return tmp_path / "tiny.sundae"


@pytest.mark.browser
def test_six_cameras_of_a_packed_capture(capture: Path) -> None:
    row = bench_page.compared(capture, half=True)
    print(json.dumps(row))
    assert len(row["psnr_base"]) == 6
    assert len(row["psnr_head"]) == (6 if row["head"] else 0)
    assert min(row["psnr_base"] + row["psnr_head"]) > LEAST
    assert min(row.get("psnr_half", [LEAST])) > LEAST_HALF


@needs_packages
@pytest.mark.browser
@pytest.mark.parametrize("name", [name for name, kind in KINDS.items() if kind.head])
def test_the_head_in_half_precision(name: str, tmp_path: Path) -> None:
    packed = write_kind(tmp_path / "a.sundae", KINDS[name])
    made = bench_page.half_images(packed)
    if made is None:
        pytest.skip("no adapter has shader-f16 (mesa-vulkan-drivers 25 or newer has one)")
    images = truths(read_scene(packed))
    found = [psnr(image, truth["rgb"]) for image, truth in zip(made[1], images, strict=True)]
    assert min(found) > LEAST_HALF


@pytest.mark.browser
def test_the_controls(tmp_path: Path) -> None:
    packed = write_kind(tmp_path / "a.sundae", KINDS["residual"])
    server = serve(page_of(*packed_file(packed), title="a"), 0)
    threading.Thread(target=server.serve_forever, daemon=True).start()

    def look(page: Any) -> tuple[NDArray[np.int64], str]:
        """The canvas once it rests, and the words beside the stop."""
        return rested(page), page.evaluate(STOP)

    def after(page: Any, act: Callable[[], Any]) -> tuple[NDArray[np.int64], str]:
        """The same after an act has changed the canvas."""
        frames = "sundae.frames"
        before = page.evaluate(frames)
        act()
        browser.wait_for(lambda: page.evaluate(frames) > before, "a frame", SECONDS)
        return look(page)

    def press(page: Any, name: str) -> Callable[[], Any]:
        return lambda: page.evaluate(f"document.getElementById('{name}').click()")

    try:
        with opened(f"http://127.0.0.1:{server.server_port}/") as page:
            first, stop = look(page)
            assert stop == "1 of 2"
            bare, _ = after(page, press(page, "head"))
            assert np.abs(bare - first).mean() > 1
            again, _ = after(page, press(page, "head"))
            np.testing.assert_array_equal(again, first)
            second, stop = after(page, press(page, "after"))
            assert stop == "2 of 2"
            assert np.abs(second - first).mean() > 1
            again, stop = after(page, press(page, "after"))
            assert stop == "1 of 2"
            np.testing.assert_array_equal(again, first)
            turned, stop = after(page, lambda: page.drag(80, 60, 110, 70))
            assert stop == "free"
            assert np.abs(turned - first).mean() > 1
            touched, stop = after(page, lambda: touch(page, (80, 60), (40, 60)))
            assert stop == "free"
            assert np.abs(touched - turned).mean() > 1
            assert page.evaluate("document.getElementById('stats').textContent").split()[1] == "fps"
            # In fly mode the same drag turns the camera in place: the image goes the other way.
            after(page, press(page, "after"))
            start, _ = after(page, press(page, "before"))
            orbited, _ = after(page, lambda: page.drag(80, 60, 86, 60))
            after(page, press(page, "after"))
            after(page, press(page, "before"))
            page.evaluate("document.getElementById('fly').click()")
            flown, stop = after(page, lambda: page.drag(80, 60, 86, 60))
            assert stop == "free"
            assert np.abs(flown - start).mean() > 1
            assert np.abs(flown - orbited).mean() > 1
            moved, _ = after(page, lambda: hold(page, "KeyW"))
            assert np.abs(moved - flown).mean() > 1
            half = "const s = document.getElementById('scale'); s.value = 50; s.dispatchEvent(new Event('input'))"
            after(page, lambda: page.evaluate(f"{{{half}}}"))
            assert page.evaluate("document.getElementById('scale-value').textContent") == "50%"
    finally:
        server.shutdown()
        server.server_close()


@pytest.mark.browser
def test_the_page_opens_at_the_start_view_and_turns_about_the_up_axis(tmp_path: Path) -> None:
    plain, content = packed_file(write_kind(tmp_path / "a.sundae", KINDS["residual"]))
    second = plain.views[1]
    free = second._replace(viewmat=second.viewmat + 0.05 * torch.eye(4)[[3, 3, 3, 3]])
    shots = {}
    for name, up, start, stop in (
        ("x", (1.0, 0.0, 0.0), second, "2 of 2"),
        ("z", (0.0, 0.0, 1.0), second, "2 of 2"),
        ("free", (0.0, 0.0, 1.0), free, "free"),
    ):
        scene = dataclasses.replace(plain, up=up, start=start)
        write_page(tmp_path / "a.html", scene, container.restated(content, stated_start(scene)), title="a")
        with opened((tmp_path / "a.html").as_uri(), flags=["--disable-features=WebGPU"]) as page:
            hidden = "for (const id of ['panel', 'message']) document.getElementById(id).style.visibility = 'hidden'"
            page.evaluate(f"{{ {hidden}; {TICKING} }}")  # the message of WebGL2 would take the drag
            assert page.evaluate("document.getElementById('stop').textContent") == stop
            shots[name] = [page.screenshot().astype(int)]
            frames = page.evaluate("sundae.frames")
            page.drag(80, 60, 110, 70)
            browser.wait_for(lambda page=page, n=frames: page.evaluate("sundae.frames") > n, "a frame", SECONDS)
            shots[name].append(page.screenshot().astype(int))
            if stop == "2 of 2":
                page.evaluate("document.getElementById('after').click()")
                said = "document.getElementById('stop').textContent"
                browser.wait_for(lambda page=page, s=said: page.evaluate(s) == "1 of 2", "the next stop", SECONDS)

    def differ(one: str, other: str, i: int) -> float:
        return float(np.abs(shots[one][i] - shots[other][i]).mean())

    assert differ("x", "z", 0) < 0.1
    assert differ("x", "z", 1) > 1
    assert differ("free", "z", 0) > 1


@pytest.mark.browser
def test_a_hostile_file_ends_in_a_message(tmp_path: Path) -> None:
    packed = write_kind(tmp_path / "a.sundae", KINDS["residual"])
    page = page_of(*packed_file(packed), title="a")
    content = packed.read_bytes()
    wrong = page.replace(base64.b64encode(content).decode(), base64.b64encode(content[:-1] + b"~").decode())
    (tmp_path / "a.html").write_text(wrong)
    with opened((tmp_path / "a.html").as_uri(), state="failed") as found:
        assert "checksum" in found.evaluate(SAID)
        assert found.evaluate("!document.getElementById('poster').hidden")


@pytest.mark.browser
@pytest.mark.parametrize("drawn", ["webgpu", "webgl"])
def test_a_view_of_too_many_primitives_is_not_drawn(drawn: str, tmp_path: Path) -> None:
    packed = write_bomb(tmp_path / "a.sundae")
    write_page(tmp_path / "a.html", *packed_file(packed), title="a")
    flags = browser.WEBGPU if drawn == "webgpu" else WEBGL
    with opened((tmp_path / "a.html").as_uri(), flags=flags, size=(640, 480)) as page:
        assert page.evaluate("sundae.drawn") == drawn
        assert "20,000 Gaussians cover each of its pixels" in page.evaluate(SAID)
        assert image(page, 1, True).min() == 1
        page.evaluate("document.getElementById('after').click()")
        browser.wait_for(lambda: "Gaussians cover" not in page.evaluate(SAID), "another message", SECONDS)


@pytest.mark.browser
def test_a_folder_is_served_and_says_so_when_opened_from_disk(tmp_path: Path) -> None:
    packed = write_kind(tmp_path / "a.sundae", KINDS["residual"])
    write_page(tmp_path / "site", *packed_file(packed), title="a")
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=tmp_path / "site")) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        with opened(f"http://127.0.0.1:{server.server_port}/") as page:
            assert psnr(image(page, 0, True), truths(read_scene(packed))[0]["rgb"]) > LEAST
        server.shutdown()
    with browser.Browser(CHROMIUM, *SIZE, browser.WEBGPU) as page:
        page.open((tmp_path / "site" / "index.html").as_uri())
        browser.wait_for(lambda: bool(page.evaluate("window.sundae?.state === 'failed'")), "the message", SECONDS)
        assert "serve this folder" in page.evaluate("sundae.message")
