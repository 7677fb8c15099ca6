"""A scene: Gaussians, a head, and what is needed to render both; its images, and their quality."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from sundae_ns.core.camera import Camera
from sundae_ns.core.errors import BackendError, ConfigError, DataError, one_line
from sundae_ns.core.files import at_home
from sundae_ns.core.gaussians import FEATURES, MAX_SH_DEGREE, Gaussians, checked, rgb_to_sh, sanitise, sh_to_rgb
from sundae_ns.core.metrics import Quality, evaluate
from sundae_ns.core.values import AnyArray, fitting, floats, numbers, positions, whole
from sundae_ns.cuda.kernels import naming_full_memory
from sundae_ns.data.images import orientation_in, to_srgb, turned
from sundae_ns.data.photos import photo_of, upright
from sundae_ns.graph.neighbors import knn
from sundae_ns.head.head import CompensationHead
from sundae_ns.io.coordinates import Direction
from sundae_ns.rasterize.interface import BackendName, select_backend
from sundae_ns.scene.render import NEAR_PLANE, SHOWN_BACKGROUNDS, GaussianSource, RenderSettings, render_view

Background = Literal["random", "black", "white"]  # a scene trained over random ones is shown on nerfstudio's grey


@dataclass(frozen=True, eq=False)
class Scene:
    """Gaussians, and their compensation head if they have one. Functions return new scenes and change none."""

    gaussians: Gaussians
    """Tensors ``[N, ...]`` by name, see :mod:`sundae_ns.core.gaussians`; any device."""
    head: CompensationHead | None = None
    """The compensation head, on the device of the Gaussians; None without one."""
    background_color: Background = "black"
    antialiased: bool = False
    """Whether opacities compensate for the smallest footprint, as in training (``rasterize_mode`` of splatfacto)."""
    trained_focal: tuple[float, float] | None = None
    """Shortest and longest focal length of the images that the head was trained on, pixels."""
    cameras: tuple[Camera, ...] = ()
    """Cameras stored with the scene, such as some training views; on the CPU."""
    up: tuple[float, float, float] | None = None
    """Upward direction of unit length, about which the web page turns; None if it is not known."""
    start: Camera | None = None
    """The camera that the web page opens with, on the CPU; None for the first stored one."""
    in_model_frame: bool = False
    """Whether coordinates are those of nerfstudio's model; otherwise of a capture or of another program."""
    meta: Mapping[str, Any] = field(default_factory=dict)
    """JSON values that a packed scene carries along: ``frame``, ``capture``, ``source``."""
    __iter__ = None  # a scene is no list of Gaussians, nor of scenes

    @fitting()
    def __post_init__(self) -> None:
        put = super().__setattr__  # of a frozen class
        put("gaussians", checked(self.gaussians))
        features = self.gaussians[FEATURES].shape[1] if FEATURES in self.gaussians else 0
        if self.head is not None and features != (wanted := self.head.config.num_features):
            raise DataError(f"the head reads {wanted} features and the Gaussians have {features}; leave the head out")
        if self.background_color not in SHOWN_BACKGROUNDS:
            raise ConfigError(f"the background is {self.background_color!r}; give {', '.join(SHOWN_BACKGROUNDS)}")
        put("cameras", usable_cameras(self.cameras))
        put("start", None if self.start is None else usable_cameras(self.start)[0])
        put("up", None if self.up is None else unit(self.up))

    @classmethod
    @fitting()
    def from_points(cls, points: AnyArray, colors: AnyArray, *, sh_degree: int = 0) -> Scene:
        """One Gaussian for each point, sized by its neighbours.

        Args:
            points: positions ``[N, 3]``, world units.
            colors: uint8, or in [0, 1] ``[N, 3]``.
            sh_degree: degree of the spherical harmonics, 0 to 4.

        Raises:
            DataError: shapes or values do not fit, or there are no points.

        >>> import torch, sundae_ns as sn
        >>> sn.Scene.from_points(torch.rand(100, 3), torch.rand(100, 3)).num_gaussians
        100
        """
        points, colors = positions(points, "points"), floats(colors, "colors", colors=True)
        if points.ndim != 2 or points.shape[1] != 3 or points.shape != colors.shape or not len(points):
            shapes = f"{list(points.shape)} and {list(colors.shape)}"
            raise DataError(f"points and colours have shapes {shapes}; pass [N, 3] each, N at least 1")
        if not bool(points.isfinite().all()):
            raise DataError("some points are NaN or infinite; remove them, and their colours")
        if whole(sh_degree, "sh_degree", 0) > MAX_SH_DEGREE:
            raise ConfigError(f"sh_degree is {sh_degree}; give at most {MAX_SH_DEGREE}")
        return cls(Gaussians(from_points(points, colors.to(points.device), sh_degree=sh_degree)))

    @classmethod
    @fitting()
    def from_arrays(
        cls, means: AnyArray, scales: AnyArray, quats: AnyArray, opacities: AnyArray, colors: AnyArray
    ) -> Scene:
        """A scene of given Gaussians, as gsplat's ``rasterization`` takes them; lists, arrays or tensors.

        Args:
            means: centres ``[N, 3]``, world units.
            scales: standard deviations along the axes ``[N, 3]``, world units.
            quats: rotations as wxyz quaternions of any length ``[N, 4]``.
            opacities: in [0, 1] ``[N]``.
            colors: uint8, or in [0, 1] ``[N, 3]``; or coefficients of spherical harmonics ``[N, (degree + 1)^2, 3]``.

        Raises:
            DataError: shapes or values do not fit, or there are no Gaussians.

        >>> import numpy as np, sundae_ns as sn
        >>> sn.Scene.from_arrays(np.eye(3), np.full((3, 3), 0.1), np.eye(3, 4), np.full(3, 0.5), np.eye(3)).opacities
        tensor([0.5000, 0.5000, 0.5000])
        """
        harmonics = floats(colors, "colors", colors=np.ndim(colors) == 2)
        harmonics = rgb_to_sh(harmonics)[:, None] if harmonics.ndim == 2 else harmonics
        if harmonics.ndim != 3:
            raise DataError(f"colors has shape {list(harmonics.shape)}; it must be [N, 3] or [N, (degree + 1)^2, 3]")
        deviations, alphas, turns = floats(scales, "scales"), floats(opacities, "opacities"), floats(quats, "quats")
        if bool((deviations < 0).any()) or bool(((alphas - 0.5).abs() > 0.5).any()):
            raise DataError("scales are negative or opacities beyond [0, 1]; give neither logarithms nor logits")
        # Their squares may be out of the range of float32.
        turns = torch.nn.functional.normalize(turns / turns.abs().amax(dim=-1, keepdim=True).clamp_min(1e-38), dim=-1)
        params = {"means": means, "scales": deviations.log(), "quats": turns, "opacities": alphas.logit().view(-1, 1)}
        return cls(Gaussians({**params, "features_dc": harmonics[:, 0], "features_rest": harmonics[:, 1:]}))

    @property
    def num_gaussians(self) -> int:
        """Number of Gaussians N, also ``len(scene)``."""
        return self.gaussians.num_gaussians

    def __len__(self) -> int:
        return self.num_gaussians

    @fitting()
    def __getitem__(self, rows: slice | AnyArray) -> Scene:
        """Some of the Gaussians: ``scene[scene.opacities > 0.1]``; all else stays, head included.

        ``rows`` is a mask, bool ``[N]``, a slice, or indices ``[M]``; an array, a list or a tensor on any device.
        ``DataError`` for anything else, and for no Gaussians.
        """
        n = len(self)
        index = np.arange(n)[rows] if isinstance(rows, slice) else rows
        index = index if isinstance(index, Tensor) else torch.from_numpy(np.array(index))
        fits = index.dtype == torch.bool and index.shape == (n,)
        if index.dtype in (torch.int32, torch.int64) and index.ndim == 1 and index.numel():
            low, high = (int(limit) for limit in index.aminmax())
            fits = -n <= low <= high < n
        if not fits:
            kind = f"{str(index.dtype).removeprefix('torch.')} {list(index.shape)}"
            raise DataError(f"rows are {kind}; give a slice, a mask, bool [{n}], or indices [M] from 0 to {n - 1}")
        return replace(self, gaussians=self.gaussians.rows(index.to(self.device)))

    @property
    def means(self) -> Tensor:
        """Centres, world units ``[N, 3]``."""
        return self.gaussians["means"]

    @property
    def scales(self) -> Tensor:
        """Standard deviations along the axes, world units ``[N, 3]``; ``scene.gaussians`` has their logarithms."""
        return self.gaussians["scales"].exp()

    @property
    def quats(self) -> Tensor:
        """Rotations of the axes as wxyz quaternions of unit length ``[N, 4]``."""
        return torch.nn.functional.normalize(self.gaussians["quats"], dim=1)

    @property
    def opacities(self) -> Tensor:
        """Opacities at the centres, in [0, 1] ``[N]``; ``scene.gaussians`` has their logits."""
        return self.gaussians["opacities"].sigmoid().squeeze(1)

    @property
    def colors(self) -> Tensor:
        """Mean colours over all directions, those of SH degree 0, clamped to [0, 1] ``[N, 3]``."""
        return sh_to_rgb(self.gaussians.as_harmonics()["features_dc"]).clamp(0, 1)

    @property
    def offset(self) -> Direction | None:
        """Offset of survey coordinates: reading a file subtracts it, writing one adds it; None for none."""
        frame = {} if self.in_model_frame else self.meta.get("frame", {})
        rows = np.array(frame.get("transform", np.zeros((3, 4))), np.float64)[:3]
        if frame.get("scale") != 1 or not np.array_equal(rows[:, :3], np.eye(3)):
            return None
        return tuple((-rows[:, 3]).tolist())

    @property
    def device(self) -> torch.device:
        """Device of the Gaussians and the head."""
        return self.means.device

    @cached_property
    def extent(self) -> float:
        """Median distance of some Gaussians from their middle, world units; 1 in nerfstudio's model, or without any."""
        finite = sanitise({name: value[:: len(self) // 4096 + 1] for name, value in self.gaussians.items()}).gaussians
        return 1.0 if self.in_model_frame or not finite.num_gaussians else middle_and_reach(finite)[1]

    @property
    def background(self) -> Tensor:
        """Colour behind the scene ``[3]``, on the device of the scene."""
        return torch.tensor(SHOWN_BACKGROUNDS[self.background_color], dtype=torch.float32, device=self.device)

    @fitting()
    def to(self, device: torch.device | str) -> Scene:
        """The scene on another device; stored cameras stay on the CPU. ``BackendError`` if it is not available."""
        try:
            if torch.empty(0, device=device).device == self.device:
                return self
        except (RuntimeError, AssertionError, TypeError) as error:
            raise BackendError(f"the device {device} is not available ({one_line(error)}); give cpu") from error
        head = None
        if self.head is not None:
            # No deep copy: on a GPU the head keeps recorded CUDA graphs, which cannot be copied.
            with torch.random.fork_rng(devices=[]):
                head = CompensationHead(replace(self.head.config))
            head.load_state_dict(self.head.state_dict())
            head = head.train(self.head.training).to(device)
        return replace(self, gaussians=self.gaussians.to(device), head=head)

    @fitting()
    def settings(self, backend: BackendName = "auto", *, head: bool = True) -> RenderSettings:
        """Settings that render the scene with all of its SH degrees; ``BackendError`` without the rasteriser."""
        rasteriser, enabled = select_backend(backend, self.device), self.head if head else None
        near = NEAR_PLANE * min(1.0, self.extent)  # a scene of millimetres would lie behind the usual one
        return RenderSettings(
            rasteriser, antialiased=self.antialiased, head=enabled, trained_focal=self.trained_focal, near_plane=near
        )

    def __repr__(self) -> str:
        head = "no head" if self.head is None else f"{self.head.config.size} head"
        return f"Scene({self.num_gaussians:,} Gaussians, SH degree {self.gaussians.sh_degree}, {head}, {self.device})"


def from_points(points: Tensor, rgb: Tensor, *, sh_degree: int) -> dict[str, Tensor]:
    """Parameters of one Gaussian for each point, float32, on the device of ``points`` ``[N, 3]``; ``rgb`` is in [0, 1].

    The standard deviation is the mean distance to the three nearest neighbours (3DGS, Kerbl et al. 2023); of coincident
    points the smallest positive one. Points or colours that are not finite are dropped; ``DataError`` if all are.
    """
    finite = torch.isfinite(points).all(dim=1) & torch.isfinite(rgb).all(dim=1)
    points, rgb, n = points[finite].float(), rgb[finite].float(), int(finite.sum())
    if n == 0:
        raise DataError("the point cloud holds no finite point; check the capture, or start with --random-init True")
    width = points.new_ones(n)
    if n > 1:
        width = knn(points, min(3, n - 1)).distances.mean(dim=1).to(points)
        positive = width[width > 0]
        width = width.clamp_min(float(positive.min()) if len(positive) else 1e-3)
    u, v, w = torch.rand(3, n) * torch.tensor([[1.0], [2 * torch.pi], [2 * torch.pi]])
    a, b = (1 - u).sqrt(), u.sqrt()  # of uniform unit quaternions (Shoemake, 1992)
    return {
        "means": points.clone(),
        "scales": width.log()[:, None].repeat(1, 3),
        "quats": torch.stack([a * v.sin(), a * v.cos(), b * w.sin(), b * w.cos()], dim=-1).to(points.device),
        "features_dc": rgb_to_sh(rgb),
        "features_rest": points.new_zeros(n, (sh_degree + 1) ** 2 - 1, 3),
        "opacities": points.new_full((n, 1), 0.1).logit(),
    }


def initial_features(features_dc: Tensor, num_features: int, generator: torch.Generator | None = None) -> Tensor:
    """Initial feature vectors ``[N, F]``: small noise, plus ``features_dc`` ``[N, 3]`` in the first three channels."""
    features = (0.05 * torch.randn(len(features_dc), num_features, generator=generator)).to(features_dc)
    features[:, :3] += features_dc[:, :num_features]
    return features


def unit(direction: AnyArray) -> Direction:
    """A direction scaled to unit length; ``ConfigError`` for one without a direction."""
    x, y, z = numbers(direction, "the up axis", (3,)).tolist()
    if not (length := math.hypot(x, y, z)):
        raise ConfigError("the up axis has no direction; give 0 0 1 for z")
    return x / length, y / length, z / length


def usable_cameras(cameras: Any) -> tuple[Camera, ...]:
    """One or several cameras of a caller; ``DataError`` for anything else, and for one that is not finite."""
    listed = tuple(cameras) if isinstance(cameras, Iterable) and not isinstance(cameras, (Camera, str)) else (cameras,)
    for camera in listed:
        if not isinstance(camera, Camera):
            raise DataError(f"{str(camera)[:80]!r} is no camera; give a Camera, or those of cameras_of(path)")
        for matrix, side in zip(camera[:2], (4, 3), strict=True):
            if not isinstance(matrix, Tensor) or matrix.shape != (side, side) or matrix.dtype != torch.float32:
                raise DataError("the matrices of a camera are no float32 tensors; make it by Camera.from_pose")
        if not min(whole(value, "a side of a camera") for value in camera[2:4]) * camera.focal > 0:
            raise DataError(f"the focal length of a camera is {camera.focal}; give a positive number of pixels")
    on_cpu = [camera[:2] for camera in listed if camera.K.device.type == "cpu"]  # the values of others are waited for
    if on_cpu and not _are_pinholes(*(torch.stack(each).detach() for each in zip(*on_cpu, strict=True))):
        raise DataError("a camera is no pinhole without skew, with a finite rotation; make it by Camera.from_pose")
    return listed


def _are_pinholes(views: Tensor, K: Tensor) -> bool:
    """Whether matrices ``[V, 4, 4]`` and ``[V, 3, 3]`` are pinhole cameras without skew, which all rasterisers read."""
    axes, eye = views[:, :3, :3], torch.eye(4, device="cpu")
    plain = torch.equal(K * K.new_tensor([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]]), K)
    turned = ((axes @ axes.mT - eye[:3, :3]).abs() < 0.25).all() & (axes.det() > 0).all() & views.isfinite().all()
    last = (views[:, 3] == eye[3]).all() & (K[:, 2, 2] == 1).all()
    return plain and bool(turned & last & (K.diagonal(dim1=1, dim2=2) > 0).all())


def within(mask: Tensor, inner: Tensor) -> Tensor:
    """Apply a mask ``inner`` ``[M]`` to the M true entries of a mask ``[N]``."""
    return mask.masked_scatter(mask, inner)


def usable(scene: Scene) -> Gaussians:
    """The finite Gaussians, detached."""
    if not (gaussians := sanitise(scene.gaussians).gaussians).num_gaussians:
        raise DataError(f"none of {scene.num_gaussians:,} Gaussians is finite, so no camera sees the scene")
    return Gaussians({name: value.detach() for name, value in gaussians.items()}, gaussians.encoding)


def middle_and_reach(gaussians: Gaussians) -> tuple[Tensor, float]:
    """Median of the centres ``[3]``, float64 on the CPU, and their median distance from it; in one place, a size."""
    means = gaussians["means"].detach().double()
    middle = means.median(dim=0).values
    if (reach := float((means - middle).norm(dim=1).median())) == 0:
        reach = 3 * float(gaussians["scales"].double().amax(dim=1).median().exp())
    return middle.cpu(), max(reach, 1e-30)


class Rendering(NamedTuple):
    """Images of one view, float32 on the device of the scene."""

    rgb: Tensor
    """The image, corrected by the head if there is one, in [0, 1] ``[H, W, 3]``."""
    base_rgb: Tensor
    """The image of the Gaussians alone, in [0, 1] ``[H, W, 3]``."""
    depth: Tensor
    """Expected distance along the viewing axis, world units; 0 where nothing is seen ``[H, W, 1]``."""
    accumulation: Tensor
    """Opacity of the image, in [0, 1] ``[H, W, 1]``."""


def image_of(rgb: Tensor) -> Image.Image:
    """Colours in [0, 1] ``[H, W, 3]``, any device, as an image of 8 bits a channel."""
    return Image.fromarray((rgb * 255).round().byte().cpu().numpy())


def render(scene: Scene, camera: Camera, *, head: bool = True, backend: BackendName = "auto") -> Rendering:
    """Render one view of a scene, on its own device.

    Differentiable once if a tensor of the Gaussians or the camera requires a gradient, or the head is in training mode.

    Args:
        scene: from :func:`sundae_ns.load`, or made by hand.
        camera: the camera, on any device.
        head: whether the head corrects the image; without one, ``rgb`` is ``base_rgb``.
        backend: the rasteriser.

    Raises:
        BackendError: the rasteriser cannot run on the device of the scene, or gives no gradient for ``camera.K``.
        MemoryExhaustedError: the memory is full, or, on a CPU, the view has more Gaussians than any real scene.

    >>> import torch, sundae_ns as sn
    >>> scene = sn.Scene.from_points(torch.rand(100, 3), torch.rand(100, 3))
    >>> camera = sn.Camera.look_at((2.0, 2.0, 2.0), (0.5, 0.5, 0.5), width=64, height=48)
    >>> sn.render(scene, camera).rgb.shape
    torch.Size([48, 64, 3])
    """
    (camera,) = usable_cameras((camera,))
    settings = scene.settings(backend, head=head)
    wanted = any(value.requires_grad for value in (*scene.gaussians.values(), camera.viewmat, camera.K))
    wanted |= settings.head is not None and settings.head.training
    with naming_full_memory(lambda: scene.num_gaussians), torch.set_grad_enabled(wanted and torch.is_grad_enabled()):
        if camera.K.requires_grad and settings.backend.name == "gsplat":
            raise BackendError("gsplat has no gradient for camera.K; detach it, or use the backend 'reference'")
        images, _ = render_view(GaussianSource(scene.gaussians), camera.to(scene.device), scene.background, settings)
    return Rendering(*(images[name] for name in Rendering._fields))


@torch.no_grad()
def measure(
    scene: Scene,
    reference: Scene | Iterable[Any],
    cameras: Camera | Iterable[Camera] | None = None,
    *,
    head: bool = True,
    backend: BackendName = "auto",
) -> Quality:
    """Compare images to a reference.

    Args:
        scene: to measure.
        reference: a scene, whose own images count as true and over whose background both are rendered; or an image for
            each camera: the path of a photo, an image of PIL, an array or a tensor ``[H, W, 3]``, uint8 or in [0, 1].
        cameras: the cameras; by default those stored with the reference, or with the scene.
        head: whether the heads of both scenes correct their images.
        backend: the rasteriser.

    Raises:
        DataError: there are no cameras, or not one image of its size for each camera.

    >>> import torch, sundae_ns as sn
    >>> scene = sn.Scene.from_points(torch.rand(200, 3), torch.rand(200, 3))
    >>> cameras = sn.virtual_cameras(scene, 2, size=32)
    >>> sn.measure(sn.prune(scene, keep=0.5, cameras=cameras), scene, cameras).psnr > 10
    True
    """
    stored = reference.cameras if isinstance(reference, Scene) else ()
    cameras = usable_cameras(cameras) if cameras is not None else stored or scene.cameras
    if not cameras:
        raise DataError("there is no view to measure in; give cameras, such as sundae_ns.virtual_cameras(scene)")
    if isinstance(reference, Scene):
        scene = replace(scene, background_color=reference.background_color)
        targets = (render(reference, camera, head=head, backend=backend).rgb for camera in cameras)
    else:
        several = isinstance(reference, Iterable) and not isinstance(reference, (str, Path, Rendering))
        images = list(reference) if several and getattr(reference, "ndim", 4) != 3 else [reference]
        if len(images) != len(cameras):
            raise DataError(f"{len(images)} images do not fit {len(cameras)} views; give one image for each view")
        targets = (_image(image, f"image {i}") for i, image in enumerate(images))
    return evaluate(lambda camera: render(scene, camera, head=head, backend=backend).rgb, cameras, targets)


def _image(image: Any, name: str) -> Tensor:
    """An image of a caller, in [0, 1] ``[H, W, 3]``."""
    image = upright(photo_of(at_home(image)))[0] if isinstance(image, (str, Path)) else image
    if isinstance(image, Image.Image):
        converted = to_srgb(image)
        image = np.asarray(turned(converted.convert(converted.mode.replace("L", "RGB")), orientation_in(image)))
    return floats(image.rgb if isinstance(image, Rendering) else image, name, colors=True)
