"""Cameras of files, and virtual ones."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from colmap_models import write_model
from fields import random_field
from short_prunes import short_prunes  # noqa: F401

import sundae_ns as sn
from sundae_ns.core.errors import DataError
from sundae_ns.core.gaussians import Gaussians
from sundae_ns.scene import virtual_cameras as virtual
from sundae_ns.scene.cameras import is_frame, read_cameras
from sundae_ns.scene.prune_scene import prune_with_mask

FRAME = {"transform_matrix": [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]}
LENS = {"fl_x": 50, "fl_y": 60, "cx": 32, "cy": 24, "w": 64, "h": 48}
PATH = {
    "render_width": 64,
    "render_height": 48,
    "fps": 12,
    "camera_path": [{"camera_to_world": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 3, 0, 0, 0, 1], "fov": 90}],
}


def written(tmp_path: Path, content: Any) -> Path:
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(content))
    return path


def scene(**options: Any) -> sn.Scene:
    return sn.Scene(Gaussians(random_field(100, features=0)), **options)


def test_a_transforms_file(tmp_path: Path) -> None:
    path = written(tmp_path, {**LENS, "frames": [FRAME, {**FRAME, "fl_x": 70}]})
    first, second = sn.cameras_of(tmp_path)
    assert (first.width, first.height, first.focal) == (64, 48, 55)
    assert float(second.K[0, 0]) == 70
    torch.testing.assert_close(first.center, torch.tensor([0.0, 0, 3]))
    # The camera looks along -z, so the origin is in the middle of the image.
    seen = first.K @ first.viewmat[:3, 3]
    torch.testing.assert_close(seen[:2] / seen[2], torch.tensor([32.0, 24.0]))
    assert read_cameras(path).frames_per_second is None


def test_a_camera_path(tmp_path: Path) -> None:
    found = read_cameras(written(tmp_path, PATH))
    (camera,) = found.cameras
    assert found.frames_per_second == 12
    assert float(camera.K[1, 1]) == pytest.approx(24)
    torch.testing.assert_close(camera.center, torch.tensor([0.0, 0, 3]))


def test_a_colmap_model(tmp_path: Path) -> None:
    """Its poses are world-to-camera, and the images of a run's capture move as those of a transforms.json do."""
    write_model(tmp_path, ["a.png", "b.png"], (64, 48))
    _, camera = sn.cameras_of(tmp_path)
    assert (camera.width, camera.height, camera.focal) == (64, 48, 18)
    torch.testing.assert_close(camera.viewmat[:3, 3], torch.tensor([0.3, 0.1, 3.0]))
    turn = [[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3]]
    trained = scene(in_model_frame=True, meta={"frame": {"transform": turn, "scale": 0.5}})
    x, y, z = camera.center.tolist()
    moved = sn.cameras_of(tmp_path, trained)[1].center
    torch.testing.assert_close(moved, torch.tensor([(1 - y) / 2, (x + 2) / 2, (z + 3) / 2]))


def test_cameras_of_a_capture_move_with_its_model(tmp_path: Path) -> None:
    """As nerfstudio moves and scales them for training; those of a camera path are in the model's coordinates."""
    turn = [[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3]]
    trained = scene(in_model_frame=True, meta={"frame": {"transform": turn, "scale": 0.5}})
    path = written(tmp_path, {**LENS, "frames": [FRAME]})
    torch.testing.assert_close(sn.cameras_of(path, trained)[0].center, torch.tensor([0.5, 1.0, 3.0]))
    torch.testing.assert_close(sn.cameras_of(path, scene())[0].center, torch.tensor([0.0, 0, 3]))
    # nerfstudio's transform begins before the one that a transforms.json states as applied.
    applied = {"applied_transform": [[1.0, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 0]], "applied_scale": 2.0}
    path = written(tmp_path, {**LENS, **applied, "frames": [FRAME]})
    torch.testing.assert_close(sn.cameras_of(path, trained)[0].center, torch.tensor([0.25, 0.25, 1.5]))
    path = written(tmp_path, PATH)
    torch.testing.assert_close(sn.cameras_of(path, trained)[0].center, torch.tensor([0.0, 0, 3]))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "does not hold a JSON object"),
        ({}, "neither frames nor a camera_path"),
        ({"frames": []}, "neither frames nor a camera_path"),
        ({"frames": [FRAME]}, "fl_x"),
        ({**LENS, "frames": [{}]}, "transform_matrix"),
        ({**LENS, "frames": [7]}, "transform_matrix"),
        ({**LENS, "w": 0, "frames": [FRAME]}, "w is 0"),
        ({**PATH, "camera_path": []}, "empty camera_path"),
        ({**PATH, "camera_type": "equirectangular"}, "equirectangular"),
        ({**PATH, "camera_path": [{"camera_to_world": [1, 2]}]}, "camera_to_world"),
        ({**PATH, "camera_path": [{**PATH["camera_path"][0], "fov": 200}]}, "below 180"),  # type: ignore[index]
        ({**PATH, "fps": 0}, "fps"),
    ],
)
def test_files_without_usable_cameras_are_refused_in_one_line(content: Any, message: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=message) as caught:
        sn.cameras_of(written(tmp_path, content))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0)])
