"""Cameras: of nerfstudio, of files, virtual ones; windows of their images, start view and up axis of a scene."""

import base64
import dataclasses
import json
import math
import re

import numpy as np
import pytest
import torch
from colmap_models import write_model
from command_line import run
from fields import random_field
from hypothesis import given
from hypothesis import strategies as st
from limits import refused
from nerfstudio.cameras.cameras import Cameras

import sundae_ns as sn
from sundae_ns.core.covariance import rotation_matrices
from sundae_ns.core.errors import ConfigError, DataError
from sundae_ns.core.gaussians import Gaussians
from sundae_ns.io.pack import container
from sundae_ns.plugin.dataparsers import camera_of
from sundae_ns.plugin.distill import distill
from sundae_ns.scene import virtual_cameras as virtual
from sundae_ns.scene.cameras import is_frame, opening, read_cameras, with_start
from sundae_ns.scene.packing import start_of, stated_start
from sundae_ns.scene.prune_scene import prune_with_mask
from sundae_ns.scene.virtual_cameras import front_views
from sundae_ns.train.step import StepResolution

FRAME = {"transform_matrix": [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]}
LENS = {"fl_x": 50, "fl_y": 60, "cx": 32, "cy": 24, "w": 64, "h": 48}
CAPTURE = {**LENS, "frames": [FRAME]}
KEY = {"camera_to_world": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 3, 0, 0, 0, 1], "fov": 90}
PATH = {"render_width": 64, "render_height": 48, "fps": 12, "camera_path": [KEY]}


def written(tmp_path, content):
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(content))
    return path


def scene(**options):
    return sn.Scene(Gaussians(random_field(100, features=0)), **options)


def test_a_transforms_file_and_a_camera_path(tmp_path):
    path = written(tmp_path, {**LENS, "frames": [FRAME, {**FRAME, "fl_x": 70}]})
    first, second = sn.cameras_of(tmp_path)
    assert (first.width, first.height, first.focal) == (64, 48, 55)
    assert float(second.K[0, 0]) == 70
    torch.testing.assert_close(first.center, torch.tensor([0.0, 0, 3]))
    # The camera looks along -z, so the origin is in the middle of the image.
    seen = first.K @ first.viewmat[:3, 3]
    torch.testing.assert_close(seen[:2] / seen[2], torch.tensor([32.0, 24.0]))
    assert read_cameras(path)[1] is None
    (camera,), speed = read_cameras(written(tmp_path, PATH))
    assert speed == 12
    assert float(camera.K[1, 1]) == pytest.approx(24)


TURN = [[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3]]


def trained():
    """A scene in the coordinates of a run."""
    return scene(in_model_frame=True, meta={"frame": {"transform": TURN, "scale": 0.5}})


def test_a_colmap_model(tmp_path):
    """Its poses are world-to-camera, and the images of a run's capture move as those of a transforms.json do."""
    write_model(tmp_path, ["a.png", "b.png"], (64, 48))
    _, camera = sn.cameras_of(tmp_path)
    assert (camera.width, camera.height, camera.focal) == (64, 48, 18)
    torch.testing.assert_close(camera.viewmat[:3, 3], torch.tensor([0.3, 0.1, 3.0]))
    x, y, z = camera.center.tolist()
    moved = sn.cameras_of(tmp_path, trained())[1].center
    torch.testing.assert_close(moved, torch.tensor([(1 - y) / 2, (x + 2) / 2, (z + 3) / 2]))


