"""What callers give: lists, arrays, images and paths for tensors, and what is refused in one line."""

import dataclasses
import inspect
import json

import numpy as np
import pytest
import torch
from fields import random_field
from photos import photo
from PIL import Image

import sundae_ns as sn
from sundae_ns.head.head import CompensationHead, HeadConfig
from sundae_ns.scene import cameras as camera_files
from sundae_ns.scene import prune_scene

POINTS = np.random.default_rng(0).random((100, 3))
SCENE = sn.Scene.from_points(POINTS, POINTS)
CAMERA = sn.Camera.look_at((2, 2, 2), (0.5, 0.5, 0.5), width=24, height=20)
EYE = np.eye(4)


def image():
    return (255 * sn.render(SCENE, CAMERA).rgb.numpy()).round().astype(np.uint8)


def scene(**values):
    return sn.Scene({**random_field(9, degree=1), **values})


def arrays(**values):
    given = {"means": POINTS, "scales": POINTS, "quats": EYE[[0] * 100], "opacities": POINTS[:, 0], "colors": POINTS}
    return sn.Scene.from_arrays(**{**given, **values})


def survey(offset):
    """A scene as opened from a file of survey coordinates."""
    rows = [[*(float(i == j) for j in range(3)), -value] for i, value in enumerate(offset)]
    return dataclasses.replace(SCENE, meta={"frame": {"transform": rows, "scale": 1.0}})


look_at = sn.Camera.look_at
GIVEN = {
    "uint8": (POINTS, (255 * POINTS).round().astype("uint8")),
    "uint16": (POINTS, (65535 * POINTS).round().astype("uint16")),
    "big-endian": (POINTS.astype(">f4"), POINTS.astype(">f4")),
    "reversed": (POINTS[:, ::-1].copy()[:, ::-1], POINTS),
    "list": (POINTS.tolist(), POINTS.tolist()),
    "tensor": (torch.from_numpy(POINTS), torch.from_numpy(POINTS)),
}


@pytest.mark.parametrize("kind", GIVEN)
def test_points_and_colours_of_every_type(kind):
    found = sn.Scene.from_points(*GIVEN[kind])
    torch.testing.assert_close(found.means, SCENE.means)
    error = (found.gaussians["features_dc"] - SCENE.gaussians["features_dc"]).abs().max()
    assert error < (0.5 / 255 / 0.28 + 1e-5 if kind == "uint8" else 1e-4)


def test_images_of_every_type(tmp_path):
    stored, path = image(), tmp_path / "a.png"
    Image.fromarray(stored).save(path)
    expected = sn.measure(SCENE, [torch.from_numpy(stored / np.float32(255))], [CAMERA])
    assert 55 < expected.psnr < 75  # the rounding
    arrays = [stored, torch.from_numpy(stored), stored[None], stored.astype(np.uint16) * 257]
    upside_down = [tmp_path / "b.png", tmp_path / "b.tif"]
    for each in upside_down:
        photo(each, image=Image.fromarray(stored[::-1, ::-1]), orientation=3)
    for form in [*arrays, Image.fromarray(stored), path, str(path), *upside_down, *map(Image.open, upside_down)]:
        for images in (form, form if np.ndim(form) == 4 else [form]):
            found = sn.measure(SCENE, images, CAMERA)
            assert (found.psnr, found.ssim) == pytest.approx((expected.psnr, expected.ssim), abs=1e-3)
    assert sn.measure(SCENE, [sn.render(SCENE, CAMERA)], [CAMERA]).ssim == 1


