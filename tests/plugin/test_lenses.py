"""Lenses: each camera trains with its own, undistorted as what it is, or is refused with the way out."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from colmap_models import write_model
from nerfstudio.cameras.cameras import Cameras, CameraType
from PIL import Image
from small_captures import meta_of

from sundae_ns.core.errors import DataError
from sundae_ns.data.lenses import COLMAP_LENSES, lens_of
from sundae_ns.plugin.dataparsers import check_projection
from sundae_ns.scene.cameras import cameras_of

FOCAL = 15.0
"""Of a round lens that sees 92 degrees across 24 px."""


def names_of(data):
    return sorted(path.name for path in (data / "images").iterdir())


def images_of(made):
    return [batch["image"] for batch in made.cached_train]


# ------------------------------------------------------------------------------------------------------- projections


@pytest.mark.parametrize(
    ("model", "help_"),
    [
        ("EQUIRECTANGULAR", "ns-process-data images --camera-type equirectangular"),
        ("ORTHOPHOTO", "train on the photos that it was made of"),
        ("VR180_L", "cube faces"),
        ("VR180_R", "cube faces"),
        ("OMNIDIRECTIONALSTEREO_L", "cube faces"),
        ("OMNIDIRECTIONALSTEREO_R", "cube faces"),
        ("BRAIN", "use one of SIMPLE_PINHOLE"),
    ],
)
@pytest.mark.parametrize("place", ["top", "one frame"])
def test_other_projections_are_refused(capture, load, edit, model, help_, place):
    frames = meta_of(capture)["frames"]
    if place == "one frame":
        frames[3]["camera_model"] = model
    edit(capture, frames=frames, **({"camera_model": model} if place == "top" else {}))
    with pytest.raises(DataError, match=help_) as caught:
        load(capture)
    assert model in str(caught.value)
    assert "\n" not in str(caught.value)
    with pytest.raises(DataError, match=help_):
        cameras_of(capture)


@pytest.mark.parametrize("kind", [kind for kind in CameraType if kind != CameraType.PERSPECTIVE])
def test_cameras_of_a_path_with_other_projections_are_refused(kind):
    camera = Cameras(torch.eye(4)[None, :3], 20.0, 20.0, 10.0, 8.0, 20, 16, camera_type=kind)
    with pytest.raises(DataError, match=f"of type {kind.name.lower()}, and only perspective images"):
        check_projection(camera)
    check_projection(Cameras(torch.eye(4)[None, :3], 20.0, 20.0, 10.0, 8.0, 20, 16))


# ----------------------------------------------------------------------------------------------------------- fisheye


def undistorted(path, distortion):
    """The perspective image of a fisheye photo, by OpenCV alone."""
    image = np.array(Image.open(path).convert("RGB"))
    size = image.shape[1], image.shape[0]
    matrix = np.array([[FOCAL, 0, size[0] / 2 - 0.5], [0, FOCAL, size[1] / 2 - 0.5], [0, 0, 1]])
    k = np.array(distortion)
    new = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(matrix, k, size, np.eye(3), balance=0)
    maps = cv2.fisheye.initUndistortRectifyMap(matrix, k, np.eye(3), new, size, cv2.CV_32FC1)
    return cv2.remap(image, *maps, interpolation=cv2.INTER_LINEAR)


def fisheye(data, edit, **entries):
    none = dict.fromkeys(("k1", "k2", "p1", "p2"))
    edit(data, **{"camera_model": "OPENCV_FISHEYE", "fl_x": FOCAL, "fl_y": FOCAL, **none, **entries})


@pytest.mark.parametrize(
    ("entries", "distortion"),
    [
        ({}, (0.0, 0.0, 0.0, 0.0)),
        ({"k1": 0.0, "k2": 0.0, "k3": 0.0, "k4": 0.0}, (0.0, 0.0, 0.0, 0.0)),
        ({"k4": 0.05}, (0.0, 0.0, 0.0, 0.05)),
        ({"k1": 0.02, "k4": -0.01}, (0.02, 0.0, 0.0, -0.01)),
        ({"distortion_params": [0.02, 0.01, 0.03, 0.04]}, (0.02, 0.01, 0.03, 0.04)),
        ({"distortion_params": [0.02, 0.01, 0.03, 0.04, 0, 0]}, (0.02, 0.01, 0.03, 0.04)),
        ({"camera_model": None, "is_fisheye": True, "k1": 0.02}, (0.02, 0.0, 0.0, 0.0)),
        ({"camera_model": "FISHEYE"}, (0.0, 0.0, 0.0, 0.0)),
        ({"camera_model": "RADIAL_FISHEYE", "k1": 0.02, "k2": 0.01}, (0.02, 0.01, 0.0, 0.0)),
    ],
)
def test_a_fisheye_lens_is_undistorted_as_one(capture, load, edit, entries, distortion):
    fisheye(capture, edit, **entries)
    made = load(capture)
    for path, image in zip(made.train_dataset.image_filenames, images_of(made), strict=True):
        expected = undistorted(path, distortion).astype(int)
        assert np.abs(image.numpy().astype(int) - expected).max() <= 1
    cameras = made.train_dataset.cameras
    assert (cameras.camera_type == CameraType.PERSPECTIVE.value).all()
    assert float(cameras.fx[0]) != pytest.approx(FOCAL, abs=0.2)


@pytest.mark.parametrize("focal", [6.0, 14.0, 15.5])
@pytest.mark.parametrize("k1", [0.0, -0.02, 0.05])
def test_a_lens_that_sees_the_half_space(capture, load, edit, focal, k1):
    """Its photos show the direction of each ray; the perspective images of their middles must show the same."""
    size = 48
    y, x = (np.mgrid[:size, :size] + 0.5 - size / 2) / focal
    radius = np.hypot(x, y)
    table = np.linspace(0, np.pi, 4000)
    theta = np.interp(radius, table * (1 + k1 * table**2), table)
    ray = np.stack([x / radius * np.sin(theta), y / radius * np.sin(theta), np.cos(theta)], axis=2)
    photo = Image.fromarray((127.5 * (1 + ray)).round().astype(np.uint8))
    for path in (capture / "images").iterdir():
        photo.save(path)
    fisheye(capture, edit, fl_x=focal, fl_y=focal, cx=size / 2, cy=size / 2, w=size, h=size, k1=k1)
    made = load(capture)
    image = made.cached_train[0]["image"].numpy().astype(float)
    cameras = made.train_dataset.cameras
    fx, fy, cx, cy = (float(value[0]) for value in (cameras.fx, cameras.fy, cameras.cx, cameras.cy))
    assert 45 < math.degrees(math.atan(cx / fx)) < 80
    v, u = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
    expected = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], axis=2)
    expected = 127.5 * (1 + expected / np.linalg.norm(expected, axis=2, keepdims=True))
    inner = made.cached_train[0]["mask"].numpy()[..., 0] if "mask" in made.cached_train[0] else np.ones_like(u, bool)
    assert inner.mean() > 0.6
    assert np.abs(image - expected)[inner].max() < 6  # half a pixel of the smallest photo turns a ray by 3 levels
    assert not made.train_dataset.cameras.distortion_params[0, 1:].any()


@pytest.mark.parametrize(
    "entries",
    [{"p1": 1.0}, {"k4": -90000.0}, {"camera_model": "OPENCV_FISHEYE", "k1": -3.0}, {"k1": 300.0, "k2": 1e9}],
)
def test_a_distortion_that_leaves_no_image_is_refused(capture, load, edit, entries):
    edit(capture, **entries)
    with pytest.raises(
        DataError, match=r"frame_\d+\.png (has a distortion that leaves no image|cannot be undist)"
    ) as caught:
        load(capture).next_train(0)
    assert "not in pixels" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_lens_of_each_frame(capture, load, edit):
    """As ns-process-data writes it for several cameras: model and distortion in the frames alone."""
    meta = meta_of(capture)
    shared = {key: meta[key] for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
    for index, frame in enumerate(meta["frames"]):
        own = {"camera_model": "OPENCV", "k1": 0.05} if index % 2 else {"camera_model": "OPENCV_FISHEYE", "k1": 0.02}
        frame.update({**shared, "fl_x": FOCAL, "fl_y": FOCAL, **own})
    gone = dict.fromkeys((*shared, "camera_model", "k1", "k2", "p1", "p2"))
    edit(capture, frames=meta["frames"], **gone)
    made = load(capture)
    images = images_of(made)
    cameras, place = made.train_dataset.cameras, {Path(f["file_path"]).name: i for i, f in enumerate(meta["frames"])}
    for index, (path, image) in enumerate(zip(made.train_dataset.image_filenames, images, strict=True)):
        if place[path.name] % 2:
            assert float(cameras.fx[index]) < FOCAL + 1  # a perspective lens with barrel distortion
        else:
            expected = undistorted(path, (0.02, 0.0, 0.0, 0.0)).astype(int)
            assert np.abs(image.numpy().astype(int) - expected).max() <= 1


# ------------------------------------------------------------------------------------------------- transforms.json


FOUR, TWELVE = [0.1, 0.02, 0.0, 0.0], [0.5] * 12


@pytest.mark.parametrize(
    ("top", "frame", "distortion"),
    [
        ({"k1": 0.1}, {"k1": 0.3}, (0.3, 0, 0, 0, 0, 0)),
        ({"k1": 0.1}, {"distortion_params": [0.3, 0, 0, 0, 0, 0]}, (0.3, 0, 0, 0, 0, 0)),
        ({"distortion_params": [0.1, 0, 0, 0, 0, 0]}, {"k1": 0.3}, (0.3, 0, 0, 0, 0, 0)),
        ({"distortion_params": [0.1, 0, 0, 0, 0, 0]}, {}, (0.1, 0, 0, 0, 0, 0)),
        ({"k1": 0.1}, {"k2": 0.3}, (0.1, 0.3, 0, 0, 0, 0)),
        ({"distortion_params": FOUR}, {}, (0.1, 0.02, 0, 0, 0, 0)),
        ({"distortion_params": TWELVE, "camera_model": "FISHEYE624"}, {}, (0.5,) * 12),
        ({"latlong": True}, {}, "the images are panoramas"),
        ({"equirectangular": True}, {}, "the images are panoramas"),
        ({"distortion_params": [0.1, 0, 0.001, 0]}, {}, "may be k1, k2, p1, p2 or k1 to k4; give them by name"),
        ({"distortion_params": TWELVE}, {}, "OPENCV needs distortion_params of 6 numbers"),
        ({"camera_model": "FISHEYE624"}, {}, "FISHEYE624 needs distortion_params of 12 numbers, not 0"),
    ],
)
def test_the_lens_of_a_frame(top, frame, distortion):
    if isinstance(distortion, str):
        with pytest.raises(DataError, match=distortion):
            lens_of(top, frame, "frame 0")
    else:
        assert lens_of(top, frame, "frame 0").distortion == distortion


@pytest.mark.parametrize("place", ["top", "frames", "params"])
@pytest.mark.parametrize(
    "distortion",
    [(0.0, 0.0, 0.0, 0.05, 0.0, 0.0), (-0.2, 0.08, -0.02, 0.004, 0.0, 0.0), (0.1, -0.05, 0.02, 0.01, 0.01, -0.02)],
)
def test_four_radial_coefficients(capture, load, edit, distortion, place):
    """As Metashape and RealityScan write them; the photo's colours are its own pixel coordinates."""
    width, height, focal = 60, 40, 40.0
    v, u = np.mgrid[:height, :width]
    for path in (capture / "images").iterdir():
        Image.fromarray(np.stack([4 * u, 6 * v, 0 * u], axis=2).astype(np.uint8)).save(path)
    named = dict(zip(("k1", "k2", "k3", "k4", "p1", "p2"), distortion, strict=True))
    entries = {"distortion_params": list(distortion)} if place == "params" else named
    lens = {"fl_x": focal, "fl_y": focal, "cx": 29.0, "cy": 21.0, "w": width, "h": height}
    frames = meta_of(capture)["frames"]
    gone = dict.fromkeys(named)
    if place == "frames":
        edit(capture, frames=[{**frame, **lens, **entries} for frame in frames], **gone)
    else:
        edit(capture, **{**gone, **lens, **entries})
    made = load(capture)
    image = made.cached_train[0]["image"].numpy().astype(float)
    cameras = made.train_dataset.cameras
    fx, fy, cx, cy = (float(value[0]) for value in (cameras.fx, cameras.fy, cameras.cx, cameras.cy))
    v, u = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
    x, y = (u - cx) / fx, (v - cy) / fy
    k1, k2, k3, k4, p1, p2 = distortion
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    across = focal * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + 29.0 - 0.5
    down = focal * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + 21.0 - 0.5
    assert np.abs(image[..., 0] - 4 * across).max() < 1
    assert np.abs(image[..., 1] - 6 * down).max() < 1
    # The photo fills the image, up to a step of 3%.
    assert across.min() > -0.01
    assert across.max() < width - 0.99
    least = min(across.min(), down.min(), width - 1 - across.max(), height - 1 - down.max())
    assert least < 2