def test_cameras_of_a_capture_move_with_its_model(tmp_path):
    """As nerfstudio moves and scales them for training; those of a camera path are in the model's coordinates."""
    # nerfstudio's transform begins before the one that a transforms.json states as applied.
    applied = {"applied_transform": [[1.0, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 0]], "applied_scale": 2.0}
    for content, made, center in (
        (CAPTURE, trained(), [0.5, 1.0, 3.0]),
        (CAPTURE, scene(), [0.0, 0, 3]),
        ({**CAPTURE, **applied}, trained(), [0.25, 0.25, 1.5]),
        (PATH, scene(in_model_frame=True), [0.0, 0, 3]),
    ):
        torch.testing.assert_close(sn.cameras_of(written(tmp_path, content), made)[0].center, torch.tensor(center))
    refused(lambda path: sn.cameras_of(path, scene(in_model_frame=True)), written(tmp_path, CAPTURE), "; give its run")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "does not hold a JSON object"),
        ({}, "neither frames nor a camera_path"),
        ({"frames": [FRAME]}, "fl_x"),
        ({**LENS, "frames": [{}]}, "transform_matrix"),
        ({**LENS, "w": 0, "frames": [FRAME]}, "w is 0"),
        ({**PATH, "camera_path": []}, "neither frames nor a camera_path"),
        ({**PATH, "camera_type": "equirectangular"}, "equirectangular"),
        ({**PATH, "camera_path": [{"camera_to_world": [1, 2]}]}, "camera_to_world"),
        ({**PATH, "camera_path": [{"camera_to_world": np.diag([1, 2, 3, 1]).tolist()}]}, "frame 0: .* not a rotation"),
        ({**PATH, "camera_path": [{**KEY, "fov": 200}]}, "below 180"),
        ({**PATH, "fps": 0}, "fps"),
    ],
)
def test_files_without_usable_cameras_are_refused_in_one_line(content, message, tmp_path):
    with pytest.raises(DataError, match=f"^.*{message}.*$"):
        sn.cameras_of(written(tmp_path, content))


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0)])
@pytest.mark.parametrize("eye", [(1.0, -2.0, 0.5), (0.0, 0.0, 4.0), (0.0, 4.0, 0.0)])
def test_a_camera_looks_at_its_target(eye, up):
    camera = sn.Camera.look_at(eye, (0.0, 0.0, 0.0), up, fov=90, width=20, height=10)
    turn, place = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    torch.testing.assert_close(place, torch.tensor([0.0, 0.0, math.dist(eye, (0, 0, 0))]))
    torch.testing.assert_close(turn @ turn.T, torch.eye(3))
    assert torch.det(turn) == pytest.approx(1)
    torch.testing.assert_close(sn.Camera.from_pose(camera.pose, (5, 5, 10, 5), 20, 10).viewmat, camera.viewmat)
    assert float(camera.K[1, 1]) == pytest.approx(5)


def test_virtual_views_are_the_same_for_a_seed_and_see_the_scene():
    one, same, other = (sn.virtual_cameras(scene(), 16, seed=seed) for seed in (0, 0, 1))
    assert all(torch.equal(a.viewmat, b.viewmat) for a, b in zip(one, same, strict=True))
    assert not torch.equal(one[0].viewmat, other[0].viewmat)
    assert min([float(sn.render(scene(), camera).accumulation.max()) for camera in one]) > 0


@pytest.mark.usefixtures("short_prunes")
@pytest.mark.parametrize("factor", [1e-3, 1e6])
def test_a_scene_of_any_size_is_pruned_alike(factor):
    """The near plane is 0.01 world units away, which is more than the whole of a small scene."""
    own, other = (prune_with_mask(each, 0.3) for each in (scene(), sn.transform(scene(), scale=factor)))
    assert other.seen_share == own.seen_share
    assert (own.mask == other.mask).float().mean() > 0.95


@pytest.mark.parametrize("count", [5, 999])
def test_the_factor_of_a_limited_sum(count):
    values = torch.rand(1000, generator=torch.Generator().manual_seed(0), dtype=torch.float64).pow(9)
    assert float((virtual._factor(values, count) * values).clamp(max=1).sum()) == pytest.approx(count)
    assert virtual._factor(torch.zeros(1000).double(), count).isfinite()


@pytest.mark.gpu
@pytest.mark.parametrize("rule", ["mean", "even", "cover"])
def test_a_gpu_judges_cameras_like_a_cpu(rule):
    made = scene()
    sizes, eyes = made.gaussians["scales"].mean(dim=1), ball(150).double()
    targets = made.gaussians["means"][:1].double().expand(150, 3)
    found = virtual._coarseness(made.to("cuda"), sizes.cuda(), eyes, targets, rule)
    torch.testing.assert_close(found, virtual._coarseness(made, sizes, eyes, targets, rule), rtol=1e-2, atol=1e-2)