@pytest.mark.usefixtures("short_prunes")
def test_cameras_and_numbers_of_every_type():
    for given in (CAMERA.pose, CAMERA.pose.double(), CAMERA.pose.numpy(), CAMERA.pose.tolist()):
        camera = sn.Camera.from_pose(given, np.array([20, 20, 12, 10]), np.int32(24), 20.0)
        torch.testing.assert_close(camera.viewmat, CAMERA.viewmat)
        assert (camera.width, camera.height) == (24, 20)
    assert sn.prune(SCENE, count=np.int64(50), cameras=CAMERA, rule=sn.PruneRule(score="response")).num_gaussians == 50
    assert sn.crop(SCENE, np.zeros(3), torch.ones(3)).num_gaussians == 100
    params = {name: value.double().numpy() for name, value in SCENE.gaussians.items()}
    made = sn.Scene(params, cameras=[CAMERA], up=np.array([0, -2.0, 0]))
    assert torch.equal(sn.render(made, CAMERA).rgb, sn.render(SCENE, CAMERA).rgb)
    assert (made.cameras, made.up) == ((CAMERA,), (0, -1, 0))
    assert dataclasses.replace(made, antialiased=True).gaussians is made.gaussians
    assert sn.transform(sn.Scene.from_points([[0.1, 0, 0]], [[0.5] * 3]), scale=3).means.sum() == np.float32(0.3)
    turns = np.random.default_rng(0).normal(size=(100, 4))
    for factor in (1e-30, 1e-13, 1e30):
        torch.testing.assert_close(arrays(quats=factor * turns).quats, arrays(quats=turns).quats)
        torch.testing.assert_close(sn.Scene({**params, "quats": factor * turns}).quats, arrays(quats=turns).quats)
    for eye in ((0, 0, 2), (0, 0, -2), (-2, 0, 0)):
        rotation = look_at(eye, (0, 0, 0), eye).viewmat[:3, :3]
        torch.testing.assert_close(rotation @ rotation.T, torch.eye(3))
    torch.testing.assert_close(look_at((0, 0, 2), (0, 0, 0), (0, 1e-8, 0)), look_at((0, 0, 2), (0, 0, 0), (0, 1, 0)))
    assert scene(opacities=torch.full((9, 1), torch.inf), scales=torch.full((9, 3), -torch.inf)).num_gaussians == 9