def test_an_angle_of_view_gives_the_focal_length(capture, load, edit):
    known = meta_of(capture)
    gone = dict.fromkeys(("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_model"))
    edit(capture, camera_angle_x=2 * math.atan(12 / known["fl_x"]), **gone)
    cameras = load(capture).train_dataset.cameras
    assert float(cameras.fx[0]) == float(cameras.fy[0]) == pytest.approx(known["fl_x"], rel=1e-6)
    assert (float(cameras.cx[0]), float(cameras.cy[0]), int(cameras.width[0])) == (12.0, 12.0, 24)
    assert cameras_of(capture)[0].K[0, 0] == pytest.approx(known["fl_x"], rel=1e-6)
    edit(capture, camera_angle_y=2 * math.atan(12 / 30))
    assert float(load(capture).train_dataset.cameras.fy[0]) == pytest.approx(30.0, rel=1e-6)
    edit(capture, camera_angle_x=50.0)
    with pytest.raises(DataError, match="camera_angle_x is 50.0; it must be an angle in radians"):
        load(capture)


# ------------------------------------------------------------------------------------------------------------ COLMAP

CENTRE = [12.0, 12.0]
READ = {
    "SIMPLE_RADIAL": ([20, *CENTRE, 0.1], (0.1, 0, 0, 0, 0, 0), CameraType.PERSPECTIVE),
    "OPENCV": ([20, 20, *CENTRE, 0.1, 0.2, 0.3, 0.4], (0.1, 0.2, 0, 0, 0.3, 0.4), CameraType.PERSPECTIVE),
    "OPENCV_FISHEYE": ([20, 20, *CENTRE, 0.1, 0.2, 0.3, 0.4], (0.1, 0.2, 0.3, 0.4, 0, 0), CameraType.FISHEYE),
    "FULL_OPENCV": (
        [20, 20, *CENTRE, 0.1, 0.2, 0.3, 0.4, 0.5, 0, 0, 0],
        (0.1, 0.2, 0.5, 0, 0.3, 0.4),
        CameraType.PERSPECTIVE,
    ),
    "SIMPLE_RADIAL_FISHEYE": ([20, *CENTRE, 0.1], (0.1, 0, 0, 0, 0, 0), CameraType.FISHEYE),
    "RADIAL_FISHEYE": ([20, *CENTRE, 0.1, 0.2], (0.1, 0.2, 0, 0, 0, 0), CameraType.FISHEYE),
    "THIN_PRISM_FISHEYE": (
        [20, 20, *CENTRE, 0.1, 0.2, 0, 0, 0.3, 0.4, 0, 0],
        (0.1, 0.2, 0.3, 0.4, 0, 0),
        CameraType.FISHEYE,
    ),
    "SIMPLE_FISHEYE": ([20, *CENTRE], (1e-12, 0, 0, 0, 0, 0), CameraType.FISHEYE),
    "FISHEYE": ([20, 20, *CENTRE], (1e-12, 0, 0, 0, 0, 0), CameraType.FISHEYE),
}


