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
from small_captures import meta_of, names_of

from sundae_ns.core.errors import DataError
from sundae_ns.data.lenses import COLMAP_LENSES, FISHEYE, PERSPECTIVE, Lens, colmap_lens, colmap_model, lens_of
from sundae_ns.plugin.dataparsers import check_projection
from sundae_ns.scene.cameras import cameras_of

CENTRE = [12.0, 12.0]
FOCAL = 15.0  # Of a round lens that sees 92 degrees across 24 px


def images_of(made):
    return [batch["image"].numpy().astype(int) for batch in made.cached_train]


@pytest.mark.parametrize(
    ("top", "frame", "kind", "distortion"),
    [
        ({"k1": 0.1}, {"k1": 0.3}, PERSPECTIVE, (0.3, 0, 0, 0, 0, 0)),
        ({"k1": 0.1}, {"k2": 0.3}, PERSPECTIVE, (0.1, 0.3, 0, 0, 0, 0)),
        ({"k1": 0.1}, {"distortion_params": [0.3, 0, 0, 0, 0, 0]}, PERSPECTIVE, (0.3, 0, 0, 0, 0, 0)),
        ({"distortion_params": [0.1, 0, 0, 0, 0, 0]}, {"k1": 0.3}, PERSPECTIVE, (0.3, 0, 0, 0, 0, 0)),
        ({"distortion_params": [0.1, 0, 0, 0, 0, 0]}, {}, PERSPECTIVE, (0.1, 0, 0, 0, 0, 0)),
        ({"distortion_params": [0.1, 0.02, 0.0, 0.0]}, {}, PERSPECTIVE, (0.1, 0.02, 0, 0, 0, 0)),
        ({"camera_model": FISHEYE}, {"distortion_params": [0.1, 0.2, 0.3, 0.4]}, FISHEYE, (0.1, 0.2, 0.3, 0.4, 0, 0)),
        ({"is_fisheye": True}, {"k4": 0.1}, FISHEYE, (0, 0, 0, 0.1, 0, 0)),
        ({"camera_model": "FISHEYE"}, {"camera_model": "SIMPLE_RADIAL"}, PERSPECTIVE, (0,) * 6),
        ({"camera_model": "RADIAL_FISHEYE", "k1": 0.1, "k2": 0.2}, {}, FISHEYE, (0.1, 0.2, 0, 0, 0, 0)),
        ({"distortion_params": [0.5] * 12, "camera_model": "FISHEYE624"}, {}, "FISHEYE624", (0.5,) * 12),
    ],
)
def test_the_lens_of_a_frame(top, frame, kind, distortion):
    assert lens_of(top, frame, "frame 0") == Lens(kind, distortion)


PANORAMAS = "EQUIRECTANGULAR .*panoramas: .*ns-process-data images --camera-type equirectangular"
NO_LENSES = [
    ({"latlong": True}, PANORAMAS),
    ({"equirectangular": True}, PANORAMAS),
    ({"camera_model": "EQUIRECTANGULAR"}, PANORAMAS),
    ({"camera_model": "ORTHOPHOTO"}, "ORTHOPHOTO .*train on the photos that it was made of"),
    ({"camera_model": "VR180_L"}, "VR180_L .*cube faces"),
    ({"camera_model": "OMNIDIRECTIONALSTEREO_R"}, "OMNIDIRECTIONALSTEREO_R .*cube faces"),
    ({"camera_model": "BRAIN"}, "BRAIN.*use one of SIMPLE_PINHOLE"),
    ({"distortion_params": [0.1, 0, 0.001, 0]}, "may be k1, k2, p1, p2 or k1 to k4; give them by name"),
    ({"distortion_params": [0.5] * 12}, "OPENCV needs distortion_params of 6 numbers"),
    ({"camera_model": "FISHEYE624"}, "FISHEYE624 needs distortion_params of 12 numbers, not 0"),
]