@pytest.mark.parametrize("eye", [(1.0, -2.0, 0.5), (0.0, 0.0, 4.0), (0.0, 4.0, 0.0)])
def test_a_camera_looks_at_its_target(eye: tuple[float, ...], up: tuple[float, ...]) -> None:
    camera = sn.Camera.look_at(eye, (0.0, 0.0, 0.0), up, fov=90, width=20, height=10)
    x, y, z = camera.viewmat[:3, 3].tolist()
    assert (x, y) == (pytest.approx(0, abs=1e-6), pytest.approx(0, abs=1e-6))
    assert z == pytest.approx(math.dist(eye, (0, 0, 0)))
    torch.testing.assert_close(camera.viewmat[:3, :3] @ camera.viewmat[:3, :3].T, torch.eye(3))
    assert torch.det(camera.viewmat[:3, :3]) == pytest.approx(1)
    torch.testing.assert_close(sn.Camera.from_pose(camera.pose, (5, 5, 10, 5), 20, 10).viewmat, camera.viewmat)
    assert float(camera.K[1, 1]) == pytest.approx(5)


def test_virtual_views_are_the_same_for_a_seed_and_see_the_scene() -> None:
    one, same, other = (sn.virtual_cameras(scene(), 16, seed=seed) for seed in (0, 0, 1))
    assert all(torch.equal(a.viewmat, b.viewmat) for a, b in zip(one, same, strict=True))
    assert not torch.equal(one[0].viewmat, other[0].viewmat)
    seen = [float(sn.render(scene(), camera).accumulation.max()) for camera in one]
    assert min(seen) > 0


@pytest.mark.usefixtures("short_prunes")
@pytest.mark.parametrize("factor", [1e-3, 1e6])
def test_a_scene_of_any_size_is_pruned_alike(factor: float) -> None:
    """The near plane is 0.01 world units away, which is more than the whole of a small scene."""
    moved = scene()
    moved.gaussians["means"] *= factor
    moved.gaussians["scales"] += math.log(factor)
    own, other = (prune_with_mask(each, 0.3, None, None, None, progress=False) for each in (scene(), moved))
    assert other.seen == own.seen
    assert (own.mask == other.mask).float().mean() > 0.95


@pytest.mark.parametrize("count", [5, 999])
def test_the_factor_of_a_limited_sum(count: int) -> None:
    values = torch.rand(1000, generator=torch.Generator().manual_seed(0), dtype=torch.float64).pow(9)
    factor = virtual._factor(values, count)
    assert float((factor * values).clamp(max=1).sum()) == pytest.approx(count)
    assert virtual._factor(torch.zeros(1000).double(), count).isfinite()


@pytest.mark.gpu
@pytest.mark.parametrize("evenness", [0.0, 4.0])
def test_a_gpu_judges_cameras_like_a_cpu(evenness: float) -> None:
    made, generator = scene(), torch.Generator().manual_seed(0)
    sizes, eyes = made.gaussians["scales"].mean(dim=1), ball(150, generator).double()
    targets = made.gaussians["means"][:1].double().expand(150, 3)
    on_gpu = made.to("cuda")
    found = virtual._coarseness(on_gpu, sizes.cuda(), eyes, targets, evenness)
    torch.testing.assert_close(found, virtual._coarseness(made, sizes, eyes, targets, evenness), rtol=1e-2, atol=1e-2)


def centers_of(made: sn.Scene, n: int = 32) -> torch.Tensor:
    return torch.stack([camera.center for camera in sn.virtual_cameras(made, n)])


def ball(n: int, generator: torch.Generator) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.randn(n, 3, generator=generator), dim=1)


