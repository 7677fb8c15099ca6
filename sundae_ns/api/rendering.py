"""Images of a scene."""

from __future__ import annotations

from typing import NamedTuple

import torch
from PIL import Image
from torch import Tensor

from sundae_ns.api.scene import Scene
from sundae_ns.gpu.memory import naming_full_memory
from sundae_ns.rasterization import BackendName
from sundae_ns.rendering import LocalField, View, render_view


class Rendering(NamedTuple):
    """Images of one view, float32 on the device of the scene."""

    rgb: Tensor
    """The image, corrected by the head if there is one, in [0, 1] ``[H, W, 3]``."""
    base_rgb: Tensor
    """The image of the primitives alone, in [0, 1] ``[H, W, 3]``."""
    depth: Tensor
    """Expected distance along the viewing axis, world units; 0 where nothing is seen ``[H, W, 1]``."""
    accumulation: Tensor
    """Opacity of the image, in [0, 1] ``[H, W, 1]``."""


def image_of(rgb: Tensor) -> Image.Image:
    """Colours in [0, 1] ``[H, W, 3]``, any device, as an image of 8 bits a channel."""
    return Image.fromarray((rgb * 255).round().byte().cpu().numpy())


@torch.no_grad()
def render(scene: Scene, view: View, *, head: bool = True, backend: BackendName = "auto") -> Rendering:
    """Render one view of a scene, on the device of the scene.

    Args:
        scene: from :func:`sundae_ns.load`, or made by hand.
        view: the camera, on any device.
        head: whether the head corrects the image; without one, ``rgb`` is ``base_rgb``.
        backend: the rasteriser.

    Raises:
        BackendError: the rasteriser cannot run on the device of the scene.
        MemoryExhaustedError: the memory is full, or, on a CPU, the view has more primitives than any real scene.

    >>> import torch, sundae_ns as sn
    >>> scene = sn.Scene.from_points(torch.rand(100, 3), torch.rand(100, 3))
    >>> view = sn.View.look_at((2.0, 2.0, 2.0), (0.5, 0.5, 0.5), width=64, height=48)
    >>> sn.render(scene, view).rgb.shape
    torch.Size([48, 64, 3])
    """
    with naming_full_memory(lambda: scene.num_primitives):
        settings = scene.settings(backend, head=head)
        images, _ = render_view(LocalField(scene.field), view.to(scene.device), scene.background, settings)
    return Rendering(*(images[name] for name in Rendering._fields))
