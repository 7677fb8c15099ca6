"""A reconstruction as a capture: nerfstudio's parser and our cameras see what COLMAP sees."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sundae_ns.api.views import views_of
from sundae_ns.data.capture import check_transforms
from sundae_ns.errors import DataError
from sundae_ns.poses import Placed, placed_in
from sundae_ns.poses.capture import APPLIED, transforms_of

PARAMETERS = [50.0, 60.0, 20.0, 15.0, 0.01, -0.02, 0.003, 0.004]


def image(name: str, seed: int, *, camera: int = 1, posed: bool = True) -> Any:
    generator = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=seed).as_matrix()
    matrix = np.column_stack([rotation, generator.normal(size=3)])
    return SimpleNamespace(
        name=name, camera_id=camera, has_pose=posed, cam_from_world=lambda: SimpleNamespace(matrix=lambda: matrix)
    )


def camera(width: int = 40, factor: float = 1.0) -> Any:
    return SimpleNamespace(width=width, height=30, params=np.array(PARAMETERS) * factor)


def model(cameras: int = 1) -> Any:
    images = [image(f"c{1 + i % cameras}/frame_{5 - i:05d}.jpg", i, camera=1 + i % cameras) for i in range(4)]
    images.append(image("c1/frame_00009.jpg", 9, posed=False))
    return SimpleNamespace(
        images=dict(enumerate(images)), cameras={1 + i: camera(40 + i, 1 + 0.1 * i) for i in range(cameras)}
    )


def sources(of: Any) -> dict[str, str]:
    return {one.name: f"IMG {one.name[-9:-4]}.HEIC" for one in of.images.values()}


def test_our_cameras_see_what_colmap_sees(tmp_path: Path) -> None:
    made = model()
    meta = transforms_of(made, sources(made))
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    check_transforms(tmp_path / "transforms.json")
    points = np.random.default_rng(0).normal(size=(10, 3))
    moved = torch.from_numpy(points @ APPLIED[:, :3].T)
    placed = sorted((one for one in made.images.values() if one.has_pose), key=lambda one: one.name)
    for view, seen in zip(views_of(tmp_path), placed, strict=True):
        at = points @ seen.cam_from_world().matrix()[:, :3].T + seen.cam_from_world().matrix()[:, 3]
        viewmat = view.viewmat.double()
        ours = moved @ viewmat[:3, :3].T + viewmat[:3, 3]
        np.testing.assert_allclose(ours.numpy(), at, atol=1e-5)
        assert (view.width, view.height) == (40, 30)
        assert float(view.K[0, 0]) == PARAMETERS[0]
        assert float(view.K[1, 2]) == PARAMETERS[3]


def test_frames_name_their_photos_in_order() -> None:
    made = model()
    meta = transforms_of(made, sources(made))
    assert [frame["file_path"] for frame in meta["frames"]] == [f"images/frame_{i:05d}.jpg" for i in (2, 3, 4, 5)]
    assert meta["frames"][0]["original"] == "IMG 00002.HEIC"
    assert meta["left_out"] == ["IMG 00009.HEIC"]
    assert meta["k1"] == PARAMETERS[4]
    assert "fl_x" not in meta["frames"][0]


def test_each_frame_has_the_lens_of_its_camera(tmp_path: Path) -> None:
    made = model(2)
    meta = transforms_of(made, sources(made))
    assert "fl_x" not in meta
    assert [frame["w"] for frame in meta["frames"]] == [41, 40, 41, 40]
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    check_transforms(tmp_path / "transforms.json")
    assert [view.width for view in views_of(tmp_path)] == [41, 40, 41, 40]


def test_a_simple_camera_is_a_special_case() -> None:
    made = model()
    made.cameras[1].params = np.array([50.0, 20.0, 15.0, 0.01])
    meta = transforms_of(made, sources(made))
    assert [meta[name] for name in ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1")] == [50, 50, 20, 15, 0.01, 0, 0]


def test_photos_of_a_capture(tmp_path: Path) -> None:
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"frames": [{"original": "b"}, {"file_path": "images/c"}], "left_out": ["a"]}))
    assert placed_in(tmp_path) == Placed(("b", "images/c"), ("a",))
    for text in ('{"frames": 3}', '{"frames": [], "left_out": 2}', '{"frames": [{}, {}', "[]"):
        path.write_text(text)
        with pytest.raises(DataError):
            placed_in(tmp_path)


@pytest.mark.parametrize(
    ("placed", "left_out", "enough", "again"),
    [
        ("abcdef", "", True, "add sharp photos"),
        ("abcf", "de", True, "the way from c to d again"),
        ("efgh", "abcd", True, "the way from e to d again"),
        ("ab", "cde", False, "the way from b to c again"),
        ("ab", "", False, "add sharp photos"),
        ("abc", "defgh", False, "the way from c to d again"),
    ],
)
def test_what_to_photograph_again(placed: str, left_out: str, enough: bool, again: str) -> None:
    found = Placed(tuple(placed), tuple(left_out))
    assert found.total == len(placed + left_out)
    assert found.enough == enough
    assert again in found.again
