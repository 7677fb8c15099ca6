"""A scene: a field, its head, and what is needed to render both."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from sundae_ns.compensation import CompensationHead
from sundae_ns.errors import DataError
from sundae_ns.gaussians import from_points
from sundae_ns.gaussians.field import Field
from sundae_ns.rasterization import BackendName, select_backend
from sundae_ns.rendering.render import SHOWN_BACKGROUNDS, RenderSettings
from sundae_ns.rendering.views import View

Background = Literal["random", "black", "white"]
"""Names of backgrounds; ``random`` is that of a run trained over random ones, and shows nerfstudio's grey."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A field of Gaussian primitives, with its compensation head if it has one.

    Scenes are values: functions return new ones and change none.
    """

    field: Field
    """The primitives: tensors ``[N, ...]`` by name, see :mod:`sundae_ns.gaussians.parameters`; any device."""
    head: CompensationHead | None = None
    """The compensation head, on the device of the field; None without one."""
    background_color: Background = "black"
    antialiased: bool = False
    """Whether opacities compensate for the smallest footprint, as in training (``rasterize_mode`` of splatfacto)."""
    trained_focal: tuple[float, float] | None = None
    """Shortest and longest focal length of the images that the head was trained on, pixels."""
    views: tuple[View, ...] = ()
    """Cameras stored with the scene, such as some of its training views; on the CPU."""
    up: tuple[float, float, float] | None = None
    """The direction that is upwards, of unit length; None if it is not known. The web page turns about it."""
    start: View | None = None
    """The camera that the web page opens with, on the CPU; None for the first of the stored ones."""
    in_model_frame: bool = False
    """Whether coordinates are those of nerfstudio's model, not of the capture or of another program."""
    meta: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """JSON values that a packed scene carries along: ``frame``, ``capture``, ``source``."""

    @classmethod
    def from_points(cls, points: Tensor, colors: Tensor, *, sh_degree: int = 0) -> Scene:
        """A scene of one primitive for each point, sized by the distance to its neighbours.

        Args:
            points: positions ``[N, 3]``, world units.
            colors: in [0, 1] ``[N, 3]``.
            sh_degree: degree of the spherical harmonics, 0 to 4.

        Raises:
            DataError: shapes do not fit, or there are no points.

        >>> import torch, sundae_ns as sn
        >>> scene = sn.Scene.from_points(torch.rand(100, 3), torch.rand(100, 3))
        >>> scene.num_primitives
        100
        """
        if points.ndim != 2 or points.shape[1] != 3 or points.shape != colors.shape or not len(points):
            shapes = f"{list(points.shape)} and {list(colors.shape)}"
            raise DataError(f"points and colours have shapes {shapes}; pass [N, 3] each, N at least 1")
        return cls(Field(from_points(points, colors, sh_degree=sh_degree, num_features=0)))

    @property
    def num_primitives(self) -> int:
        """Number of primitives N."""
        return self.field.num_primitives

    @property
    def device(self) -> torch.device:
        """Device of the field and the head."""
        device: torch.device = self.field["means"].device
        return device

    @property
    def background(self) -> Tensor:
        """Colour behind the scene ``[3]``, on the device of the field."""
        return torch.tensor(SHOWN_BACKGROUNDS[self.background_color], device=self.device)

    def to(self, device: torch.device | str) -> Scene:
        """The scene on another device; stored views stay on the CPU."""
        if torch.device(device) == self.device:
            return self
        field = self.field.replaced({name: value.to(device) for name, value in self.field.items()})
        head = None
        if self.head is not None:
            # No deep copy: on a GPU the head keeps recorded CUDA graphs, which cannot be copied.
            with torch.random.fork_rng(devices=[]):
                head = CompensationHead(dataclasses.replace(self.head.config))
            head.load_state_dict(self.head.state_dict())
            head = head.train(self.head.training).to(device)
        return dataclasses.replace(self, field=field, head=head)

    def settings(self, backend: BackendName = "auto", *, head: bool = True) -> RenderSettings:
        """Settings that render the scene with all of its SH degrees.

        Args:
            backend: the rasteriser; ``auto`` takes gsplat on CUDA, compiled loops on a CPU.
            head: whether the head corrects images.

        Raises:
            BackendError: the rasteriser cannot run on the device of the scene.
        """
        return RenderSettings(
            select_backend(backend, self.device),
            antialiased=self.antialiased,
            head=self.head if head else None,
            trained_focal=self.trained_focal,
        )

    def __repr__(self) -> str:
        head = "no head" if self.head is None else f"{self.head.config.size} head"
        return f"Scene({self.num_primitives:,} primitives, SH degree {self.field.sh_degree}, {head}, {self.device})"
