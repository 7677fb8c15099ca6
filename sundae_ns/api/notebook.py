"""A scene in a notebook: its web page in a frame, which needs no server.

Seen to render in JupyterLab 4.6, in trusted notebooks: it removes frames from others. VS Code and Colab were not tried;
VS Code's setting ``notebook.experimental.enableCsp`` would refuse the worker in which the page decodes.
"""

from __future__ import annotations

import html
import logging
from dataclasses import dataclass, field

from sundae_ns.api.page import page_of
from sundae_ns.api.saving import packed_bytes
from sundae_ns.api.scene import Scene
from sundae_ns.errors import ConfigError

LARGE = 10_000_000
"""Bytes of a page from which :func:`show` warns: notebooks keep their outputs, and load all of them at once."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Embedded:
    """The web page of a scene, which a notebook shows if it is the value of a cell."""

    page: str = field(repr=False)
    """HTML of the page, the scene included."""
    title: str
    """Title of the page and of the frame."""
    height: int
    """Height of the frame in pixels; it is as wide as the notebook."""

    def _repr_html_(self) -> str:
        """The frame, by the name under which notebooks ask for HTML."""
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
        ConfigError: the height is not a positive number of pixels.
        PackError: the format cannot store the scene.

    >>> import torch, sundae_ns as sn
    >>> scene = sn.Scene.from_points(torch.rand(50, 3), torch.rand(50, 3))
    >>> sn.show(scene, height=300)
    Embedded(title='Scene', height=300)
    """
    if isinstance(height, bool) or not isinstance(height, int) or height < 1:
        raise ConfigError(f"the height of a frame is {height!r}; give a positive number of pixels")
    page = page_of(scene, packed_bytes(scene), title=title)
    if len(page) > LARGE:
        _log.warning(
            "the notebook will hold a page of %.1f MB; prune the scene first, or save it as scene.html",
            len(page) / 1e6,
        )
    return Embedded(page, title, height)