def write_text_cameras(model, name, params):
    """Replace the cameras of a binary model by a text; nerfstudio reads either all text or all binary."""
    (model / "cameras.bin").unlink()
    (model / "cameras.txt").write_text(f"1 {name} 24 24 {' '.join(map(str, params))}\n")
    images = [f"{i + 1} 1 0 0 0 {0.3 * i} 0.1 3.0 1 {name}\n\n" for i, name in enumerate(names_of(model.parents[1]))]
    (model / "images.txt").write_text("".join(images))


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
@pytest.mark.parametrize("name", READ)
def test_colmap_lenses_that_train(capture, load, name, text):
    params, distortion, kind = READ[name]
    write_model(capture / "sparse" / "0", names_of(capture), (24, 24), lenses=[(COLMAP_LENSES[name][0], params)])
    if text:
        write_text_cameras(capture / "sparse" / "0", name, params)
    made = load(capture, colmap="sparse/0")
    lens = made.train_dataparser_outputs.cameras
    assert lens.distortion_params[0].tolist() == pytest.approx(distortion, rel=1e-6)
    assert set(lens.camera_type.flatten().tolist()) == {kind.value}
    assert (float(lens.fx[0]), float(lens.fy[0]), float(lens.cx[0])) == (20.0, 20.0, 12.0)
    assert all(torch.isfinite(image.float()).all() for image in images_of(made))


