"""A packed scene as a web page that decodes and renders it, head included, alone or in a notebook.

``page.html`` is built from the TypeScript in ``web/`` by ``make web``. It contacts no host: a scene is either in the
page or in a file beside it. In a notebook it stands in a frame, which works in trusted notebooks of JupyterLab 4.6.
"""

from __future__ import annotations

import base64
import html
import io
import json
import logging
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from tempfile import TemporaryDirectory

from sundae_ns.core.camera import Camera
from sundae_ns.core.errors import ConfigError, MemoryExhaustedError, PackError, reading, regular
from sundae_ns.core.files import at_home, write_files
from sundae_ns.core.values import whole
from sundae_ns.io.pack.config import PackConfig
from sundae_ns.scene.cameras import opening
from sundae_ns.scene.scene import Scene, image_of, middle_and_reach, render, usable

LARGE = 10_000_000  # bytes of a page from which show() warns: notebooks load all of their outputs at once
_log = logging.getLogger(__name__)
View = Camera | int | str  # that a page names: a camera, the index of a stored one, or the link that the page copies
Shown = tuple[str, Scene, bytes]  # a scene on a page: its name, itself, and its packed file


def page(scenes: Scene | Mapping[str, Scene], path: Path | str, *, views: Mapping[str, View] | None = None) -> None:
    """Write the web page of a scene, or of two side by side that move together, as :func:`sundae_ns.save` writes one.

    Args:
        scenes: a scene, or up to two by the names that the page shows, in the same coordinates.
        path: an ``.html`` file, or a folder for a web server, which is a name without a suffix.
        views: by the names on their buttons: cameras, indices of cameras stored with the first scene, or links that
            *Copy link* gives. *Play* leads through them.

    Raises:
        ConfigError: there is no such view, there are more than two scenes, or the path has another suffix.
        PackError, StorageError: the format cannot store a scene; the disk is full or not writable.

    >>> import pathlib, tempfile, torch, sundae_ns as sn
    >>> scene = sn.Scene.from_points(torch.rand(50, 3), torch.rand(50, 3))
    >>> path = pathlib.Path(tempfile.mkdtemp(), "both.html")
    >>> sn.page({"before": scene, "after": scene[:25]}, path, views={"Front": 0})
    """
    named = {Path(path).resolve().stem: scenes} if isinstance(scenes, Scene) else dict(scenes)
    if Path(path).suffix.lower() not in ("", ".html"):
        raise ConfigError(f"{path} is no page; name it .html, or a folder without a suffix")
    write_page(at_home(path), *(shown_as(name, scene) for name, scene in named.items()), views=views)


def shown_as(name: str, scene: Scene, config: PackConfig | None = None) -> Shown:
    """Name, scene and packed file for a page; ``config`` are the settings of the pack, by default ``PackConfig()``."""
    scene = opening(scene)
    return name, scene, packed_of(scene, config)


def packed_of(scene: Scene, config: PackConfig | None = None) -> bytes:
    """The packed file of a scene; ``config`` is by default ``PackConfig()``."""
    from sundae_ns.io.pack.packed_scene import fit_scene, pack_bytes  # their encoder needs a compiler
    from sundae_ns.scene.packing import contents_of

    return pack_bytes(*fit_scene(contents_of(scene), config))[0]


def write_page(path: Path, *scenes: Shown, views: Mapping[str, View] | None = None) -> int:
    """Write the page of one or two scenes as one file, or without a suffix as a folder; returns the bytes."""
    names = [] if path.suffix else [f"scene{i or ''}.sundae" for i in range(len(scenes))]
    content = page_of(*scenes, views=views, files=names).encode(errors="backslashreplace")
    # The first is put in place last: without its scene a page shows an error.
    files = {path if path.suffix else path / "index.html": content}
    files |= {path / name: packed for name, (*_, packed) in zip(names, scenes)}
    write_files(files)
    return sum(map(len, files.values()))


