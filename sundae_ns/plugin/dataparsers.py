"""nerfstudio's parsers of a ``transforms.json`` and of a COLMAP model, with their wrong steps replaced.

They honour the lens of each camera, more of COLMAP's lenses and survey coordinates, leave clouds in the scale of the
cameras, ask no questions and need no open3d, which needs system libraries of a desktop.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig, DataparserOutputs
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParser, ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio, NerfstudioDataParserConfig
from nerfstudio.data.utils import colmap_parsing_utils
from nerfstudio.utils.io import load_from_json
from torch import Tensor

from sundae_ns.core.errors import DataError
from sundae_ns.data.capture import beside, check_transforms
from sundae_ns.data.colmap import ColmapImage, check_colmap, read_images, read_points
from sundae_ns.data.layouts import no_model, no_transforms
from sundae_ns.data.lenses import DISTORTION, INTRINSICS, PERSPECTIVE, Lens, lens_of, with_focal_lengths
from sundae_ns.io.ply import read_point_cloud
from sundae_ns.plugin.placing import COARSE_STEP, Array, Placing, float32_step, rebound, replaced
from sundae_ns.train.progress import warn


def check_capture(parser: DataParserConfig, data: Path, splits: Sequence[str], *, images: bool = True) -> None:
    """Check a capture in nerfstudio's or COLMAP's layout before its parser reads it.

    Args:
        parser: configuration of the parser; captures of other parsers are not checked.
        data: the capture: a folder, or a ``transforms.json``.
        splits: splits that will be read.
        images: whether the images will be needed; a viewer needs the cameras only.

    Raises:
        DataError: the first thing that cannot be used, and where it stands.
    """
    if not data.exists():
        raise DataError(
            f"{data} does not exist; give the folder of the capture with --data, or, for a command of nerfstudio that "
            "has no --data, correct data in the run's config.yml"
        )
    if isinstance(parser, ColmapDataParserConfig):
        model = data / parser.colmap_path
        if not model.is_dir():
            raise no_model(data, parser.colmap_path)
        if parser.load_3D_points and not any(model.glob("points3D.*")):
            parser.load_3D_points = False  # the model then warns, and starts from random points
        check_colmap(model, data / parser.images_path if images else None, points=parser.load_3D_points)
    elif isinstance(parser, NerfstudioDataParserConfig):
        path = data if data.suffix == ".json" else data / "transforms.json"
        if not path.is_file():
            raise no_transforms(data)
        frames = check_transforms(path, splits=splits)["frames"]
        first = path.parent / frames[0]["file_path"]  # nerfstudio looks at its size
        if images and parser.downscale_factor in (None, 1) and not first.exists():
            raise DataError(f"{first} does not exist{beside(first)}; correct file_path in {path.name}")


def set_parser(config: DataParserConfig, robust: bool) -> None:
    """Let our parser read a capture in place of nerfstudio's; other parsers stay.

    Args:
        config: of the parser, changed in place.
        robust: see :class:`sundae_ns.plugin.placing.Placing`.
    """
    target: Any = config._target
    config._target = {Nerfstudio: LightNerfstudioParser, ColmapDataParser: CarefulColmapParser}.get(target, target)
    config.robust = robust  # type: ignore[attr-defined]


class LightNerfstudioParser(Nerfstudio):
    """The ``nerfstudio-data`` parser; it takes the cloud of an old capture from COLMAP's model without a question."""

    def _generate_dataparser_outputs(self, split: str = "train", **_: Any) -> DataparserOutputs:
        self.placing = Placing(getattr(self.config, "robust", False))
        self.applied_scale = 1.0  # Scale from the original coordinates of a capture to those of its file
        generate = rebound(
            Nerfstudio._generate_dataparser_outputs, load_from_json=self._read, camera_utils=self.placing.camera_utils
        )
        outputs = generate(self, split)
        return self.placing.finish(outputs, scaled=self.config.auto_scale_poses)

    def _read(self, path: Path) -> dict[str, Any]:
        """The file as nerfstudio's method understands it: intrinsics in each frame, and lenses apart."""
        folder = path.parent
        meta = with_focal_lengths(load_from_json(path), folder)
        frames = meta["frames"]
        for frame in frames:
            name = self._get_fname(Path(frame["file_path"]), folder)
            self.placing.lenses[name] = lens_of(meta, frame, path.name)
            frame.update({**{key: meta[key] for key in INTRINSICS if key in meta}, **frame})
        for entries in (meta, *frames):
            for key in (*DISTORTION, "distortion_params"):
                entries.pop(key, None)
        for key in INTRINSICS:
            meta.pop(key, None)
        kinds = {lens.kind for lens in self.placing.lenses.values()}
        meta["camera_model"] = kinds.pop() if len(kinds) == 1 else PERSPECTIVE

        def cloud() -> Array | None:
            name = meta.get("ply_file_path")
            if not isinstance(name, str) or not (folder / name).is_file():
                return None
            return np.asarray(read_point_cloud(folder / name, precise=True)[0].numpy())

        self.placing.shift(frames, self.config.center_method, cloud, path.name)
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
        offset = self.placing.offset
        if ply_file_path.is_dir():
            if not any(ply_file_path.glob("points3D.*")):
                return None
            positions, colours = read_points(ply_file_path)
            points = torch.from_numpy(positions @ self._applied[:, :3].T + self._applied[:, 3])
            rgb = torch.from_numpy(colours)
        else:
            points, rgb = read_point_cloud(ply_file_path, precise=offset is not None)
        if len(points) == 0:
            return None
        if offset is not None:
            finite = points[torch.isfinite(points).all(dim=1)].numpy()
            rounded = len(finite) > 0 and np.array_equal(finite, finite.astype(np.float32))
            if rounded and float32_step(finite) > COARSE_STEP:
                step = np.spacing(np.float32(np.abs(offset).max()))
                warn(
                    f"{ply_file_path.name} has float32 coordinates that are {step:.2g} apart, as it lies far from the "
                    "origin; export it with double coordinates, or shifted"
                )
        # nerfstudio multiplies by applied_scale again, but the file's cloud is in the coordinates of its cameras.
        scale = scale_factor / self.applied_scale
        return {
            "points3D_xyz": self.placing.points_in_model(points, transform_matrix, scale),
            "points3D_rgb": rgb,
        }