@pytest.mark.parametrize(
    ("name", "params", "help_"),
    [
        ("FULL_OPENCV", [20, 20, *CENTRE, 0, 0, 0, 0, 0, 0.1, 0, 0], "colmap image_undistorter"),
        ("FOV", [20, 20, *CENTRE, 0.5], "colmap image_undistorter"),
        ("THIN_PRISM_FISHEYE", [20, 20, *CENTRE, 0, 0, 0, 0, 0, 0, 0.1, 0], "colmap image_undistorter"),
        ("RAD_TAN_THIN_PRISM_FISHEYE", [20, 20, *CENTRE, *[0] * 12], "colmap image_undistorter"),
        ("SIMPLE_DIVISION", [20, *CENTRE, 0.1], "colmap image_undistorter"),
        ("EUCM", [20, 20, *CENTRE, 0.5, 1.0], "colmap image_undistorter"),
        ("EQUIRECTANGULAR", [24, 24], "ns-process-data images --camera-type equirectangular"),
    ],
)
@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
def test_colmap_lenses_that_are_refused(capture, load, name, params, help_, text):
    write_model(capture / "sparse" / "0", names_of(capture), (24, 24), lenses=[(COLMAP_LENSES[name][0], params)])
    if text:
        write_text_cameras(capture / "sparse" / "0", name, params)
    with pytest.raises(DataError, match=help_) as caught:
        load(capture, colmap="sparse/0")
    assert f"camera model {name} " in str(caught.value) or f"camera model {name};" in str(caught.value)
    assert "image_undistorter" not in str(caught.value) or name != "EQUIRECTANGULAR"


