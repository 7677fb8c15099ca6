"""The parser of a COLMAP model: nerfstudio's, with more of COLMAP's lenses, several kinds of them, and far poses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParser
from nerfstudio.data.utils import colmap_parsing_utils
from torch import Tensor

from sundae_ns.data.colmap import StatedCamera, cameras_of
from sundae_ns.data.lenses import PERSPECTIVE, Lens
from sundae_ns.parsing.placing import Placing, rebound, replaced
from sundae_ns.parsing.points import colmap_cloud, colmap_points


class CarefulColmapParser(ColmapDataParser):
    """The ``colmap`` parser that keeps the lens of each camera and shifts survey coordinates in float64."""

    robust = False
    """See :class:`sundae_ns.parsing.placing.Placing`."""

    def _generate_dataparser_outputs(self, split: str = "train", **options: Any) -> DataparserOutputs:
        self.placing = Placing(self.robust)
        generate = rebound(ColmapDataParser._generate_dataparser_outputs, camera_utils=self.placing.camera_utils)
        outputs = generate(self, split, **options)
        return self.placing.finish(outputs, scaled=self.config.auto_scale_poses)

    def _get_all_images_and_cameras(self, recon_dir: Path) -> dict[str, Any]:
        cameras = cameras_of(recon_dir)
        read = rebound(
            ColmapDataParser._get_all_images_and_cameras,
            parse_colmap_camera_params=_entries,
            colmap_utils=replaced(
                colmap_parsing_utils, read_cameras_text=lambda _: cameras, read_cameras_binary=lambda _: cameras
            ),
        )
        meta: dict[str, Any] = read(self, recon_dir)
        frames = meta["frames"]
        # nerfstudio's method knows one kind of lens for all, and no k4.
        self._lenses: dict[Path, Lens] = {Path(frame["file_path"]): frame.pop("lens") for frame in frames}
        applied = np.array(meta.get("applied_transform", np.eye(4)[:3]), dtype=np.float64)
        self._applied = applied

        def cloud() -> Any:
            if not any((recon_dir / f"points3D.{kind}").exists() for kind in ("bin", "txt")):
                return None
            return colmap_cloud(recon_dir)[0].numpy() @ applied[:, :3].T + applied[:, 3]

        poses = self.placing.shift(
            [frame["transform_matrix"] for frame in frames], self.config.center_method, cloud, recon_dir.name
        )
        for frame, pose in zip(frames, poses, strict=True):
            frame["transform_matrix"] = pose
        return meta

    def _setup_downscale_factor(
        self, image_filenames: list[Path], mask_filenames: list[Path], depth_filenames: list[Path]
    ) -> Any:
        found = super()._setup_downscale_factor(image_filenames, mask_filenames, depth_filenames)
        lenses = [self._lenses[path] for path in image_filenames]
        self.placing.lenses = dict(zip(found[0], lenses, strict=True))
        return found

    def _load_3D_points(self, colmap_path: Path, transform_matrix: Tensor, scale_factor: float) -> dict[str, Any]:
        load, offset = ColmapDataParser._load_3D_points, self.placing.offset
        if offset is None:
            return dict(load(self, colmap_path, transform_matrix, scale_factor))
        # The points are not in the coordinates of the poses yet.
        away = np.linalg.solve(self._applied[:, :3], offset)
        points = {key: point._replace(xyz=point.xyz - away) for key, point in colmap_points(colmap_path).items()}
        shifted = replaced(
            colmap_parsing_utils, read_points3D_binary=lambda _: points, read_points3D_text=lambda _: points
        )
        return dict(rebound(load, colmap_utils=shifted)(self, colmap_path, transform_matrix, scale_factor))


class RobustColmapParser(CarefulColmapParser):
    """The parser that centres and scales by the cameras that stand near each other."""

    robust = True


def _entries(camera: StatedCamera) -> dict[str, Any]:
    """A camera as entries of a frame, without its distortion."""
    intrinsics = dict(zip(("fl_x", "fl_y", "cx", "cy"), camera.intrinsics, strict=True))
    return {**intrinsics, "w": camera.width, "h": camera.height, "camera_model": PERSPECTIVE, "lens": camera.lens}