class CarefulColmapParser(ColmapDataParser):
    """The ``colmap`` parser."""

    def _generate_dataparser_outputs(self, split: str = "train", **options: Any) -> DataparserOutputs:
        self.placing = Placing(getattr(self.config, "robust", False))
        generate = rebound(ColmapDataParser._generate_dataparser_outputs, camera_utils=self.placing.camera_utils)
        outputs = generate(self, split, **options)
        return self.placing.finish(outputs, scaled=self.config.auto_scale_poses)

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
        self._lenses: dict[Path, Lens] = {Path(frame["file_path"]): frame.pop("lens") for frame in meta["frames"]}
        self._applied = np.array(meta.get("applied_transform", np.eye(4)[:3]), dtype=np.float64)

        def cloud() -> Array | None:
            if not any(recon_dir.glob("points3D.*")):
                return None
            return read_points(recon_dir)[0] @ self._applied[:, :3].T + self._applied[:, 3]

        self.placing.shift(meta["frames"], self.config.center_method, cloud, recon_dir.name)
        return meta

    def _setup_downscale_factor(self, image_filenames: list[Path], *others: list[Path]) -> Any:
        paths = super()._setup_downscale_factor(image_filenames, *others)
        self.placing.lenses = {new: self._lenses[old] for new, old in zip(paths[0], image_filenames, strict=True)}
        return paths

    def _load_3D_points(self, colmap_path: Path, transform_matrix: Tensor, scale_factor: float) -> dict[str, Any]:
        positions, colours = read_points(colmap_path)
        if self.placing.offset is not None:
            # The points are not in the coordinates of the poses yet.
            positions = positions - np.linalg.solve(self._applied[:, :3], self.placing.offset)
        points = torch.from_numpy(positions).float()
        points = torch.cat([points, torch.ones_like(points[:, :1])], dim=1) @ transform_matrix.T * scale_factor
        return {"points3D_xyz": points, "points3D_rgb": torch.from_numpy(colours)}