def without_search(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sundae_ns.scene.virtual_cameras.FIRST", 1)
    monkeypatch.setattr("sundae_ns.scene.virtual_cameras.ROUNDS", 0)


def test_virtual_eyes_are_not_in_a_fog(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer are in a fog around half of a ball than of random ones; also if a few Gaussians stand for all."""
    generator = torch.Generator().manual_seed(0)
    points = ball(2000, generator)
    fog = 4 * torch.rand(1000, 3, generator=generator) - torch.tensor([0.0, 2.0, 2.0])
    made = sn.Scene.from_points(torch.cat([points, fog]), torch.rand(3000, 3, generator=generator))
    made.gaussians["opacities"][:2000], made.gaussians["opacities"][2000:] = 4.0, -1.0
    made.gaussians["scales"][:2000], made.gaussians["scales"][2000:] = math.log(0.05), math.log(0.4)

    def in_fog() -> float:
        centers = centers_of(made)
        return float(((centers[:, 0] > 0) & (centers.norm(dim=1) > 1.2)).float().mean())

    all_judge = in_fog()
    monkeypatch.setattr("sundae_ns.scene.virtual_cameras._PROBE_GAUSSIANS", 800)
    few_judge = in_fog()
    without_search(monkeypatch)
    assert max(all_judge, few_judge) < in_fog() - 0.1


def test_virtual_eyes_are_inside_of_a_room_whose_walls_are_fine_inside(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gaussians behind the walls, which no photograph saw, are coarse."""
    generator = torch.Generator().manual_seed(0)
    points = torch.cat([ball(3000, generator), 1.2 * ball(300, generator)])
    made = sn.Scene.from_points(points, torch.rand(3300, 3, generator=generator))
    made.gaussians["opacities"][:] = 6.0
    made.gaussians["scales"][:3000], made.gaussians["scales"][3000:] = math.log(0.03), math.log(0.15)
    inside = (centers_of(made).norm(dim=1) < 1).float().mean()
    assert inside > 0.9
    without_search(monkeypatch)
    assert (centers_of(made).norm(dim=1) < 1).float().mean() < inside - 0.2


def test_virtual_eyes_are_outside_of_an_object_and_look_at_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """From within, its Gaussians are large; from far away, most of an image is empty."""
    generator = torch.Generator().manual_seed(0)
    solid = ball(3000, generator) * torch.rand(3000, 1, generator=generator) ** (1 / 3)
    made = sn.Scene.from_points(solid, torch.rand(3000, 3, generator=generator))
    made.gaussians["opacities"][:], made.gaussians["scales"][:] = 2.0, math.log(0.05)
    cameras = sn.virtual_cameras(made, 32)
    centers, ahead = (
        torch.stack(found) for found in ([v.center for v in cameras], [v.viewmat[2, :3] for v in cameras])
    )
    outside = centers.norm(dim=1) > 1
    assert float(torch.linalg.cross(centers, ahead).norm(dim=1)[outside].max()) < 1  # the line of sight hits it
    assert float(((ahead * centers).sum(dim=1) < 0)[outside].float().mean()) == 1
    without_search(monkeypatch)
    assert outside.float().mean() > (centers_of(made).norm(dim=1) > 1).float().mean() + 0.2


def test_virtual_views_that_see_nothing_are_refused() -> None:
    broken = scene()
    broken.gaussians["means"][:] = torch.nan
    with pytest.raises(DataError, match="no camera sees the scene"):
        sn.virtual_cameras(broken)


def test_a_scene_that_no_view_sees_is_not_pruned() -> None:
    faint = scene()
    faint.gaussians["opacities"][:] = -20
    with pytest.raises(DataError, match="4 views see none of 100 Gaussians"):
        sn.prune(faint, keep=0.5, cameras=sn.virtual_cameras(faint, 4))


EYE = [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("frame", "valid"),
    [
        ({"transform": EYE, "scale": 2}, True),
        ({"transform": EYE[:3], "scale": 2}, True),
        (None, False),
        ({"transform": EYE}, False),
        ({"transform": EYE[:2], "scale": 1.0}, False),
        ({"transform": [*EYE[:2], [0, 0, 1]], "scale": 1.0}, False),
        ({"transform": [*EYE[:2], [0, 0, 1, "0"]], "scale": 1.0}, False),
        ({"transform": [*EYE[:2], [0, 0, 1, math.nan]], "scale": 1.0}, False),
        ({"transform": EYE, "scale": 10**400}, False),
    ],
)
def test_a_frame_is_a_transform_and_a_scale(frame: Any, valid: bool) -> None:
    assert is_frame(frame) == valid