@contextmanager
def opened_page(page: Path) -> Iterator[Path]:
    """The first scene in a page of one file, as a packed file for a while; ``PackError`` if there is none."""
    with reading(page, "a page with its scene", PackError, remedy="give the scene that it was made of"):
        found = re.search('class="scene"[^>]*>([^<]+)', regular(page).read_text(encoding="utf-8"))
        content = base64.b64decode(found[1] if found else "?", validate=True)
    with TemporaryDirectory() as folder:
        packed = Path(folder, f"{page.stem}.sundae")
        packed.write_bytes(content)
        yield packed


def page_of(*scenes: Shown, views: Mapping[str, View] | None = None, files: Sequence[str] = ()) -> str:
    """The HTML of a page that contains its scenes, or that reads them from files beside it; see :func:`page`."""
    if not 1 <= len(scenes) <= 2:
        raise ConfigError(f"a page of {len(scenes)} scenes was asked for; give one or two")
    links = json.dumps([(name, link_of(view, scenes[0][1], name)) for name, view in (views or {}).items()])
    elements = [
        f'<script type="application/octet-stream" class="scene" data-name="{html.escape(name)}"'
        f' data-source="{file}">{"" if file else base64.b64encode(packed).decode()}</script>'
        for (name, _, packed), file in zip(scenes, files or [""] * len(scenes), strict=True)
    ]
    values = {"TITLE": html.escape(" | ".join(name for name, *_ in scenes)), "POSTER": _poster(scenes[0][1])}
    values |= {"VIEWS": links.replace("<", "\\u003c"), "SCENES": "\n".join(elements)}
    template = resources.files("sundae_ns.scene").joinpath("page.html").read_text(encoding="utf-8")
    # In one pass: a title may contain the name of another value.
    return re.sub("@@([A-Z]+)@@", lambda name: values[name[1]], template)


def link_of(view: View, scene: Scene, name: str) -> str:
    """The part of an address that shows a view; ``ConfigError`` if there is none."""
    if isinstance(view, Camera):
        away = float((view.center.cpu().double() - middle_and_reach(usable(scene))[0]).norm())
        ahead = [-max(away, 1e-6) * value for value in view.pose[:, 2].tolist()]
        return f"#camera={','.join(f'{value:.7g}' for value in (*view.center.tolist(), *ahead))},1"
    stops = max(len(scene.cameras), 1)
    link = f"#camera={view + 1}" if isinstance(view, int) else f"#{view.rpartition('#')[2]}"
    *numbers, stop = link.removeprefix("#camera=").split(",")
    if not (link.startswith("#camera=") and len(numbers) in (0, 6) and stop.isdecimal() and 0 < int(stop) <= stops):
        raise ConfigError(f"view {name!r} is {view!r}; give a camera, an index below {stops}, or a link of the page")
    return link


def _poster(scene: Scene) -> str:
    """Data address of the first view's image, at most 640 pixels a side; of an empty one if it cannot be rendered."""
    content = io.BytesIO()
    try:
        camera = opening(scene).start or scene.cameras[0]
        image = render(scene, camera.zoomed(min(640 / max(camera.width, camera.height), 1.0))).rgb
    except MemoryExhaustedError as error:
        _log.warning("the page has no first image: %s", error)
        return "data:image/gif;base64,R0lGODlhAQABAIAAAAAAAP///yH5BAEAAAAALAAAAAABAAEAAAIBRAA7"  # a transparent pixel
    image_of(image).save(content, "jpeg", quality=80)
    return f"data:image/jpeg;base64,{base64.b64encode(content.getvalue()).decode()}"


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
    """The page of a scene, head included, as a notebook's output.

    The page, which the notebook stores, contains the scene, packed by default settings; it warns above 10 MB.

    Args:
        scene: any device.
        height: of the frame, pixels.
        title: of the page, for screen readers too.

    Raises:
        ConfigError, PackError: the height is no whole number of pixels; the format cannot store the scene.

    >>> import torch, sundae_ns as sn
    >>> scene = sn.Scene.from_points(torch.rand(50, 3), torch.rand(50, 3))
    >>> sn.show(scene, height=300)
    Embedded(title='Scene', height=300)
    """
    height = whole(height, "height")
    if len(content := page_of(shown_as(title, scene))) > LARGE:
        _log.warning("the notebook holds a page of %.1f MB; prune it, or save it as scene.html", len(content) / 1e6)
    return Embedded(content, title, height)
