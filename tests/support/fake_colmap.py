"""Stands for pycolmap in tests of the stages: features and matches are names in a file, and a model a list of them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np


class FakeColmap:
    """The functions that the stages call; ``calls`` counts images and pairs that are worked on."""

    CameraMode = SimpleNamespace(PER_FOLDER="per folder")
    __spec__, __version__ = "that of a package that is installed", "4.2.1"

    def __init__(self) -> None:
        self.logging = SimpleNamespace(minloglevel=0, Level=SimpleNamespace(FATAL=SimpleNamespace(value=3)))
        self.calls: dict[str, list[str]] = {"import": [], "features": [], "pairs": [], "models": []}
        self.models = [99]
        """Numbers of images of the models that are found, by the order of names."""
        self.simple: list[int] | None = None
        """Those of simple cameras, if they are others."""
        self.blind: tuple[str, ...] = ()
        """Images that see hardly a point."""
        self.fails: str | None = None
        """Function that raises an error once."""

    def options(self) -> Any:
        return SimpleNamespace()

    ImageReaderOptions = FeatureExtractionOptions = FeatureMatchingOptions = ImportedPairingOptions = options
    IncrementalPipelineOptions = ExhaustivePairingOptions = options

    def ExhaustivePairGenerator(self, options: Any, database: Any) -> Any:  # noqa: N802
        numbers = [image.image_id for image in database.read_all_images()]
        return SimpleNamespace(all_pairs=lambda: [(b, a) for b in numbers for a in numbers if a <= b])

    def _check(self, name: str) -> None:
        if self.fails == name:
            self.fails = None
            raise RuntimeError(f"{name} ended early")

    @property
    def Database(self) -> Any:  # noqa: N802
        return SimpleNamespace(open=self.open)

    @contextmanager
    def _opened(self, path: Path) -> Iterator[Any]:
        stored = self.read(path)
        images = [SimpleNamespace(name=name, image_id=number) for number, name in enumerate(stored["images"])]
        yield SimpleNamespace(
            read_all_images=lambda: images,
            exists_keypoints=lambda number: images[number].name in stored["features"],
            num_keypoints=lambda: len(stored["features"]),
            read_all_cameras=lambda: [self._camera("OPENCV")],
            update_camera=lambda camera: self.write(path, {**stored, "kind": [camera.kind]}),
        )

    def open(self, path: Path) -> Any:
        if not path.exists():
            self.write(path, {"images": [], "features": [], "pairs": []})
            return SimpleNamespace(close=lambda: None)
        return self._opened(path)

    def read(self, path: Path) -> dict[str, list[str]]:
        return json.loads(path.read_text())

    def write(self, path: Path, stored: dict[str, list[str]]) -> None:
        path.write_text(json.dumps(stored))

    def _camera(self, kind: str) -> Any:
        size = {"width": 16, "height": 12, "mean_focal_length": lambda: 15.0}
        return SimpleNamespace(camera_id=1, has_prior_focal_length=True, kind=kind, **size)

    @property
    def Camera(self) -> Any:  # noqa: N802
        return SimpleNamespace(create_from_model_name=lambda number, kind, focal, *size: self._camera(kind))

    def import_images(self, path: Path, images: Path, mode: str, names: list[str], options: Any) -> None:
        assert options.camera_model == "OPENCV"
        assert all((images / name).is_file() for name in names)
        self.calls["import"] += names
        self._check("import")
        self.write(path, {**self.read(path), "images": names})

    def extract_features(self, path: Path, images: Path, names: list[str], *_: Any) -> None:
        self._check("features" if self.calls["features"] else "")
        self.calls["features"] += names
        stored = self.read(path)
        self.write(path, {**stored, "features": [*stored["features"], *names]})

    def match_image_pairs(self, path: Path, options: Any, listed: Any) -> None:
        self._check("pairs" if self.calls["pairs"] else "")
        stored = self.read(path)
        new = [line for line in listed.match_list_path.read_text().splitlines() if line not in stored["pairs"]]
        self.calls["pairs"] += new
        self.write(path, {**stored, "pairs": [*stored["pairs"], *new]})

    def incremental_mapping(self, path: Path, images: Path, out: Path, options: Any, **callbacks: Any) -> None:
        kind = self.read(path).get("kind", ["OPENCV"])[0]
        self.calls["models"].append(kind)
        self._check("models")
        self._write_models(path, out, self.models if kind == "OPENCV" or self.simple is None else self.simple)
        callbacks["initial_image_pair_callback"]()
        callbacks["next_image_callback"]()

    def _write_models(self, path: Path, out: Path, models: list[int]) -> None:
        names = self.read(path)["images"]
        for number, count in enumerate(models):
            (out / str(number)).mkdir()
            (out / str(number) / "images.json").write_text(json.dumps(names[:count]))
            (out / str(number) / "all.json").write_text(json.dumps(names))

    def Reconstruction(self, folder: Path) -> Any:  # noqa: N802
        placed, names = (json.loads((folder / f"{which}.json").read_text()) for which in ("images", "all"))

        def image(number: int, name: str) -> Any:
            pose = SimpleNamespace(matrix=lambda: np.column_stack([np.eye(3), [number, 0, 0]]))
            return SimpleNamespace(
                name=name,
                has_pose=name in placed,
                num_points3D=3 if name in self.blind else 99,
                frame_id=number,
                camera_id=int(name.partition("/")[0][1:]),
                cam_from_world=lambda: pose,
            )

        images = {number: image(number, name) for number, name in enumerate(names)}

        def write(to: Path) -> None:
            (to / "images.json").write_text(json.dumps([one.name for one in images.values() if one.has_pose]))

        lens = SimpleNamespace(width=16, height=12, params=np.array([15.0, 15, 8, 6, 0, 0, 0, 0]))
        point = SimpleNamespace(xyz=np.array([1.0, 2, 3]), color=np.array([10, 20, 30]))
        return SimpleNamespace(
            images=images,
            cameras=dict.fromkeys((one.camera_id for one in images.values()), lens),
            points3D={1: point},
            num_points3D=lambda: 1,
            deregister_frame=lambda number: setattr(images[number], "has_pose", False),
            write=write,
            compute_mean_reprojection_error=lambda: 0.5,
        )
