"""nerfstudio's parsers of a ``transforms.json`` and of a COLMAP model, with their wrong steps replaced, and checks.

They honour the lens of each camera, more of COLMAP's lenses and survey coordinates, leave clouds in the scale of the
cameras, ask no questions and need no open3d, which needs system libraries of a desktop.

nerfstudio's parsers are one long method each. :func:`rebound` runs a copy of such a method in which single functions
are others; everything else, to the bit, is nerfstudio's.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from itertools import compress
from pathlib import Path
from types import FunctionType, SimpleNamespace
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras import camera_utils
from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE, Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig, DataparserOutputs
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParser, ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio, NerfstudioDataParserConfig
from nerfstudio.data.utils import colmap_parsing_utils
from numpy.typing import NDArray
from torch import Tensor

from sundae_ns.core.camera import Camera, world_to_camera, world_to_camera_floats
from sundae_ns.core.errors import ConfigError, DataError
from sundae_ns.data.capture import check_first_image, check_transforms, read_json, rigid
from sundae_ns.data.colmap import ColmapImage, check_colmap, read_images, read_points
from sundae_ns.data.layouts import no_model, no_transforms
from sundae_ns.data.lenses import DISTORTION, INTRINSICS, KINDS, PERSPECTIVE, Lens, lens_of, with_focal_lengths
from sundae_ns.data.photos import copies
from sundae_ns.io.ply import read_point_cloud
from sundae_ns.io.run_folder import FRAME_FILE
from sundae_ns.train.progress import show_log

show_log()  # all commands that train or open a run load this module
_log = logging.getLogger(__name__)

Array = NDArray[np.float64]

TYPES = {name: CAMERA_MODEL_TO_TYPE[name].value for name in KINDS}  # nerfstudio's camera type of each kind of lens
STRAY = 10.0  # A camera is stray if it stands more than this many times as far from the middle as the others
FAR = 20.0  # Times the median distance beyond which cameras are warned of where too many are far away to be stray
FINE_STEP, COARSE_STEP = 1e-5, 1e-3
"""Steps of float32 at the cameras, as shares of their distances: coordinates are shifted from the first one on, and
cannot be used from the second one on."""

_RANGES: dict[str, tuple[float, float, str]] = {
    "downscale_factor": (1, 1e9, "1 or more, 1 for images of full size"),
    "train_split_fraction": (1e-9, 1, "a share in (0, 1]"),
    "eval_interval": (2, 1e9, "2 or more"),
    "scale_factor": (1e-9, 1e9, "a positive number"),
    "camera_res_scale_factor": (1e-9, 1e9, "a positive number"),
}
"""Least and most of options of parsers and datamanager, with which nerfstudio divides by zero or trains on nothing."""


def check_ranges(options: Any) -> None:
    """Raise ``ConfigError`` for the first option that is out of its range."""
    for name, (least, most, wanted) in _RANGES.items():
        if (value := getattr(options, name, None)) is not None and not least <= value <= most:
            raise ConfigError(f"--{name.replace('_', '-')} is {value}; give {wanted}")


def check_capture(parser: DataParserConfig, data: Path, splits: Sequence[str], *, images: bool = True) -> None:
    """Check a capture, a folder or a ``transforms.json``, in nerfstudio's or COLMAP's layout before it is parsed.

    ``images`` says whether they will be needed beside the cameras of the ``splits``. ``ConfigError`` for an option of
    the parser out of its range; ``DataError`` names the first thing that cannot be used, and where it stands.
    """
    check_ranges(parser)
    if not data.exists():
        raise DataError(f"{data} does not exist; give the folder of the capture with --data, or in config.yml")
    if isinstance(parser, ColmapDataParserConfig):
        if not (model := data / parser.colmap_path).is_dir():
            raise no_model(data, parser.colmap_path)
        if parser.load_3D_points and not any(model.glob("points3D.*")):
            parser.load_3D_points = False  # the model then warns, and starts from random points
        check_colmap(model, data / parser.images_path if images else None, points=parser.load_3D_points)
    elif isinstance(parser, NerfstudioDataParserConfig):
        path = data if data.suffix == ".json" else data / "transforms.json"
        if not path.is_file():
            raise no_transforms(data)
        meta = check_transforms(path, splits=splits)
        if images:  # nerfstudio looks at the size of the first
            check_first_image(path, meta, parser.downscale_factor or 1)


def set_parser(config: DataParserConfig, robust: bool) -> None:
    """Let our parser read a capture in place of nerfstudio's, ``robust`` as in :class:`SundaeDatamanagerConfig`."""
    target: Any = config._target
    config._target = {Nerfstudio: LightNerfstudioParser, ColmapDataParser: CarefulColmapParser}.get(target, target)
    config.robust = robust  # type: ignore[attr-defined]