GENERATOR = torch.Generator()


def ball(n):
    return torch.nn.functional.normalize(torch.randn(n, 3, generator=GENERATOR), dim=1)


def cloud(*parts):
    """A scene of parts: points, their opacity before activation, and their size."""
    points, logits, sizes = zip(*parts, strict=True)
    counts, points = torch.tensor([len(part) for part in points]), torch.cat(points)
    made = sn.Scene.from_points(points, points.sigmoid())
    made.gaussians["opacities"][:] = torch.tensor(logits).repeat_interleave(counts)[:, None]
    made.gaussians["scales"][:] = torch.tensor(sizes).log().repeat_interleave(counts)[:, None]
    return made


def share(cameras, found):
    """Share of cameras whose centres fulfil a condition."""
    return float(found(torch.stack([camera.center for camera in cameras])).float().mean())


def outside(centers):
    return centers.norm(dim=1) > 1


@pytest.fixture
def found_and_drawn(monkeypatch):
    """Virtual cameras of a scene, and the first ones that are drawn in place of them."""
    GENERATOR.manual_seed(0)

    def both(made):
        found = sn.virtual_cameras(made, 32)
        monkeypatch.setattr(virtual, "FIRST", 1)
        monkeypatch.setattr(virtual, "ROUNDS", 0)
        return found, sn.virtual_cameras(made, 32)

    return both


@pytest.mark.parametrize("judges", [virtual._PROBE_GAUSSIANS, 800])
def test_virtual_eyes_are_not_in_a_fog(monkeypatch, found_and_drawn, judges):
    """Fewer are in a fog around half of a ball than of random ones; also if a few Gaussians stand for all."""
    monkeypatch.setattr(virtual, "_PROBE_GAUSSIANS", judges)
    fog = torch.tensor([4.0, 4, 4]) * torch.rand(1000, 3, generator=GENERATOR) - torch.tensor([0.0, 2.0, 2.0])
    found, drawn = found_and_drawn(cloud((ball(2000), 4.0, 0.05), (fog, -1.0, 0.4)))

    def in_fog(centers):
        return (centers[:, 0] > 0) & (centers.norm(dim=1) > 1.2)

    assert share(found, in_fog) < share(drawn, in_fog) - 0.1


def test_virtual_eyes_are_inside_of_a_room_whose_walls_are_fine_inside(found_and_drawn):
    """Gaussians behind the walls, which no photograph saw, are coarse."""
    found, drawn = found_and_drawn(cloud((ball(3000), 6.0, 0.03), (1.2 * ball(300), 6.0, 0.15)))
    assert share(found, outside) < 0.1
    assert share(found, outside) < share(drawn, outside) - 0.2


def test_virtual_eyes_are_outside_of_an_object_and_look_at_it(found_and_drawn):
    """From within, its Gaussians are large; from far away, most of an image is empty."""
    points = ball(3000) * torch.rand(3000, 1, generator=GENERATOR) ** (1 / 3)
    found, drawn = found_and_drawn(cloud((points, 2.0, 0.05)))
    for camera in found:
        center, ahead = camera.center, camera.viewmat[2, :3]
        if center.norm() > 1:
            assert torch.linalg.cross(center, ahead).norm() < 1, "the line of sight hits it"
            assert ahead @ center < 0
    assert share(found, outside) > share(drawn, outside) + 0.2


def test_a_scene_that_no_view_sees_is_refused():
    broken, faint = scene(), scene()
    broken.gaussians["means"][:] = torch.nan
    with pytest.raises(DataError, match="no camera sees the scene"):
        sn.virtual_cameras(broken)
    faint.gaussians["opacities"][:] = -20
    with pytest.raises(DataError, match="4 views see none of 100 Gaussians"):
        sn.prune(faint, keep=0.5, cameras=sn.virtual_cameras(faint, 4))


