"""A packed scene as a web page that decodes and renders it, head included, alone or in a notebook.

``page.html`` is built from the TypeScript in ``web/`` by ``make web``. It contacts no host: a scene is either in the
page or in a file beside it. In a notebook it stands in a frame, which works in trusted notebooks of JupyterLab 4.6.
"""

from __future__ import annotations

import base64
import html
import io
import logging
import re
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path

from PIL import Image

from sundae_ns.core.errors import MemoryExhaustedError, writing
from sundae_ns.core.files import write_bytes, write_text
from sundae_ns.core.values import whole
from sundae_ns.scene.cameras import camera_in_front
from sundae_ns.scene.scene import Scene, image_of, render

SCENE_FILE = "scene.sundae"  # name of the scene in a folder
LARGE = 10_000_000  # bytes of a page from which show() warns: notebooks load all of their outputs at once
_log = logging.getLogger(__name__)


def page_of(scene: Scene, packed: bytes, *, title: str) -> str:
    """The HTML of a page that contains its scene; arguments as for :func:`write_page`."""
    return _filled(scene, title, inline=base64.b64encode(packed).decode())


def write_page(path: Path, scene: Scene, packed: bytes, *, title: str) -> int:
    """Write the page of a scene as one file, or without a suffix as a folder for a web server; returns the bytes."""
    if path.suffix:
        write_text(path, page_of(scene, packed, title=title))
        return path.stat().st_size
    page = _filled(scene, title, source=SCENE_FILE)
    with writing(f"cannot write to {path}"):
        path.mkdir(parents=True, exist_ok=True)
    # The scene first: a page without its scene shows an error.
    write_bytes(path / SCENE_FILE, packed)
    write_text(path / "index.html", page)
    return sum((path / name).stat().st_size for name in (SCENE_FILE, "index.html"))


def _filled(scene: Scene, title: str, *, inline: str = "", source: str = "") -> str:
    """The page with a scene in base64, or with the address of one."""
    values = {"TITLE": html.escape(title), "POSTER": _poster(scene), "SOURCE": source, "SCENE": inline}
    page = resources.files("sundae_ns.scene").joinpath("page.html").read_text(encoding="utf-8")
    # In one pass: a title may contain the name of another value.
    return re.sub("@@([A-Z]+)@@", lambda name: values[name[1]], page)


def _poster(scene: Scene) -> str:
    """Data address of the first image; of an empty one if it cannot be rendered."""
    try:
        image = render_first(scene)
    except MemoryExhaustedError as error:
        _log.warning("the page has no first image: %s", error)
        return "data:image/gif;base64,R0lGODlhAQABAIAAAAAAAP///yH5BAEAAAAALAAAAAABAAEAAAIBRAA7"  # a transparent pixel
    content = io.BytesIO()
    image.save(content, "jpeg", quality=80)
    return f"data:image/jpeg;base64,{base64.b64encode(content.getvalue()).decode()}"


def render_first(scene: Scene) -> Image.Image:
    """The image of the start view, else of the first camera, head included, at most 640 pixels wide and high."""
    camera = scene.start or (scene.cameras[0] if scene.cameras else camera_in_front(scene))
    return image_of(render(scene, camera.zoomed(min(640 / max(camera.width, camera.height), 1.0))).rgb)


@dataclass(frozen=True)
class Embedded:
    """The web page of a scene, which a notebook shows if it is the value of a cell."""

    page: str = field(repr=False)  # HTML, the scene included
    title: str
    height: int  # of the frame, pixels; it is as wide as the notebook

    def _repr_html_(self) -> str:  # notebooks call this
        # srcdoc, not an address: notebooks serve no files beside them, and browsers limit the length of data addresses.
        return (
            f'<iframe srcdoc="{html.escape(self.page)}" title="{html.escape(self.title)}" width="100%" '
            f'height="{self.height}" style="border: 0" allow="fullscreen; clipboard-write"></iframe>'
        )


def show(scene: Scene, *, height: int = 480, title: str = "Scene") -> Embedded:
    """The web page of a scene as the output of a notebook's cell, head included.

    The page contains the scene, packed with default settings. The notebook stores it; a page of more than 10 MB is
    logged as a warning.

    Args:
        scene: any device.
        height: of the frame, pixels.
        title: of the page, for screen readers too.

    Raises:
        ConfigError: the height is no whole number of pixels.
        PackError: the format cannot store the scene.

    >>> import torch, sundae_ns as sn
    >>> scene = sn.Scene.from_points(torch.rand(50, 3), torch.rand(50, 3))
    >>> sn.show(scene, height=300)
    Embedded(title='Scene', height=300)
    """
    height = whole(height, "height")
    from sundae_ns.scene.packing import packed_bytes  # its encoder needs a compiler, which other pages do not

    page = page_of(scene, packed_bytes(scene), title=title)
    if len(page) > LARGE:
        size = len(page) / 1e6
        _log.warning("the notebook will hold a page of %.1f MB; prune the scene first, or save it as scene.html", size)
    return Embedded(page, title, height)