def rebound(method: Any, **names: Any) -> Any:
    """A copy of a function in which global ``names`` have these values; the function itself does not change."""
    scope = {**method.__globals__, **names}
    copy = FunctionType(method.__code__, scope, method.__name__, method.__defaults__, method.__closure__)
    copy.__kwdefaults__ = method.__kwdefaults__
    return copy


def replaced(module: Any, **names: Any) -> SimpleNamespace:
    """The contents of a module, with some of its functions replaced."""
    return SimpleNamespace(**{**vars(module), **names})


def _distances_of(centres: Array) -> tuple[Array, Array]:
    """The middle ``[3]`` of camera centres ``[N, 3]`` and the distance ``[N]`` of each from it."""
    middle = np.median(centres, axis=0)
    return middle, np.linalg.norm(centres - middle, axis=1)


def stray_cameras(centres: Array, points: Callable[[], Array | None] = lambda: None) -> NDArray[np.bool_]:
    """Which cameras ``[N]``, by their centres ``[N, 3]``, stand too far away to set the scene's centre and scale.

    Few cameras far away may also be all that moves, in a panorama from one place. There the points of the scene
    ``[M, 3]`` are as far as they; ``points`` is called only if a camera is far away. Of three none is stray.
    """
    if len(centres) < 4:
        return np.zeros(len(centres), dtype=bool)
    middle, distances = _distances_of(centres)
    # Up to one camera in five is a stray one; where there are more, they are part of the capture.
    usual = float(np.sort(distances)[len(centres) - 1 - max(1, len(centres) // 5)])
    far = (distances > STRAY * usual) & (usual > 0)
    if far.any() and (cloud := points()) is not None and len(cloud):
        far &= distances > STRAY * float(np.median(np.linalg.norm(cloud - middle, axis=1)))
    return far


def _float32_step(centres: Array) -> float:
    """Step between float32 numbers at the coordinates of camera centres ``[N, 3]``, as a share of their distances."""
    middle, distances = _distances_of(centres)
    usual = float(np.median(distances)) or float(distances.max())
    return float(np.spacing(np.float32(np.abs(middle).max()))) / usual if usual > 0 else 0.0


class _SurveyOutputs(DataparserOutputs):
    """A parsed capture whose transform has float64 numbers, as it leads away from survey coordinates."""

    def transform_poses_to_original_space(self, poses: Tensor, *args: Any, **options: Any) -> Tensor:
        return super().transform_poses_to_original_space(poses.double(), *args, **options)


class _PosedParser:
    """What both parsers do with poses, points and lenses, from the file's coordinates to those of the model."""

    config: Any
    offset: Array | None
    """Subtracted from coordinates of the file in float64, before anything becomes float32; None for nothing."""
    lenses: dict[Path, Lens]  # By the path of an image

    def _generate(self, method: Any, *arguments: Any, **names: Any) -> DataparserOutputs:
        """Run nerfstudio's method; in its result each camera has its own lens and the scale of the near cameras."""
        self.offset, self.lenses, self._growth = None, {}, 1.0
        utils = replaced(camera_utils, auto_orient_and_center_poses=self._oriented)
        outputs: DataparserOutputs = rebound(method, camera_utils=utils, **names)(self, *arguments)
        cameras, lenses = outputs.cameras, [self.lenses[path] for path in outputs.image_filenames]
        if lenses:
            types = torch.tensor([[TYPES[lens.kind]] for lens in lenses], dtype=cameras.camera_type.dtype)
            distortion = torch.tensor([lens.distortion for lens in lenses], dtype=torch.float32)
            # nerfstudio undistorts no lens whose distortion is zero, a fisheye lens neither; this one moves nothing.
            distortion[(types != CameraType.PERSPECTIVE.value).flatten() & (distortion == 0).all(dim=1), 0] = 1e-12
            cameras.camera_type, cameras.distortion_params = types, distortion
        if self._growth != 1.0 and self.config.auto_scale_poses:
            cameras.camera_to_worlds[:, :, 3] *= self._growth
            outputs.dataparser_scale *= self._growth
            if "points3D_xyz" in outputs.metadata:
                outputs.metadata["points3D_xyz"] = outputs.metadata["points3D_xyz"] * self._growth
        if self.offset is None:
            return outputs
        transform = outputs.dataparser_transform.double()
        transform[:, 3] -= self._transform[:, :3].double() @ torch.from_numpy(self.offset)
        return _SurveyOutputs(**{**outputs.as_dict(), "dataparser_transform": transform})

    def _shift(self, frames: list[dict[str, Any]], points: Callable[[], Array | None], where: str) -> None:
        """Make the poses of frames float64 and rigid, near the origin if float32 is too coarse where they stand.

        Survey coordinates lie millions of metres from the origin, where float32 has steps of half a metre. ``points``
        gives those of the capture ``[M, 3]`` in the coordinates of the poses.
        """
        matrices = [rigid(np.array(frame["transform_matrix"], dtype=np.float64), where) for frame in frames]
        centres = np.array([matrix[:3, 3] for matrix in matrices])
        self._robust = getattr(self.config, "robust", False)
        step = _float32_step(centres) if self._robust else 0.0
        centred = self.config.center_method != "none"
        if step > COARSE_STEP and not centred:
            farthest = np.float32(np.abs(_distances_of(centres)[0]).max())
            what = f"{where}: the cameras stand {farthest:.3g} from the origin, where float32 numbers are"
            raise DataError(f"{what} {np.spacing(farthest):.2g} apart; leave out --center-method none")
        self.offset = _distances_of(centres)[0] if step > FINE_STEP and centred else None
        self._points = points
        for frame, matrix in zip(frames, matrices, strict=True):
            if self.offset is not None:
                matrix[:3, 3] -= self.offset
            frame["transform_matrix"] = matrix

    def _oriented(self, poses: Tensor, **methods: Any) -> tuple[Tensor, Tensor]:
        """In place of nerfstudio's function that centres and orients poses."""

        def points() -> Array | None:
            cloud = self._points()
            return cloud if cloud is None or self.offset is None else cloud - self.offset

        if self.config.auto_scale_poses and (poses[:, :3, 3] == poses[0, :3, 3]).all():
            what = f"all cameras of {self.config.data} stand at one place, so nothing says how far things are"
            raise DataError(f"{what}; correct their poses, or, for a panorama, give --auto-scale-poses False")
        oriented, self._transform = camera_utils.auto_orient_and_center_poses(poses, **methods)
        far = stray_cameras(poses[:, :3, 3].double().numpy(), points) if self._robust else np.zeros(len(poses), bool)
        if far.any():
            near, self._transform = camera_utils.auto_orient_and_center_poses(poses[torch.from_numpy(~far)], **methods)
            oriented = self._transform @ poses
            # nerfstudio divides by the largest coordinate of all cameras.
            self._growth = float(oriented[:, :3, 3].abs().max() / near[:, :3, 3].abs().max())
        return oriented, self._transform


class LightNerfstudioParser(_PosedParser, Nerfstudio):
    """The ``nerfstudio-data`` parser; it takes the cloud of an old capture from COLMAP's model without a question."""

    applied_scale = 1.0  # Scale from the original coordinates of a capture to those of its file

    def _generate_dataparser_outputs(self, split: str = "train", **_: Any) -> DataparserOutputs:
        return self._generate(Nerfstudio._generate_dataparser_outputs, split, load_from_json=self._read)

    def _read(self, path: Path) -> dict[str, Any]:
        """The file as nerfstudio's method understands it: intrinsics in each frame, and lenses apart."""
        folder = path.parent
        meta = with_focal_lengths(read_json(path), folder)
        frames = meta["frames"]
        for frame in frames:
            name = self._get_fname(Path(frame["file_path"]), folder)
            if name in self.lenses:  # smaller images lie in one folder
                raise DataError(f"{path.name} has two frames with the image {name}; remove one, or name images apart")
            self.lenses[name] = lens_of(meta, frame, path.name)
            frame.update({**{key: meta[key] for key in INTRINSICS if key in meta}, **frame})
        for entries in (meta, *frames):
            for key in (*DISTORTION, "distortion_params"):
                entries.pop(key, None)
        meta = {key: value for key, value in meta.items() if key not in INTRINSICS}
        kinds = {lens.kind for lens in self.lenses.values()}
        meta["camera_model"] = kinds.pop() if len(kinds) == 1 else PERSPECTIVE

        def cloud() -> Array | None:
            name = meta.get("ply_file_path")
            if not isinstance(name, str) or not (folder / name).is_file():
                return None
            return np.asarray(read_point_cloud(folder / name, precise=True)[0].numpy())

        self._shift(frames, cloud, path.name)
        self.applied_scale = float(meta.get("applied_scale", 1.0))
        # The first versions of ns-process-data made no cloud of COLMAP's model, which they left here, and stated no
        # transform. nerfstudio would ask whether to make the cloud, and change the capture.
        old = "colmap/sparse/0"
        if "ply_file_path" not in meta and (self.config.data / old).is_dir():
            self._applied = np.array(meta.get("applied_transform", [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]), float)
            meta["ply_file_path"] = old
        return meta

    def _load_3D_points(
        self, ply_file_path: Path, transform_matrix: Tensor, scale_factor: float
    ) -> dict[str, Tensor] | None:
        if not ply_file_path.exists():
            raise DataError(f"{ply_file_path} does not exist; correct ply_file_path in transforms.json, or remove it")
        if ply_file_path.is_dir():
            if not any(ply_file_path.glob("points3D.*")):
                return None
            positions, colours = read_points(ply_file_path)
            points = torch.from_numpy(positions @ self._applied[:, :3].T + self._applied[:, 3])
            rgb = torch.from_numpy(colours)
        else:
            points, rgb = read_point_cloud(ply_file_path, precise=self.offset is not None)
        if len(points) == 0:
            return None
        if self.offset is not None:
            finite = points[torch.isfinite(points).all(dim=1)].numpy()
            rounded = len(finite) > 0 and np.array_equal(finite, finite.astype(np.float32))
            if rounded and _float32_step(finite) > COARSE_STEP:
                step = np.spacing(np.float32(np.abs(self.offset).max()))
                what = f"{ply_file_path.name} has float32 coordinates that are {step:.2g} apart"
                _log.warning(f"{what}, as it lies far from the origin; export it with double coordinates, or shifted")
            points = points.double() - torch.from_numpy(self.offset)
        points = points.float() @ transform_matrix[:3, :3].T + transform_matrix[:3, 3]
        # nerfstudio multiplies by applied_scale again, but the file's cloud is in the coordinates of its cameras.
        return {"points3D_xyz": points * (scale_factor / self.applied_scale), "points3D_rgb": rgb}


class CarefulColmapParser(_PosedParser, ColmapDataParser):
    """The ``colmap`` parser."""

    def _generate_dataparser_outputs(self, split: str = "train", **_: Any) -> DataparserOutputs:
        return self._generate(ColmapDataParser._generate_dataparser_outputs, split)

    def _get_all_images_and_cameras(self, recon_dir: Path) -> dict[str, Any]:
        images = read_images(recon_dir)
        cameras = {image.camera_id: image for image in images.values()}
        posed = {
            number: SimpleNamespace(
                name=image.name, camera_id=image.camera_id, qvec=np.array(image.pose[:4]), tvec=np.array(image.pose[4:])
            )
            for number, image in images.items()
        }

        def stated(image: ColmapImage) -> dict[str, Any]:
            camera = image.camera
            values = (*camera.intrinsics, camera.width, camera.height)
            # nerfstudio's method knows one kind of lens for all, and no k4.
            return {**dict(zip(INTRINSICS, values, strict=True)), "camera_model": PERSPECTIVE, "lens": camera.lens}

        readers = {
            f"read_{name}_{kind}": lambda _, rows=rows: rows
            for name, rows in (("cameras", cameras), ("images", posed))
            for kind in ("text", "binary")
        }
        read = rebound(
            ColmapDataParser._get_all_images_and_cameras,
            parse_colmap_camera_params=stated,
            colmap_utils=replaced(colmap_parsing_utils, **readers),
        )
        meta: dict[str, Any] = read(self, recon_dir)
        self._stated: dict[Path, Lens] = {Path(frame["file_path"]): frame.pop("lens") for frame in meta["frames"]}
        self._applied = np.array(meta.get("applied_transform", np.eye(4)[:3]), dtype=np.float64)

        def cloud() -> Array | None:
            if not any(recon_dir.glob("points3D.*")):
                return None
            return read_points(recon_dir)[0] @ self._applied[:, :3].T + self._applied[:, 3]

        self._shift(meta["frames"], cloud, recon_dir.name)
        return meta

    def _setup_downscale_factor(self, image_filenames: list[Path], *others: list[Path]) -> Any:
        paths = super()._setup_downscale_factor(image_filenames, *others)
        self.lenses = {new: self._stated[old] for new, old in zip(paths[0], image_filenames, strict=True)}
        return paths

    def _load_3D_points(self, colmap_path: Path, transform_matrix: Tensor, scale_factor: float) -> dict[str, Any]:
        positions, colours = read_points(colmap_path)
        if self.offset is not None:
            # The points are not in the coordinates of the poses yet.
            positions = positions - np.linalg.solve(self._applied[:, :3], self.offset)
        points = torch.from_numpy(positions).float()
        points = torch.cat([points, torch.ones_like(points[:, :1])], dim=1) @ transform_matrix.T * scale_factor
        return {"points3D_xyz": points, "points3D_rgb": torch.from_numpy(colours)}


def check_cameras(cameras: Cameras, names: Sequence[Path], points: Tensor | None = None) -> None:
    """Refuse or warn of poses and lenses of the cameras ``[N]`` of training images ``names``, in any units.

    ``points`` of the scene ``[M, 3]`` have the same coordinates. ``DataError`` if a projection is none of a lens, an
    axis is mirrored, or a focal length belongs to no lens.
    """
    kinds = cameras.camera_type.flatten()
    if (unknown := ~torch.isin(kinds, torch.tensor(list(TYPES.values()), dtype=kinds.dtype))).any():
        what = f"{next(compress(names, unknown)).name} is of type {CameraType(int(kinds[unknown][0])).name}"
        raise DataError(f"the camera of {what}; cut its images into perspective ones, such as cube faces")
    if (mirrored := torch.linalg.det(cameras.camera_to_worlds[:, :, :3]) < 0).any():
        which = f"{next(compress(names, mirrored)).name} mirrors an axis ({mirrored.sum()} of {len(names)} do)"
        raise DataError(f"the pose of {which}; negate one column of its rotation")
    sizes = torch.cat([cameras.width, cameras.height], dim=1).clamp_min(1)
    centre = torch.cat([cameras.cx, cameras.cy], dim=1)
    focal = cameras.fx[:, 0] / sizes[:, 0]
    # Views of 178 and of 0.06 degrees; principal points far outside, or as shares of the image.
    aside = (centre / sizes - 0.5).abs()
    strange = focal.ne(focal.clamp(0.01, 1000)) | (aside.amax(1) > 1.5) | ((centre.amax(1) <= 1) & (sizes.amin(1) > 8))
    if strange.any():
        w, fl_x, cx, cy = torch.cat([sizes[:, :1], cameras.fx, centre], dim=1)[strange][0].tolist()
        values = f"fl_x {fl_x:.3g}, cx {cx:.3g}, cy {cy:.3g} at a width of {w:.0f} px"
        raise DataError(f"{next(compress(names, strange)).name} has {values}, which no lens has; give all in pixels")
    if (aside.amin(dim=1) > 0.24).all():
        what = "cx and cy lie far from the middle of all images"
        _log.warning(f"{what}; if they are of images of another size, scale them")
    if points is not None and len(points):
        warn_of_cloud(points, cameras)
    centres = cameras.camera_to_worlds[:, :, 3]
    middle = centres.median(dim=0).values
    distances = (centres - middle).norm(dim=1)
    if len(names) > 1 and distances.max() == 0:
        _log.warning("all cameras stand at one place, so nothing says how far things are; check the poses")
        return
    usual = distances.median()
    cloud = centres[:0] if points is None else points.cpu()
    far = torch.from_numpy(stray_cameras(centres.double().numpy(), lambda: cloud.double().numpy()))
    if not far.any() and usual > 0:
        far = distances > FAR * usual
        if len(cloud):
            far &= distances > STRAY * float((cloud.double() - middle).norm(dim=1).median())
    if far.any():
        times = f"{float(distances[far][0] / usual):,.0f} times as far away as most"
        which = f"the camera of {next(compress(names, far)).name} is {times if usual > 0 else 'far from all others'}"
        _log.warning(f"{which} ({int(far.sum())} of {len(names)} are); check its pose, or remove the view")


def check_tests(train: Any, test: Any) -> None:
    """Warn of cameras and images of a test set that stand far from all others, or are those of a training set."""
    names: Sequence[Path] = test.image_filenames
    twice = copies(path for path in dict.fromkeys([*train.image_filenames, *names]) if path.is_file())
    if shared := {path for path in names if twice.get(path, path) in {*train.image_filenames}}:
        which = f"{min(shared).name} is a training image and a test view ({len(shared)} of {len(names)} test views are)"
        _log.warning(f"{which}, so figures are better than those of new views; list each image once, in one split")
    centres = torch.cat([data.cameras.camera_to_worlds[:, :, 3] for data in (train, test)]).double().cpu()
    if (far := torch.from_numpy(stray_cameras(centres.numpy()))[-len(names) :]).any():
        which = f"{next(compress(names, far)).name}, a test view, stands far from all others"
        _log.warning(f"the camera of {which} ({int(far.sum())} of {len(names)} do); check its pose, or remove the view")


def check_projection(camera: Cameras) -> None:
    """Raise ``DataError`` for rays, and for a camera of another projection, as a camera path may ask for."""
    if not isinstance(camera, Cameras):
        raise DataError("Gaussians are not seen by rays; use ns-export gaussian-splat, or sundae export RUN -o a.ply")
    if (kind := CameraType(int(camera.camera_type.flatten()[0]))) != CameraType.PERSPECTIVE:
        what = f"the camera is of type {kind.name.lower()}, and only perspective images can be drawn"
        raise DataError(f"{what}; set camera_type to perspective, for a panorama render the six faces of a cube")


@torch.no_grad()
def warn_of_cloud(points: Tensor, cameras: Cameras) -> None:
    """Warn of a cloud ``[N, 3]`` that most cameras do not see: it and the cameras are in different coordinates.

    Looks for 2,000 of the points, without distortion, with a margin of a tenth of the image's size on each side.
    """
    points = points[torch.isfinite(points).all(dim=1)].cpu()
    points = points[torch.linspace(0, max(len(points) - 1, 0), min(2000, len(points))).long()]
    empty = 0
    values = cameras.fx, cameras.fy, cameras.cx, cameras.cy, cameras.width, cameras.height
    lenses = torch.cat([value.float() for value in values], dim=-1).cpu()
    for pose, (fx, fy, cx, cy, width, height) in zip(cameras.camera_to_worlds.cpu(), lenses.tolist(), strict=True):
        x, y, z = ((points - pose[:, 3]) @ pose[:, :3]).unbind(dim=1)
        across, down = (x * fx / -z + cx) / width, (-y * fy / -z + cy) / height
        empty += not ((z < 0) & (across > -0.1) & (across < 1.1) & (down > -0.1) & (down < 1.1)).any()
    if empty > 0.5 * len(cameras):
        what = f"{empty} of {len(cameras)} views show no point of the sparse cloud: both are probably in different"
        _log.warning(f"{what} coordinates; export them together, or remove ply_file_path")


def warn_of_other_frame(run: Path, transform: Tensor, scale: float) -> None:
    """Warn if a run, by its folder, was trained in other coordinates than those of a transform ``[3, 4]`` and scale."""
    try:
        stated = read_json(run / FRAME_FILE)
        before, size = torch.tensor(stated["transform"], dtype=torch.float64), float(stated["scale"])
        same = torch.allclose(before * size, transform.double() * scale, rtol=1e-3, atol=1e-3)
    except (DataError, KeyError, TypeError, ValueError, RuntimeError):
        return
    if not same:
        what = f"{run} was trained in other coordinates: its capture has changed, or another version scaled it"
        _log.warning(f"{what}; if cameras stand far apart, resume it with --pipeline.datamanager.robust-frame False")


def camera_of(camera: Cameras, device: torch.device | str, *, pose: Tensor | None = None, downscale: int = 1) -> Camera:
    """The rasteriser's form of a nerfstudio camera of shape ``(1,)``, at a divisor of its resolution.

    A ``pose``, camera-to-world with OpenGL axes ``[..., 3, 4]``, takes the place of the camera's own; differentiable.
    """
    # nerfstudio's methods of cameras build tensors and cameras at each call; here one copy from the device does.
    values = (camera.camera_to_worlds, camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
    *flat, fx, fy, cx, cy, width, height = torch.cat([value.detach().flatten() for value in values]).tolist()
    dtype = camera.camera_to_worlds.dtype
    K = [fx / downscale, 0.0, cx / downscale, 0.0, fy / downscale, cy / downscale, 0.0, 0.0, 1.0]
    size = (int(width) // downscale, int(height) // downscale)
    if pose is None:
        # In one tensor: one copy to a GPU.
        both = torch.tensor([*world_to_camera_floats(flat), *K], dtype=dtype).to(device)
        viewmat, intrinsics = both[:16].view(4, 4), both[16:].view(3, 3)
    else:
        viewmat = world_to_camera(pose.reshape(-1, 3, 4)[0]).to(device)
        intrinsics = torch.tensor(K, dtype=dtype).to(device).view(3, 3)
    return Camera(viewmat, intrinsics, *size, (fx + fy) / 2 / downscale)
