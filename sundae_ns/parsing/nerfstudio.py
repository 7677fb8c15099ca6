"""The parser of a ``transforms.json``: nerfstudio's, with what it ignores or does to clouds put right."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio
from nerfstudio.utils.io import load_from_json
from torch import Tensor

from sundae_ns.data.lenses import PERSPECTIVE, lens_of, own_intrinsics, size_of_first_image, with_focal_lengths
from sundae_ns.errors import DataError
from sundae_ns.parsing.placing import Placing, check_one_kind, rebound
from sundae_ns.parsing.points import colmap_cloud, in_model_frame, warn_of_coarse_cloud
from sundae_ns.storage.ply import read_point_cloud

OLD_MODEL = "colmap/sparse/0"
"""Where ns-process-data leaves COLMAP's model; its first versions made no cloud of it."""
OLD_TRANSFORM = [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]
"""From COLMAP's coordinates to those of the captures of these versions, which state no ``applied_transform``."""


class LightNerfstudioParser(Nerfstudio):
    """The ``nerfstudio-data`` parser without open3d, which needs system libraries of a desktop.

    It also honours the intrinsics, the lens and the distortion of each frame, leaves clouds in the scale of the
    cameras, and takes the cloud of an old capture from COLMAP's model without a question.
    """

    robust = False
    """See :class:`sundae_ns.parsing.placing.Placing`."""

    def _generate_dataparser_outputs(self, split: str = "train", **_: Any) -> DataparserOutputs:
        self.placing = Placing(self.robust)
        self.applied_scale = 1.0
        """Scale from the original coordinates of a capture to those of its file."""
        self._old_model: tuple[Path, Any] | None = None
        generate = rebound(
            Nerfstudio._generate_dataparser_outputs,
            load_from_json=self._read,
            camera_utils=self.placing.camera_utils,
        )
        outputs = generate(self, split)
        lenses = self._frame_lenses
        folder = self.config.data.parent if self.config.data.suffix == ".json" else self.config.data
        self.placing.lenses = {self._get_fname(Path(name), folder): lens for name, lens in lenses.items()}
        if self._old_model is not None:
            outputs.metadata.update(self._old_cloud(outputs, *self._old_model))
        return self.placing.finish(outputs, scaled=self.config.auto_scale_poses)

    def _read(self, path: Path) -> dict[str, Any]:
        """The file as nerfstudio's method understands it."""
        folder = path.parent
        meta: dict[str, Any] = load_from_json(path)
        if "fl_x" not in meta:
            meta = with_focal_lengths(meta, size_of_first_image(meta, folder))
        frames = meta["frames"]
        self._frame_lenses = {frame["file_path"]: lens_of(meta, frame, path.name) for frame in frames}
        check_one_kind(self._frame_lenses, path.name)
        meta = own_intrinsics(meta)
        kinds = {lens.kind for lens in self._frame_lenses.values()}
        meta["camera_model"] = kinds.pop() if len(kinds) == 1 else PERSPECTIVE

        def cloud() -> Any:
            name = meta.get("ply_file_path")
            if not isinstance(name, str) or not (folder / name).is_file():
                return None
            return read_point_cloud(folder / name, precise=True)[0].numpy()

        poses = self.placing.shift(
            [frame["transform_matrix"] for frame in frames], self.config.center_method, cloud, path.name
        )
        for frame, pose in zip(frames, poses, strict=True):
            frame["transform_matrix"] = pose
        self.applied_scale = float(meta.get("applied_scale", 1.0))
        self._take_old_model(meta)
        return meta

    def _take_old_model(self, meta: dict[str, Any]) -> None:
        """Use the cloud of COLMAP's model for a capture without one; nerfstudio would ask, and change the capture."""
        model = self.config.data / OLD_MODEL
        if not self.config.load_3D_points or "ply_file_path" in meta or not model.is_dir():
            return
        self.prompted_user, self.create_pc = True, False
        if any(model.glob("points3D.*")):
            self._old_model = model, meta.get("applied_transform", OLD_TRANSFORM)

    def _old_cloud(self, outputs: DataparserOutputs, model: Path, applied: Any) -> dict[str, Tensor]:
        points, colours = colmap_cloud(model)
        applied = torch.tensor(applied, dtype=torch.float64)
        points = points @ applied[:, :3].T + applied[:, 3]
        transform = self.placing.transform
        scale = outputs.dataparser_scale / self.applied_scale
        return {"points3D_xyz": in_model_frame(points, self.placing.offset, transform, scale), "points3D_rgb": colours}

    def _load_3D_points(
        self, ply_file_path: Path, transform_matrix: Tensor, scale_factor: float
    ) -> dict[str, Tensor] | None:
        if not ply_file_path.exists():
            raise DataError(f"{ply_file_path} does not exist; mend ply_file_path in transforms.json, or remove it")
        far = self.placing.offset is not None
        points, rgb = read_point_cloud(ply_file_path, precise=far)
        if len(points) == 0:
            return None
        if far:
            warn_of_coarse_cloud(points, self.placing.offset, ply_file_path.name)
        # nerfstudio multiplies by applied_scale again, but the file's cloud is in the coordinates of its cameras.
        scale = scale_factor / self.applied_scale
        return {
            "points3D_xyz": in_model_frame(points, self.placing.offset, transform_matrix, scale),
            "points3D_rgb": rgb,
        }


class RobustNerfstudioParser(LightNerfstudioParser):
    """The parser that centres and scales by the cameras that stand near each other."""

    robust = True
