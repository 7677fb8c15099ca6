"""``sn.show``: a frame for a notebook, whose page holds the scene."""

from __future__ import annotations

import base64
import logging
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
import torch
from chromium import CHROMIUM, browser, needs_chromium
from packed_scenes import KINDS, write_kind

import sundae_ns as sn
from sundae_ns.api import page as notebook
from sundae_ns.api.packing import packed_bytes
from sundae_ns.api.page import page_of
from sundae_ns.errors import ConfigError

HOSTILE = """"></iframe><script>alert('&amp;')</script><b x='"""


class Elements(HTMLParser):
    """The elements of a fragment with their attributes; open ones stay in ``open``."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert len(dict(attrs)) == len(attrs), "an attribute stands twice"
        self.found.append((tag, dict(attrs)))
        self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def frame_of(text: str) -> dict[str, Any]:
    """Attributes of the one element of a well-formed fragment, an ``iframe``."""
    parser = Elements()
    parser.feed(text)
    parser.close()
    assert (parser.open, parser.text) == ([], "")
    ((tag, attributes),) = parser.found
    assert tag == "iframe"
    return attributes


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> sn.Scene:
    return sn.load(write_kind(tmp_path_factory.mktemp("scenes") / "a.sundae", KINDS["residual"]))


def test_the_page_in_the_frame_holds_the_scene(scene: sn.Scene, tmp_path: Path) -> None:
    frame = frame_of(sn.show(scene, height=321)._repr_html_())
    assert (frame["height"], frame["width"]) == ("321", "100%")
    assert frame["srcdoc"] == page_of(scene, packed_bytes(scene), title="Scene")
    (inside,) = re.findall(r'<script type="application/octet-stream"[^>]*>([^<]*)</script>', frame["srcdoc"])
    (tmp_path / "shown.sundae").write_bytes(base64.b64decode(inside, validate=True))
    sn.save(scene, tmp_path / "saved.sundae")
    shown, saved = sn.load(tmp_path / "shown.sundae"), sn.load(tmp_path / "saved.sundae")
    assert shown.num_primitives == scene.num_primitives
    view = scene.views[0]
    torch.testing.assert_close(sn.render(shown, view).rgb, sn.render(saved, view).rgb, atol=0, rtol=0)
    assert float((sn.render(shown, view).rgb - sn.render(scene, view).rgb).abs().mean()) < 0.02  # packed once more


def test_a_hostile_title_stays_text(scene: sn.Scene) -> None:
    frame = frame_of(sn.show(scene, title=HOSTILE)._repr_html_())
    assert frame["title"] == HOSTILE
    plain = frame_of(sn.show(scene, title="plain")._repr_html_())
    assert frame["srcdoc"].replace(re.findall("<title>(.*)</title>", frame["srcdoc"])[0], "plain") == plain["srcdoc"]
    assert set(frame) == set(plain) == {"srcdoc", "title", "width", "height", "style", "allow"}


@pytest.mark.parametrize("height", [0, -1, 1.5, True, "400", '1" onload="alert(1)'])
def test_a_height_is_a_number_of_pixels(scene: sn.Scene, height: Any) -> None:
    with pytest.raises(ConfigError, match="the height of a frame is .*; give a positive number of pixels"):
        sn.show(scene, height=height)


def test_a_large_page_is_shown_with_a_warning(
    scene: sn.Scene, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    assert sn.show(scene).page
    assert caplog.text == ""
    monkeypatch.setattr(notebook, "LARGE", 100_000)
    shown = sn.show(scene)
    assert frame_of(shown._repr_html_())["srcdoc"] == shown.page
    assert re.search(r"a page of 0\.[2-9] MB; prune the scene first, or save it as scene.html", caplog.text)


@pytest.mark.browser
@needs_chromium
def test_a_browser_renders_the_scene_in_the_frame(scene: sn.Scene, tmp_path: Path) -> None:
    (tmp_path / "a.html").write_text(f"<body style='margin: 0'>{sn.show(scene, height=120)._repr_html_()}")
    with browser.Browser(CHROMIUM, 160, 120, browser.WEBGPU) as page:
        page.open((tmp_path / "a.html").as_uri())
        inside = "document.querySelector('iframe')?.contentWindow.sundae"
        browser.wait_for(lambda: page.evaluate(f"({inside}?.state ?? 'loading') !== 'loading'"), "the page", 180)
        assert page.evaluate(f"{inside}.state") == "ready", page.evaluate(f"{inside}.message")
        browser.wait_for(lambda: page.evaluate(f"{inside}.still"), "the image at rest", 180)
        assert page.errors == []