EYE = [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


def test_a_frame_is_a_transform_and_a_scale():
    for rows in (EYE, EYE[:3]):
        assert is_frame({"transform": rows, "scale": 2})
    for last in ([], [[0, 0, 1]], [[0, 0, 1, "0"]], [[0, 0, 1, math.nan]]):
        assert not is_frame({"transform": [*EYE[:2], *last], "scale": 1.0})
    for frame in (None, {"transform": EYE}, {"transform": EYE, "scale": 10**400}):
        assert not is_frame(frame)


@torch.no_grad()
def test_a_primitive_lands_where_the_pinhole_says(build, camera):
    model = build(seed_points=(torch.tensor([[0.55, 0.35, 0.0]]), torch.zeros(1, 3, dtype=torch.uint8))).eval()
    model.gauss_params["scales"].data.fill_(-5)
    row, column = divmod(int(model.get_outputs_for_camera(camera())["accumulation"][..., 0].argmax()), 40)
    # In front of the camera by 3; x to the right, y up, pixel centres at one half.
    assert (column, row) == (int(20 + 30 * 0.55 / 3), int(16 - 30 * 0.25 / 3))


@pytest.mark.parametrize(("step", "mirrored"), [(10, True), (11, False)])
def test_a_window_is_a_part_of_the_whole_picture(build, perturb, camera, batch, monkeypatch, step, mirrored):
    """Pictures, truth and mask of a window are what the whole picture shows there, or its mirror image."""
    whole, cut = (perturb(build(head={"max_train_pixels": limit}, background_color="black")) for limit in (0, 600))
    with torch.no_grad():
        # Rasterisers clamp how they linearise large Gaussians far outside of the picture, and a window is a picture.
        whole.gauss_params["scales"] -= 2
    cut.load_state_dict(whole.state_dict())
    masked = {**batch(), "mask": torch.rand(32, 40, 1, generator=torch.Generator().manual_seed(4)) > 0.5}
    for model in (whole, cut):
        model.train()
        model.step = step
    monkeypatch.setattr(whole, "resolution", lambda step: StepResolution(step, 1, 0))
    outputs = {model: model.get_outputs(camera()) for model in (whole, cut)}
    crop = outputs[cut]["window"]
    assert outputs[whole]["window"] is None
    assert crop.width * crop.height <= 600
    assert crop.mirrored == mirrored

    def part(image):
        seen = image[crop.top : crop.top + crop.height, crop.left : crop.left + crop.width]
        return seen.flip(1) if mirrored else seen

    for name in ("base_rgb", "accumulation"):
        torch.testing.assert_close(outputs[cut][name], part(outputs[whole][name]), atol=1e-5, rtol=0)
    truth = part(whole.truth(masked, outputs[whole]))
    assert torch.equal(cut.truth(masked, outputs[cut]), truth)
    losses = cut.get_loss_dict(outputs[cut], masked, {})
    expected = ((outputs[cut]["base_rgb"] - truth).abs() * part(masked["mask"])).mean()
    torch.testing.assert_close(losses["base_loss"], cut.config.base_loss_weight * expected)


def test_windows_wait_for_the_head_and_for_densification(build, perturb, camera):
    model = build(head={"max_train_pixels": 600})
    assert not model.state.head_enabled
    assert model.resolution(0) == StepResolution(0, 1, 0)
    perturb(model)
    assert model.resolution(0) == StepResolution(0, 1, 600, mirror=True)
    assert model.eval().get_outputs(camera())["rgb"].shape == (32, 40, 3)  # what is shown is whole
    densifying = {"mode": "continuous", "start": 5, "stop": 50}
    early = perturb(build(head={"max_train_pixels": 600, "start_at": 0}, pruning=densifying))
    assert early.state.head_enabled
    assert early.resolution(0) == StepResolution(0, 1, 0)  # densification takes its statistics from whole pictures
    assert not perturb(build(head={"mode": "features"})).resolution(0).mirror


def made(seed):
    generator = torch.Generator().manual_seed(seed)
    pose = [rotation_matrices(torch.randn(1, 4, generator=generator)), 10 * torch.randn(1, 3, 1, generator=generator)]
    fx, fy = 50 + 100 * torch.rand(2, 1, 1, generator=generator)
    width, height = torch.randint(1, 5000, (2, 1, 1), generator=generator)
    return Cameras(torch.cat(pose, dim=2), fx, fy, width / 2 + 3, height / 2 - 5, width=width, height=height)


@given(seed=st.integers(0, 10**6), downscale=st.integers(1, 4))
def test_a_view_is_what_the_matrices_say(seed, downscale):
    """World-to-camera is the inverse of the pose with y and z turned; intrinsics shrink with the image."""
    cameras = made(seed)
    cam = camera_of(cameras, "cpu", downscale=downscale)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3] = cameras.camera_to_worlds[0].double() * torch.tensor([1.0, -1.0, -1.0, 1.0])
    torch.testing.assert_close(cam.viewmat.double(), torch.linalg.inv(pose), rtol=1e-5, atol=1e-5)
    K = cameras.get_intrinsics_matrices()[0].clone()
    K[:2] /= downscale
    torch.testing.assert_close(cam.K, K, rtol=1e-6, atol=0)
    assert (cam.width, cam.height) == (int(cameras.width) // downscale, int(cameras.height) // downscale)
    assert cam.focal == pytest.approx(float(K[[0, 1], [0, 1]].mean()))
    for name in ("camera_to_worlds", "fx", "cy", "width"):
        assert torch.equal(getattr(cameras, name), getattr(made(seed), name)), "the camera does not change"
    assert cam.viewmat.is_contiguous()
    assert cam.K.is_contiguous()
    learning = cameras.camera_to_worlds.clone().requires_grad_()
    learned = camera_of(cameras, "cpu", downscale=downscale, pose=learning)
    cameras.camera_to_worlds.mul_(2)  # the view keeps no hold of its camera
    torch.testing.assert_close(cam.viewmat, learned.viewmat.detach(), rtol=1e-6, atol=1e-5)
    assert torch.equal(learned.K, cam.K)
    assert learned[2:] == cam[2:]
    learned.viewmat[:3].sum().backward()
    assert (learning.grad != 0).any()


UP = (0.6, 0.0, -0.8)


def two_seen(**options):
    points = torch.rand(80, 3, generator=torch.Generator().manual_seed(0))
    cameras = tuple(sn.Camera.look_at((0.5 + dx, -2.0, 0.5), (0.5, 0.5, 0.5), width=40, height=30) for dx in (0.0, 0.8))
    return dataclasses.replace(sn.Scene.from_points(points, points), cameras=cameras, **options)


def started():
    return two_seen(up=UP, start=sn.Camera.look_at((3, 0.5, 0.5), (0.5, 0.5, 0.5), UP, fov=70, width=64, height=48))


def same(one, other):
    alike = all(torch.allclose(a, b, atol=1e-6) for a, b in zip(one.start[:2], other.start[:2], strict=True))
    return alike and one.start[2:] == pytest.approx(other.start[2:]) and one.up == pytest.approx(other.up)


@pytest.mark.usefixtures("short_prunes")
def test_files_and_scenes_made_of_a_scene_keep_both(tmp_path):
    truth = started()
    sn.save(truth, tmp_path / "a.sundae")
    found = sn.load(tmp_path / "a.sundae")
    assert same(found, truth)
    assert same(sn.prune(found, keep=0.5), truth)
    assert same(distill(found, keep=0.5, steps=1, head=False, size=16), truth)
    assert run("prune", tmp_path / "a.sundae", "-o", tmp_path / "b.sundae") == 0
    assert same(sn.load(tmp_path / "b.sundae"), truth)


@pytest.mark.parametrize("up", [None, UP, (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (-0.95, 0.3122499, 0.0)])
def test_virtual_cameras_stand_upright(up):
    wanted, scene = torch.tensor(up or (0.0, 0.0, 1.0)), two_seen(up=up)
    for camera in (*front_views(scene, 2), *sn.virtual_cameras(scene, 2, size=8)):
        assert abs(float(camera.pose[:, 0] @ wanted)) < 1e-5
        assert float(camera.pose[:, 1] @ wanted) > 0


def test_a_page_opens_where_nothing_large_hides_the_middle():
    generator = torch.Generator().manual_seed(0)
    ball = torch.randn(2000, 3, generator=generator)
    wall = torch.rand(60, 3, generator=generator) * 4 + torch.tensor([-2.0, -5.0, -2.0])  # on one side of it
    scene = sn.Scene.from_points(torch.cat([ball, wall]), torch.full((2060, 3), 0.5))
    scene.gaussians["scales"][2000:] += 2
    assert torch.nn.functional.normalize(opening(scene).start.center, dim=0)[1] > -0.3
    x, y, z = opening(scene[:2000]).start.viewmat[:3] @ torch.nn.functional.pad(ball, (0, 1), value=1.0).T
    inside = (x.abs() * 3 / 4).maximum(y.abs()) < z * math.tan(math.radians(25))
    assert float(inside.float().mean()) > 0.95  # of a scene without surroundings


def test_options_name_a_view_or_a_file(tmp_path):
    plain = two_seen()
    assert with_start(plain, None, None) is plain
    assert with_start(plain, "1", None).start is plain.cameras[1]
    found = with_start(plain, str(written(tmp_path, CAPTURE)), (0, 0, -5))
    assert found.start.center.tolist() == [0, 0, 3]
    assert found.up == (0, 0, -1)
    for i in (2, -1):
        with pytest.raises(ConfigError, match=f"no camera {i} in the scene; give --start-view 0 to 1, or a"):
            with_start(plain, str(i), None)


def test_values_that_readers_refuse_are_not_written(tmp_path):
    far = sn.Camera.look_at((2e9, 0, 0), (0, 0, 0))
    for wrong in (far, far.zoomed(1e6)):
        with pytest.raises(ConfigError, match="has values that readers refuse"):
            sn.save(two_seen(start=wrong), tmp_path / "a.sundae")
    assert not list(tmp_path.iterdir())
    assert start_of(stated_start(started()))[0] == pytest.approx(UP)


def test_commands_state_them_without_coding_the_scene_again(tmp_path):
    sn.save(two_seen(), tmp_path / "a.sundae")
    without = sn.load(tmp_path / "a.sundae")
    assert (without.up, without.start) == (None, None)
    words = ("--start-view", 1, "--up", 0, -2, 0)
    assert run("export", tmp_path / "a.sundae", "-o", tmp_path / "site", *words) == 0
    before, after = (tmp_path / name for name in ("a.sundae", "site/scene.sundae"))
    found = sn.load(after)
    assert found.up == (0, -1, 0)
    assert torch.allclose(found.start.viewmat, two_seen().cameras[1].viewmat, atol=1e-6)
    one, other = (container.read_sections(path, container.read_header(path)) for path in (before, after))
    assert all(np.array_equal(one[name], other[name]) for name in (*one, *other))
    assert run("export", after, "-o", tmp_path / "a.html") == 0
    (code,) = re.findall(r'class="scene"[^>]*>([^<]*)</script>', (tmp_path / "a.html").read_text())
    assert base64.b64decode(code) == after.read_bytes()
    sn.save(two_seen(), tmp_path / "a.ply")
    camera = written(tmp_path, CAPTURE)
    assert run("pack", tmp_path / "a.ply", "-o", tmp_path / "b.sundae", "--start-view", camera, "--up", 0, -1, 0) == 0
    found = sn.load(tmp_path / "b.sundae")
    assert (found.up, found.start.center.tolist()) == ((0, -1, 0), [0, 0, 3])
    assert run("export", tmp_path / "a.ply", "-o", tmp_path / "b.ply", "--up", 0, 0, -1) == 0
    assert sn.load(tmp_path / "b.ply").up == (0, 0, -1)