@pytest.mark.parametrize(("entries", "cause"), NO_LENSES)
def test_what_is_no_lens_is_refused(entries, cause):
    for top, frame in ((entries, {}), ({}, entries)):
        with pytest.raises(DataError, match=f"^frame 0: .*{cause}[^\n]*$"):
            lens_of(top, frame, "frame 0")


def test_a_capture_with_another_projection_is_refused(capture, load, edit):
    frames = meta_of(capture)["frames"]
    frames[3]["camera_model"] = "VR180_R"
    edit(capture, frames=frames)
    for read in (load, cameras_of):
        with pytest.raises(DataError, match="VR180_R .*cube faces"):
            read(capture)


@pytest.mark.parametrize("kind", [kind for kind in CameraType if kind != CameraType.PERSPECTIVE])
def test_cameras_of_a_path_with_other_projections_are_refused(kind):
    camera = Cameras(torch.eye(4)[None, :3], 20.0, 20.0, 10.0, 8.0, 20, 16, camera_type=kind)
    with pytest.raises(DataError, match=f"of type {kind.name.lower()}, and only perspective images"):
        check_projection(camera)


def undistorted(path, distortion):
    """The perspective image of a fisheye photo, by OpenCV alone."""
    image = np.array(Image.open(path).convert("RGB"))
    size = image.shape[1], image.shape[0]
    matrix = np.array([[FOCAL, 0, size[0] / 2 - 0.5], [0, FOCAL, size[1] / 2 - 0.5], [0, 0, 1]])
    k = np.array(distortion)
    new = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(matrix, k, size, np.eye(3), balance=0)
    maps = cv2.fisheye.initUndistortRectifyMap(matrix, k, np.eye(3), new, size, cv2.CV_32FC1)
    return cv2.remap(image, *maps, interpolation=cv2.INTER_LINEAR).astype(int)


def fisheye(data, edit, **entries):
    none = dict.fromkeys(("k1", "k2", "p1", "p2"))
    edit(data, **{"camera_model": "OPENCV_FISHEYE", "fl_x": FOCAL, "fl_y": FOCAL, **none, **entries})


@pytest.mark.parametrize(
    ("entries", "distortion"),
    [
        ({}, (0.0, 0.0, 0.0, 0.0)),
        ({"k1": 0.02, "k4": -0.01}, (0.02, 0.0, 0.0, -0.01)),
        ({"camera_model": None, "is_fisheye": True, "k4": 0.05}, (0.0, 0.0, 0.0, 0.05)),
    ],
)
def test_a_fisheye_lens_is_undistorted_as_one(capture, load, edit, entries, distortion):
    fisheye(capture, edit, **entries)
    made = load(capture)
    for path, image in zip(made.train_dataset.image_filenames, images_of(made), strict=True):
        assert np.abs(image - undistorted(path, distortion)).max() <= 1
    cameras = made.train_dataset.cameras
    assert (cameras.camera_type == CameraType.PERSPECTIVE.value).all()
    assert float(cameras.fx[0]) != pytest.approx(FOCAL, abs=0.2)


def rays_of(made):
    """The first image ``[H, W, 3]``, and x and y ``[H, W]`` of the rays of its pixels at a depth of 1."""
    image, cameras = images_of(made)[0], made.train_dataset.cameras
    fx, fy, cx, cy = (float(value[0]) for value in (cameras.fx, cameras.fy, cameras.cx, cameras.cy))
    v, u = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
    return image, (u - cx) / fx, (v - cy) / fy


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
    image, x, y = rays_of(made)
    assert 45 < math.degrees(math.atan(x.max())) < 80
    expected = np.stack([x, y, np.ones_like(x)], axis=2)
    expected = 127.5 * (1 + expected / np.linalg.norm(expected, axis=2, keepdims=True))
    inner = made.cached_train[0]["mask"].numpy()[..., 0] if "mask" in made.cached_train[0] else np.ones_like(x, bool)
    assert inner.mean() > 0.6
    assert np.abs(image - expected)[inner].max() < 6  # half a pixel of the smallest photo turns a ray by 3 levels
    assert not made.train_dataset.cameras.distortion_params[0, 1:].any()


