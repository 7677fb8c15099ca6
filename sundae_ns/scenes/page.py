"""A packed scene as a web page that decodes and renders it, head included.

``page.html`` is built from the TypeScript in ``web/`` by ``make web``. It asks no host for anything: a scene is either in
the page itself or in a file beside it.
"""

from __future__ import annotations

import base64
import html
import io
from importlib import resources
from pathlib import Path

import torch
from PIL import Image

from sundae_ns.errors import writing
from sundae_ns.rasterization import select_backend
from sundae_ns.rendering import LocalField, render
from sundae_ns.scenes.statement import cameras_of, field_of, head_of, stated_model, stored_view
from sundae_ns.storage.atomic import replacing, write_text
from sundae_ns.storage.packing import Scene, read_scene

SCENE_FILE = "scene.sundae"
"""Name of the scene in a folder."""
_POSTER_SIDE = 640
"""Longest side of the image that a page shows until it draws, pixels."""
_POSTER_QUALITY = 80


def page_of(packed: Path, *, title: str) -> str:
    """The page of a packed scene, as one document without any address.

    Args:
        packed: the scene, which is checked.
        title: title of the page.

    Raises:
        PackError: the file is not a packed scene, or states impossible values.
    """
    return _filled(read_scene(packed), title, inline=base64.b64encode(packed.read_bytes()).decode())


def write_page(packed: Path, out: Path, *, title: str) -> int:
    """Write the page of a packed scene as one file, atomically.

    Returns:
        Bytes of the file.

    Raises:
        PackError: the file is not a packed scene, or states impossible values.
        StorageError: the disk is full or not writable.
    """
    write_text(out, page_of(packed, title=title))
    return out.stat().st_size


def write_folder(packed: Path, folder: Path, *, title: str) -> int:
    """Write the page and the scene as two files of a folder, ``index.html`` and ``scene.sundae``, for a web server.

    Returns:
        Bytes of both files.

    Raises:
        PackError: the file is not a packed scene, or states impossible values.
        StorageError: the disk is full or not writable.
    """
    page = _filled(read_scene(packed), title, source=SCENE_FILE)
    with writing(f"cannot write to {folder}"):
        folder.mkdir(parents=True, exist_ok=True)
    # The scene first: a page without its scene shows an error.
    with replacing(folder / SCENE_FILE) as partial:
        partial.write_bytes(packed.read_bytes())
    write_text(folder / "index.html", page)
    return sum((folder / name).stat().st_size for name in (SCENE_FILE, "index.html"))


def _filled(scene: Scene, title: str, *, inline: str = "", source: str = "") -> str:
    """The page with a scene in base64, or with the address of one."""
    poster = io.BytesIO()
    render_first(scene).save(poster, "jpeg", quality=_POSTER_QUALITY)
    values = {
        "TITLE": html.escape(title),
        "POSTER": f"data:image/jpeg;base64,{base64.b64encode(poster.getvalue()).decode()}",
        "SOURCE": source,
        "SCENE": inline,
    }
    page = resources.files("sundae_ns.scenes").joinpath("page.html").read_text(encoding="utf-8")
    for name, value in values.items():
        page = page.replace(f"@@{name}@@", value)
    return page


@torch.no_grad()
def render_first(scene: Scene) -> Image.Image:
    """The image of the scene's first camera, head included, at most 640 pixels wide and high.

    Raises:
        PackError: the scene states an impossible model.
    """
    model, field, head, cameras = stated_model(scene), field_of(scene), head_of(scene), cameras_of(scene)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if head is not None:
        head.to(device)
    field = field.replaced({name: value.to(device) for name, value in field.items()})
    view = stored_view(cameras, 0, device)
    view = view.zoomed(min(_POSTER_SIDE / max(view.width, view.height), 1.0))
    settings = model.settings(select_backend("auto", device), head)
    images, _ = render(LocalField(field), view, model.background.to(device), settings, depth=False)
    return Image.fromarray((images["rgb"].clamp(0, 1) * 255).round().byte().cpu().numpy())
