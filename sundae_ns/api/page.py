"""A packed scene as a web page that decodes and renders it, head included.

``page.html`` is built from the TypeScript in ``web/`` by ``make web``. It asks no host for anything: a scene is either
in the page itself or in a file beside it.
"""

from __future__ import annotations

import base64
import html
import io
import logging
import re
from importlib import resources
from pathlib import Path

from PIL import Image

from sundae_ns.api.rendering import image_of, render
from sundae_ns.api.scene import Scene
from sundae_ns.api.views import view_in_front
from sundae_ns.errors import MemoryExhaustedError, writing
from sundae_ns.storage.atomic import replacing, write_text

SCENE_FILE = "scene.sundae"
"""Name of the scene in a folder."""
_POSTER_SIDE = 640
"""Longest side of the image that a page shows until it draws, pixels."""
_POSTER_QUALITY = 80
_NO_POSTER = "data:image/gif;base64,R0lGODlhAQABAIAAAAAAAP///yH5BAEAAAAALAAAAAABAAEAAAIBRAA7"
"""One transparent pixel."""
_log = logging.getLogger(__name__)


def page_of(scene: Scene, packed: bytes, *, title: str) -> str:
    """The HTML of a page that contains its scene; arguments as for :func:`write_page`."""
    return _filled(scene, title, inline=base64.b64encode(packed).decode())


def write_page(path: Path, scene: Scene, packed: bytes, *, title: str) -> int:
    """Write the page of a scene as one file, or as a folder with ``index.html`` and ``scene.sundae`` for a web server.

    Args:
        path: file with a suffix, or folder without one.
        scene: for the first image; rendered on its device.
        packed: the scene as a packed file.
        title: title of the page.

    Returns:
        Bytes of the file or of both files.

    Raises:
        StorageError: the disk is full or not writable.
    """
    if path.suffix:
        write_text(path, page_of(scene, packed, title=title))
        return path.stat().st_size
    page = _filled(scene, title, source=SCENE_FILE)
    with writing(f"cannot write to {path}"):
        path.mkdir(parents=True, exist_ok=True)
    # The scene first: a page without its scene shows an error.
    with replacing(path / SCENE_FILE) as partial:
        partial.write_bytes(packed)
    write_text(path / "index.html", page)
    return sum((path / name).stat().st_size for name in (SCENE_FILE, "index.html"))


def _filled(scene: Scene, title: str, *, inline: str = "", source: str = "") -> str:
    """The page with a scene in base64, or with the address of one."""
    values = {
        "TITLE": html.escape(title),
        "POSTER": _poster(scene),
        "SOURCE": source,
        "SCENE": inline,
    }
    page = resources.files("sundae_ns.api").joinpath("page.html").read_text(encoding="utf-8")
    # In one pass: a title may contain the name of another place.
    return re.sub("@@([A-Z]+)@@", lambda place: values[place[1]], page)


def _poster(scene: Scene) -> str:
    """Address of the first image; of an empty one if it cannot be rendered."""
    try:
        image = render_first(scene)
    except MemoryExhaustedError as error:
        _log.warning("the page has no first image: %s", error)
        return _NO_POSTER
    content = io.BytesIO()
    image.save(content, "jpeg", quality=_POSTER_QUALITY)
    return f"data:image/jpeg;base64,{base64.b64encode(content.getvalue()).decode()}"


def render_first(scene: Scene) -> Image.Image:
    """The image of the scene's start view, else of its first one, head included, at most 640 pixels wide and high.

    Raises:
        MemoryExhaustedError: the view has more primitives than any real scene, or needs more memory than there is.
    """
    view = scene.start or (scene.views[0] if scene.views else view_in_front(scene))
    return image_of(render(scene, view.zoomed(min(_POSTER_SIDE / max(view.width, view.height), 1.0))).rgb)