@pytest.mark.parametrize(
    "entries", [{"p1": 1.0}, {"k4": -90000.0}, {"camera_model": "OPENCV_FISHEYE", "k1": -3.0}, {"k1": 300.0, "k2": 1e9}]
)
def test_a_distortion_that_leaves_no_image_is_refused(capture, load, edit, entries):
    edit(capture, **entries)
    cause = r"frame_\d+\.png (has a distortion that leaves no image|cannot be undist)[^\n]* not in pixels$"
    with pytest.raises(DataError, match=cause):
        load(capture).next_train(0)


@pytest.mark.parametrize(
    "distortion",
    [(0.0, 0.0, 0.0, 0.05, 0.0, 0.0), (-0.2, 0.08, -0.02, 0.004, 0.0, 0.0), (0.1, -0.05, 0.02, 0.01, 0.01, -0.02)],
)
def test_four_radial_coefficients(capture, load, edit, distortion):
    """As Metashape and RealityScan write them; the photo's colours are its own pixel coordinates."""
    width, height, focal = 60, 40, 40.0
    v, u = np.mgrid[:height, :width]
    for path in (capture / "images").iterdir():
        Image.fromarray(np.stack([4 * u, 6 * v, 0 * u], axis=2).astype(np.uint8)).save(path)
    size = {"w": width, "h": height, "cx": 29.0, "cy": 21.0}
    edit(capture, fl_x=focal, fl_y=focal, **size, **dict(zip("k1 k2 k3 k4 p1 p2".split(), distortion)))
    image, x, y = rays_of(load(capture))
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
    assert min(across.min(), down.min(), width - 1 - across.max(), height - 1 - down.max()) < 2


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


ONE, TWO = [20, *CENTRE], [20, 20, *CENTRE]
UNDISTORT = "colmap image_undistorter"


@pytest.mark.parametrize(
    ("name", "params", "kind", "distortion"),
    [
        ("SIMPLE_PINHOLE", ONE, PERSPECTIVE, (0,) * 6),
        ("SIMPLE_RADIAL", [*ONE, 0.1], PERSPECTIVE, (0.1, 0, 0, 0, 0, 0)),
        ("OPENCV", [*TWO, 0.1, 0.2, 0.3, 0.4], PERSPECTIVE, (0.1, 0.2, 0, 0, 0.3, 0.4)),
        ("OPENCV_FISHEYE", [*TWO, 0.1, 0.2, 0.3, 0.4], FISHEYE, (0.1, 0.2, 0.3, 0.4, 0, 0)),
        ("FULL_OPENCV", [*TWO, 0.1, 0.2, 0.3, 0.4, 0.5, 0, 0, 0], PERSPECTIVE, (0.1, 0.2, 0.5, 0, 0.3, 0.4)),
        ("SIMPLE_RADIAL_FISHEYE", [*ONE, 0.1], FISHEYE, (0.1, 0, 0, 0, 0, 0)),
        ("RADIAL_FISHEYE", [*ONE, 0.1, 0.2], FISHEYE, (0.1, 0.2, 0, 0, 0, 0)),
        ("THIN_PRISM_FISHEYE", [*TWO, 0.1, 0.2, 0, 0, 0.3, 0.4, 0, 0], FISHEYE, (0.1, 0.2, 0.3, 0.4, 0, 0)),
        ("SIMPLE_FISHEYE", ONE, FISHEYE, (0,) * 6),
        ("FISHEYE", TWO, FISHEYE, (0,) * 6),
        ("FULL_OPENCV", [*TWO, 0, 0, 0, 0, 0, 0, 0, 0.1], None, UNDISTORT),
        ("FOV", [*TWO, 0.5], None, UNDISTORT),
        ("THIN_PRISM_FISHEYE", [*TWO, 0, 0, 0, 0, 0, 0, 0.1, 0], None, UNDISTORT),
        ("RAD_TAN_THIN_PRISM_FISHEYE", [*TWO, *[0] * 12], None, UNDISTORT),
        ("SIMPLE_DIVISION", [*ONE, 0.1], None, UNDISTORT),
        ("EUCM", [*TWO, 0.5, 1.0], None, UNDISTORT),
        ("EQUIRECTANGULAR", [24, 24], None, "ns-process-data images --camera-type equirectangular"),
    ],
)
def test_lenses_of_colmap(name, params, kind, distortion):
    for model in (name, COLMAP_LENSES[name][0]):  # a text has names, a binary file numbers
        if kind is None:
            with pytest.raises(DataError, match=f"^camera 1: .*camera model {name}\\b.*{distortion}"):
                colmap_lens(colmap_model(model, "camera 1"), params, "camera 1")
        else:
            intrinsics, lens = colmap_lens(colmap_model(model, "camera 1"), params, "camera 1")
            assert (intrinsics, lens) == ((20, 20, 12, 12), Lens(kind, distortion))