def test_two_kinds_of_lenses_of_a_colmap_model(capture, load):
    pinhole, round_lens = (1, [20.0, 20.0, *CENTRE]), (5, [FOCAL, FOCAL, *CENTRE, 0.02, 0.0, 0.0, 0.0])
    write_model(capture / "sparse" / "0", names_of(capture), (24, 24), lenses=[pinhole, round_lens])
    made = load(capture, colmap="sparse/0")
    images = images_of(made)
    kinds = made.train_dataparser_outputs.cameras.camera_type.flatten().tolist()
    assert set(kinds) == {CameraType.PERSPECTIVE.value, CameraType.FISHEYE.value}
    for path, image, kind in zip(made.train_dataset.image_filenames, images, kinds, strict=True):
        plain = np.array(Image.open(path).convert("RGB"))
        expected = plain if kind == CameraType.PERSPECTIVE.value else undistorted(path, (0.02, 0.0, 0.0, 0.0))
        assert np.abs(image.numpy().astype(int) - expected.astype(int)).max() <= 1


# ----------------------------------------------------------------------------------------------- other programs

LENS = {"fl_x": 33.0, "fl_y": 33.5, "cx": 12.25, "cy": 11.75, "w": 24, "h": 24}


OPENCV = {"camera_model": "OPENCV"}
AXES = {"applied_transform": [[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]}
METASHAPE = {**LENS, "k1": 0.02, "k2": -0.01, "k3": 0.001, "k4": 0.0, "p1": 1e-4, "p2": 1e-4}
WRITERS = {
    "ns-process-data": (
        {**LENS, **OPENCV, **AXES, "k1": 0.01, "k2": -0.01, "p1": 1e-4, "p2": 2e-4},
        lambda index: {"colmap_im_id": index + 1},
    ),
    "ns-process-data, several cameras": (
        AXES,
        lambda index: {**LENS, **OPENCV, "fl_x": 33.0 + index, "cx": 12.0 + 0.1 * index, "k1": 0.01 * index, "k2": 0.0},
    ),
    "ns-process-data, a fisheye video": (
        {**LENS, "k1": 0.03, "k2": 0.01, "k3": 0.0, "k4": 0.002, "camera_model": "OPENCV_FISHEYE"},
        lambda index: {},
    ),
    "Polycam": ({**OPENCV, "orientation_override": "none"}, lambda index: {**LENS, "fl_x": 33.0 + 0.1 * index}),
    "Record3D": ({**LENS, **OPENCV, "k1": 0, "k2": 0, "p1": 0, "p2": 0}, lambda index: {}),
    "Metashape": ({**OPENCV, **AXES}, lambda index: METASHAPE),
    "Metashape, k4": (OPENCV, lambda index: {**METASHAPE, "k4": 0.004}),
    "instant-ngp": (
        {**LENS, "camera_angle_x": 0.7, "camera_angle_y": 0.7, "k1": 0.01, "is_fisheye": False, "aabb_scale": 16},
        lambda index: {"sharpness": 30.0 + index},
    ),
}


@pytest.mark.parametrize("writer", WRITERS)
def test_files_of_other_programs(capture, load, writer):
    top, entries = WRITERS[writer]
    frames = [
        {"file_path": frame["file_path"], "transform_matrix": frame["transform_matrix"], **entries(index)}
        for index, frame in enumerate(meta_of(capture)["frames"])
    ]
    (capture / "transforms.json").write_text(json.dumps({**top, "frames": frames}))
    made = load(capture)
    stated = {Path(frame["file_path"]).name: {**top, **frame} for frame in frames}
    lens = made.train_dataparser_outputs.cameras
    for at, path in enumerate(made.train_dataset.image_filenames):
        entry = stated[path.name]
        for name, values in (("fl_x", lens.fx), ("fl_y", lens.fy), ("cx", lens.cx), ("cy", lens.cy)):
            assert float(values[at]) == pytest.approx(entry[name], rel=1e-6)
        distortion = [entry.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2")]
        assert lens.distortion_params[at].tolist() == pytest.approx(distortion, abs=1e-7)
        fisheye = entry.get("camera_model") == "OPENCV_FISHEYE"
        assert int(lens.camera_type[at]) == (CameraType.FISHEYE if fisheye else CameraType.PERSPECTIVE).value
    for batch in made.cached_train:
        assert batch["image"].float().std() > 1
    # The capture turns and scales as a whole: distances between cameras keep their ratios.
    found = torch.cdist(lens.camera_to_worlds[:, :, 3], lens.camera_to_worlds[:, :, 3])
    centres = torch.tensor([stated[p.name]["transform_matrix"] for p in made.train_dataset.image_filenames])[:, :3, 3]
    ratio = torch.cdist(centres, centres) * made.train_dataparser_outputs.dataparser_scale
    torch.testing.assert_close(found, ratio, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(
    ("place", "beside"),
    [
        ("sparse/0", ["project.ini"]),  # COLMAP 3.6
        ("sparse/0", ["rigs.bin", "frames.bin"]),  # COLMAP 3.12
        ("sparse", []),  # the undistorter
        ("colmap/sparse/0", ["project.ini"]),  # ns-process-data
    ],
)
def test_models_of_colmap(capture, load, place, beside):
    write_model(capture / place, names_of(capture), (24, 24), lenses=[(2, [33.0, 12.0, 12.0, 0.02])])
    for name in beside:
        (capture / place / name).write_bytes(bytes(8))
    (capture / "transforms.json").unlink()
    made = load(capture, colmap=place)
    lens = made.train_dataparser_outputs.cameras
    assert float(lens.fx[0]) == 33.0
    assert float(lens.distortion_params[0, 0]) == pytest.approx(0.02)
    assert len(made.train_dataset) + len(made.eval_dataset) == len(names_of(capture))
    assert len(made.train_dataparser_outputs.metadata["points3D_xyz"]) == len(names_of(capture))