REFUSED = {
    "colours to 255": (lambda: sn.Scene.from_points(POINTS, 255 * POINTS), r"colors has values from .* give uint8"),
    "words": (lambda: sn.Scene.from_points([["a"] * 3], POINTS), "points has values of type str"),
    "ragged": (lambda: sn.Scene.from_points([[1, 2], [3]], POINTS), "an argument does not fit .*inhomogeneous"),
    "shape": (lambda: sn.Scene.from_points(POINTS[:, :2], POINTS), r"\[100, 2\] and \[100, 3\]"),
    "NaN points": (lambda: sn.Scene.from_points(np.ma.masked_less(POINTS, 0.1), POINTS), "some points are NaN"),
    "NaN colours": (lambda: sn.Scene.from_points(POINTS, POINTS * np.nan), "colors has values from nan"),
    "a survey": (lambda: sn.Scene.from_points([*(POINTS[1:] + 5e6), [0, 0, 0]], POINTS), "points is too far from zero"),
    "degree": (lambda: sn.Scene.from_points(POINTS, POINTS, sh_degree=5), "sh_degree is 5"),
    "no mapping": (lambda: sn.Scene([POINTS]), "Gaussians map means"),
    "names": (lambda: scene(opacity=1), "missing or unknown: opacity"),
    "rows": (lambda: scene(opacities=torch.zeros(9)), r"opacities has shape \[9\]; it must be \[9, 1\]"),
    "rank": (lambda: scene(features_rest=torch.zeros(9, 7, 3)), "features_rest has shape"),
    "features": (lambda: scene(features=torch.zeros(8, 2)), "features has shape"),
    "bytes": (lambda: scene(features_dc=torch.zeros(9, 3, dtype=torch.uint8)), "features_dc has values of type uint8"),
    "NaN": (lambda: scene(means=torch.tensor([[torch.nan] * 3, *8 * [[0.0] * 3]])), "1 of 9 Gaussians are NaN"),
    "infinite": (lambda: scene(scales=torch.full((9, 3), torch.inf)), "9 of 9 Gaussians"),
    "devices": (lambda: scene(means=torch.zeros(9, 3, device="meta")), "are on cpu and meta"),
    "no values": (lambda: SCENE.to("meta"), "are on meta; move them to one that holds values"),
    "nothing": (lambda: sn.Scene({n: v[:0] for n, v in random_field(9).items()}), "no Gaussians"),
    "head": (lambda: dataclasses.replace(SCENE, head=CompensationHead(HeadConfig(size="tiny"))), "the head reads"),
    "one scene": (lambda: sn.merge(SCENE), "'Scene' object is not iterable"),
    "background": (lambda: dataclasses.replace(SCENE, background_color="grey"), "the background is 'grey'"),
    "up": (lambda: dataclasses.replace(SCENE, up=(0, 0, 0)), "no direction"),
    "device": (lambda: SCENE.to("gpu"), "the device gpu is not available"),
    "eye": (lambda: look_at((1, 2, 3), (1, 2, 3)), "one point"),
    "lost gradient": (lambda: look_at(torch.ones(3, requires_grad=True), (0, 0, 0)), "or detached tensor"),
    "zero": (lambda: look_at((1, 2, 3), (0, 0, 0), (0, 0, 0)), "no direction"),
    "far": (lambda: look_at((0, 0, 1e300), (0, 0, 0)), "eye is not made of 3 finite numbers"),
    "size 0": (lambda: look_at((0, 0, 1), (0, 0, 0), width=0), "width is 0"),
    "size inf": (lambda: look_at((0, 0, 1), (0, 0, 0), height=np.inf), "height is inf"),
    "half a pixel": (lambda: sn.Scene(SCENE.gaussians, cameras=CAMERA._replace(width=31.5)), "a camera is 31.5"),
    "fov": (lambda: look_at((0, 0, 1), (0, 0, 0), fov=180), "fov is 180"),
    "scaled pose": (lambda: sn.Camera.from_pose(2 * EYE, (1, 1, 1, 1), 2, 2), "not a rotation"),
    "mirrored pose": (lambda: sn.Camera.from_pose(EYE * [-1, 1, 1, 1], (1, 1, 1, 1), 2, 2), "not a rotation"),
    "transposed pose": (lambda: sn.Camera.from_pose(CAMERA.viewmat.T, (1, 1, 1, 1), 2, 2), "not a rotation"),
    "no focal length": (lambda: sn.render(SCENE, CAMERA._replace(focal=np.nan)), "length of a camera is nan"),
    "focal": (lambda: sn.Camera.from_pose(EYE, (0, 1, 1, 1), 2, 2), "focal lengths are 0 and 1"),
    "a matrix": (lambda: sn.render(SCENE, EYE), "is no camera"),
    "NaN matrix": (lambda: sn.render(SCENE, CAMERA._replace(K=CAMERA.K * np.nan)), "no pinhole"),
    "matrices": (lambda: sn.render(SCENE, CAMERA._replace(viewmat=CAMERA.viewmat[None])), "no float32 tensors"),
    "array": (lambda: sn.render(SCENE, CAMERA._replace(K=np.eye(3))), "no float32 tensors"),
    "skew": (lambda: sn.render(SCENE, CAMERA._replace(K=CAMERA.K + torch.eye(3).roll(1, 1))), "no pinhole"),
    "scaled K": (lambda: sn.render(SCENE, CAMERA._replace(K=2 * CAMERA.K)), "no pinhole"),
    "zeros": (lambda: sn.render(SCENE, CAMERA._replace(viewmat=torch.zeros(4, 4))), "no pinhole"),
    "mirrored": (lambda: sn.render(SCENE, CAMERA._replace(viewmat=torch.eye(4)[[1, 0, 2, 3]])), "no pinhole"),
    "path": (lambda: sn.prune(SCENE, keep=0.5, cameras="a.json"), "'a.json' is no camera"),
    "share": (lambda: sn.prune(SCENE, keep="0.1"), "keep is not made of 1 finite number"),
    "neither": (lambda: sn.prune(SCENE), "either keep .* or count"),
    "both": (lambda: sn.prune(SCENE, keep=0.5, count=5), "either keep .* or count"),
    "none": (lambda: sn.prune(SCENE, keep=0.0), "keep is 0.0"),
    "150%": (lambda: sn.prune(SCENE, keep=1.5), "keep is 1.5"),
    "no view": (lambda: sn.measure(SCENE, SCENE), "no view to measure in"),
    "no link": (lambda: sn.page(SCENE, "a.html", views={"a": "x"}), "view 'a' is 'x'; give a camera"),
    "no stop": (lambda: sn.page(SCENE, "a.html", views={"a": 1}), "an index below 1"),
    "no page": (lambda: sn.page(SCENE, "a.ply"), "a.ply is no page; name it .html"),
    "three": (lambda: sn.page({"a": SCENE, "b": SCENE, "c": SCENE}, "a.html"), "a page of 3 scenes"),
    "height": (lambda: sn.show(SCENE, height="400"), "height is '400'"),
    "half": (lambda: sn.prune(SCENE, count=0.5), "count is 0.5"),
    "rule": (lambda: sn.prune(SCENE, keep=0.5, rule="pairs"), "an argument does not fit .* docstring"),
    "2.5 views": (lambda: sn.virtual_cameras(SCENE, 2.5), "n is 2.5"),
    "seed": (lambda: sn.virtual_cameras(SCENE, 1, seed="a"), "seed is 'a'"),
    "images to 255": (lambda: sn.measure(SCENE, [255.0 * POINTS], [CAMERA]), "image 0 has values from"),
    "CHW": (lambda: sn.measure(SCENE, [image().transpose(2, 0, 1)], [CAMERA]), r"\[20, 24, 3\] and \[3, 20, 24\]"),
    "a PIL image of floats": (lambda: sn.measure(SCENE, Image.new("F", (24, 20)), CAMERA), "pixels of type F; convert"),
    "grey with alpha": (lambda: sn.measure(SCENE, Image.new("LA", (24, 20)), CAMERA), r"and \[20, 24, 4\]"),
    "NUL": (lambda: sn.load("a\0.ply"), "cannot be read|not a complete .ply"),
    "no image": (lambda: sn.measure(SCENE, 5, [CAMERA]), "image 0 has values from 5 to 5"),
    "gone": (lambda: sn.measure(SCENE, ["gone.png"], [CAMERA]), "gone.png"),
    "few": (lambda: sn.measure(SCENE, [image()] * 2, [CAMERA]), "2 images do not fit 1 views"),
    "mask": (lambda: SCENE[np.ones(99, bool)], r"rows are bool \[99\]; give a slice, a mask, bool \[100\]"),
    "bytes as rows": (lambda: SCENE[np.ones(100, np.uint8)], "rows are uint8"),
    "one row": (lambda: SCENE[3], r"rows are int64 \[\]"),
    "beyond": (lambda: SCENE[[0, 100]], "from 0 to 99"),
    "no rows": (lambda: SCENE[5:5], r"rows are int64 \[0\]"),
    "meta": (lambda: arrays(colors=torch.zeros(100, 3, device="meta")), "an argument does not fit"),
    "logits": (lambda: arrays(opacities=np.full(100, 2.0)), "give neither logarithms nor logits"),
    "logarithms": (lambda: arrays(scales=np.log(POINTS)), "give neither logarithms nor logits"),
    "channels": (lambda: arrays(colors=POINTS[:, 0]), r"colors has shape \[100\]; it must be"),
    "no scenes": (lambda: sn.merge([]), "merge found no scenes"),
    "paths": (lambda: sn.merge(["a.ply"]), "merge found no scenes"),
    "kinds": (lambda: sn.merge([SCENE, dataclasses.replace(SCENE, antialiased=True)]), "train or export all alike"),
    "surveys": (lambda: sn.merge([SCENE, survey((5, 0, 0))]), "some scenes have survey coordinates"),
    "mirror": (lambda: sn.transform(SCENE, np.diag([1, 1, -1])), "rotation is no rotation"),
    "no quaternion": (lambda: sn.transform(SCENE, [0, 0, 0, 0]), "rotation is no rotation"),
    "scale": (lambda: sn.transform(SCENE, scale=0), "scale is 0"),
    "moved far": (lambda: sn.transform(SCENE, translation=(5e6, 0, 0)), "the moved scene is too far from zero"),
    "a long name": (lambda: sn.load(300 * "x" + ".ply"), "File name too long"),
    "flag": (lambda: sn.render(SCENE, CAMERA, head=torch.zeros(3)), "Boolean value of Tensor"),
    "box": (lambda: sn.crop(SCENE, 0, 1), "a corner of the box is not made of 3 finite numbers"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_refused_in_one_line(name):
    call, words = REFUSED[name]
    with pytest.raises(sn.SundaeError, match=f"^.*(?:{words}).*$") as caught:
        call()
    assert ";" in str(caught.value)


@pytest.mark.usefixtures("short_prunes")
def test_modes_of_the_caller_stay_and_change_no_value():
    image = sn.render(SCENE, CAMERA).rgb
    with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16):
        assert sn.prune(sn.Scene.from_points(POINTS, POINTS), count=50, cameras=CAMERA).num_gaussians == 50
        assert torch.equal(sn.render(SCENE, look_at((2, 2, 2), (0.5, 0.5, 0.5), width=24, height=20)).rgb, image)
        torch.testing.assert_close(CAMERA.center, torch.full((3,), 2.0))
        assert (torch.ones(1).is_inference(), torch.is_autocast_enabled("cpu")) == (True, True)
    trained = sn.Scene(SCENE.gaussians.replaced({"means": SCENE.gaussians["means"].clone().requires_grad_()}))
    with torch.no_grad(), torch.device("meta"):
        assert not sn.render(trained, CAMERA).rgb.requires_grad


def test_the_rule_of_a_prune_is_that_of_the_command():
    from sundae_ns.cli.prune import RuleOptions

    assert vars(sn.PruneRule()) == vars(RuleOptions())
    for wrong in ("gamma", "num_neighbors", "seed"):
        with pytest.raises(sn.SundaeError, match=f"{wrong} is None: use a number"):
            sn.PruneRule(**{wrong: None})


def test_huge_cameras_score_at_a_smaller_size(monkeypatch):
    monkeypatch.setattr(prune_scene, "MOST_PIXELS", 24 * 20)
    huge = CAMERA.zoomed(1000)
    torch.testing.assert_close(prune_scene.weights_in(SCENE, [huge]), prune_scene.weights_in(SCENE, [CAMERA]))


def test_a_file_of_too_many_cameras_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(camera_files, "MOST_CAMERAS", 2)
    for key in ("frames", "camera_path"):
        (tmp_path / "a.json").write_text(json.dumps({key: 3 * [{}], "render_width": 9, "render_height": 9}))
        with pytest.raises(sn.SundaeError, match=r"a.json has 3 cameras; give at most 2"):
            sn.cameras_of(tmp_path / "a.json")


@pytest.mark.parametrize("name", [name for name in sn.__all__ if inspect.isfunction(getattr(sn, name))])
def test_nothing_is_refused_by_every_function(name):
    function = getattr(sn, name)
    required = [given for given in inspect.signature(function).parameters.values() if given.default is given.empty]
    with pytest.raises(sn.SundaeError, match="^[^\n]+$"):
        function(*[None for given in required if given.kind is not given.VAR_KEYWORD])