def test_a_colmap_model_of_two_kinds_of_lenses(capture, load):
    """In the folder of the undistorter, with files of COLMAP 3.6 and 3.12 beside it."""
    names = names_of(capture)
    pinhole, round_lens = (1, [20.0, 20.0, *CENTRE]), (5, [FOCAL, FOCAL, *CENTRE, 0.02, 0.0, 0.0, 0.0])
    write_model(capture / "sparse", names, (24, 24), lenses=[pinhole, round_lens])
    for name in ("project.ini", "rigs.bin", "frames.bin"):
        (capture / "sparse" / name).write_bytes(bytes(8))
    (capture / "transforms.json").unlink()
    made = load(capture, colmap="sparse")
    assert len(made.train_dataset) + len(made.eval_dataset) == len(names)
    outputs = made.train_dataparser_outputs
    assert len(outputs.metadata["points3D_xyz"]) == len(names)
    kinds = outputs.cameras.camera_type.flatten().tolist()
    assert set(kinds) == {CameraType.PERSPECTIVE.value, CameraType.FISHEYE.value}
    for path, image, kind in zip(made.train_dataset.image_filenames, images_of(made), kinds, strict=True):
        plain = np.array(Image.open(path).convert("RGB"), int)
        expected = plain if kind == CameraType.PERSPECTIVE.value else undistorted(path, (0.02, 0.0, 0.0, 0.0))
        assert np.abs(image - expected).max() <= 1


LENS = {"fl_x": 33.0, "fl_y": 33.5, "cx": 12.25, "cy": 11.75, "w": 24, "h": 24}

OPENCV, ROUND = {"camera_model": PERSPECTIVE}, {"camera_model": FISHEYE}
AXES = {"applied_transform": [[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]}
METASHAPE = {**LENS, "k1": 0.02, "k2": -0.01, "k3": 0.001, "k4": 0.004, "p1": 1e-4, "p2": 1e-4}
WRITERS = {
    "ns-process-data": (
        {**LENS, **OPENCV, **AXES, "k1": 0.01, "k2": -0.01, "p1": 1e-4, "p2": 2e-4},
        lambda index: {"colmap_im_id": index + 1},
    ),
    "ns-process-data, several cameras": (
        {**LENS, **AXES, "orientation_override": "none"},
        lambda index: {**LENS, **(OPENCV, ROUND)[index % 2], "fl_x": 33 + index, "k1": 0.01 * index, "cx": 12 + index},
    ),
    "ns-process-data, fisheye": ({**LENS, **ROUND, "k1": 0.03, "k2": 0.01, "k3": 0.0, "k4": 0.002}, lambda index: {}),
    "Metashape": (OPENCV, lambda index: METASHAPE),
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
        fisheye = entry.get("camera_model") == FISHEYE
        assert int(lens.camera_type[at]) == (CameraType.FISHEYE if fisheye else CameraType.PERSPECTIVE).value
    for batch in made.cached_train:
        assert batch["image"].float().std() > 1
