"""Captures as our parsers read them: stray cameras, survey coordinates, scales, clouds and images."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from colmap_models import write_model
from command_line import said
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from photos import photo
from PIL import Image, ImageOps
from plyfile import PlyData, PlyElement
from small_captures import meta_of, names_of

from sundae_ns.core.errors import DataError
from sundae_ns.io.ply import read_point_cloud
from sundae_ns.plugin.datamanager import DATASET_FRAME, SundaeDatamanagerConfig
from sundae_ns.plugin.dataparsers import warn_of_other_frame
from sundae_ns.plugin.finished_runs import datamanager_of, describe_capture
from sundae_ns.scene.cameras import cameras_of
from sundae_ns.scene.scene import Scene

SURVEY = np.array([431_250.25, 5_412_330.5, 212.125])  # Coordinates of a place in UTM, metres


def change_poses(data, edit, change):
    """Replace the pose ``[4, 4]`` of each frame, by its index and pose."""
    frames = meta_of(data)["frames"]
    for index, frame in enumerate(frames):
        frame["transform_matrix"] = change(index, np.array(frame["transform_matrix"])).tolist()
    edit(data, frames=frames)


def placed(pose, centre):
    """The pose at another place."""
    return np.column_stack([pose[:, :3], [*centre, 1.0]])


def rewrite_cloud(data, kind, offset):
    """Shift the cloud, and store its coordinates as numbers of a kind."""
    vertex = PlyData.read(str(data / "sparse_pc.ply"))["vertex"].data
    stored = vertex.astype([(name, kind if name in "xyz" else other) for name, other in vertex.dtype.descr])
    for axis, shift in zip("xyz", offset, strict=True):
        stored[axis] += shift
    PlyData([PlyElement.describe(stored, "vertex")]).write(str(data / "sparse_pc.ply"))


def moved(data, offset, edit):
    """Shift cameras and cloud, with double numbers."""
    change_poses(data, edit, lambda _, pose: placed(pose, pose[:3, 3] + offset))
    rewrite_cloud(data, "f8", offset)


def stray(data, times, edit, *, index=4):
    """Put one training camera so many times as far from the middle; returns its image's name."""
    frames = meta_of(data)["frames"]
    centres = np.array([np.array(frame["transform_matrix"])[:3, 3] for frame in frames])
    middle = np.median(centres, axis=0)
    away = (centres[index] - middle) / np.linalg.norm(centres[index] - middle)
    centre = middle + times * np.median(np.linalg.norm(centres - middle, axis=1)) * away
    change_poses(data, edit, lambda i, pose: placed(pose, centre) if i == index else pose)
    return Path(frames[index]["file_path"]).name


def cameras_by_name(made):
    names = [path.name for path in made.train_dataset.image_filenames]
    return dict(zip(names, made.train_dataset.cameras.camera_to_worlds, strict=True))


def poses_of(made):
    return made.train_dataset.cameras.camera_to_worlds


def cloud_of(made):
    """Points and colours."""
    metadata = made.train_dataparser_outputs.metadata
    return metadata["points3D_xyz"], metadata["points3D_rgb"]


def in_model(made, points):
    """Points ``[N, 3]`` in the original coordinates of a capture, in those of the model."""
    transform, scale = made.train_dataset.metadata[DATASET_FRAME]
    return (scale * (points @ transform[:, :3].T.to(points) + transform[:, 3].to(points))).float()


def assert_alike(found, expected):
    """Compare cameras and clouds of two captures in the coordinates of their models."""
    torch.testing.assert_close(poses_of(found), poses_of(expected), atol=1e-6, rtol=0)
    torch.testing.assert_close(cloud_of(found)[0], cloud_of(expected)[0], atol=2e-6, rtol=0)


@pytest.mark.parametrize("times", [20.0, 1e9])
def test_a_stray_camera_does_not_shrink_the_scene(capture, load, edit, capsys, times):
    name = stray(capture, times, edit)
    made = load(capture)
    assert f"the camera of {name} is " in said(capsys)
    meta = meta_of(capture)
    gone = meta["frames"].pop(4)["file_path"]
    lists = {key: [file for file in meta[key] if file != gone] for key in meta if key.endswith("_filenames")}
    edit(capture, frames=meta["frames"], **lists)
    alone = load(capture)
    assert "times as far away" not in said(capsys)
    found, expected = cameras_by_name(made), cameras_by_name(alone)
    assert found.keys() - expected.keys() == {name}
    for other, pose in expected.items():
        torch.testing.assert_close(found[other], pose, atol=2e-6, rtol=0)
    torch.testing.assert_close(cloud_of(made)[0], cloud_of(alone)[0], atol=2e-6, rtol=0)
    # The transform that the run states is the one of its cameras.
    transform, scale = made.train_dataset.metadata[DATASET_FRAME]
    torch.testing.assert_close(transform, alone.train_dataset.metadata[DATASET_FRAME][0], atol=2e-6, rtol=0)
    assert scale == pytest.approx(alone.train_dataset.metadata[DATASET_FRAME][1], rel=1e-6)
    assert float(found[name][:, 3].norm()) > 0.5 * times


def test_a_test_view_that_is_trained_on_is_named(capture, load, edit, capsys):
    name = meta_of(capture)["train_filenames"][0]
    edit(capture, val_filenames=[name], test_filenames=[name])
    load(capture)
    assert f"{Path(name).name} is a training image and a test view (1 of 1 test views are)" in said(capsys)
    copy = meta_of(capture)["train_filenames"][-1]
    (capture / copy).write_bytes((capture / name).read_bytes())
    edit(capture, train_filenames=meta_of(capture)["train_filenames"][:-1], val_filenames=[copy], test_filenames=[copy])
    load(capture)
    assert f"{Path(copy).name} is a training image and a test view (1 of 1 test views are)" in said(capsys)


def test_a_stray_test_view_is_named(capture, load, edit, capsys):
    name = stray(capture, 100.0, edit, index=3)
    made = load(capture)
    assert f"the camera of {name}, a test view, stands far from all others (1 of 2 do)" in said(capsys)
    assert float(poses_of(made)[:, :, 3].abs().max()) == pytest.approx(1.0, abs=1e-5)


def test_earlier_runs_keep_the_frame_that_they_were_trained_in(capture, load, edit, tmp_path, caplog):
    """A run that is resumed in other coordinates is named."""
    stray(capture, 100.0, edit)
    made = load(capture, robust=False)
    everywhere = poses_of(made)[:, :, 3]
    assert float(everywhere.abs().max()) == pytest.approx(1.0)  # as nerfstudio scales
    assert float(everywhere.norm(dim=1).median()) < 0.2
    before, run = made.train_dataparser_outputs, tmp_path / "run"
    before.save_dataparser_transform(run / "dataparser_transforms.json")
    now = load(capture).train_dataparser_outputs
    caplog.clear()
    for outputs, folder in ((before, run), (now, tmp_path / "none"), (now, run)):
        assert not caplog.messages
        warn_of_other_frame(folder, outputs.dataparser_transform, outputs.dataparser_scale)
    assert "resume it with --pipeline.datamanager.robust-frame False" in caplog.text


@pytest.mark.parametrize("offset", [np.zeros(3), SURVEY])
@pytest.mark.parametrize("times", [1.0, 300.0])
def test_cameras_of_a_capture_in_the_coordinates_of_a_run(capture, load, edit, tmp_path, times, offset):
    """``cameras_of`` finds them by the transform that the run states."""
    if times > 1:
        stray(capture, times, edit)
    moved(capture, offset, edit)
    made = load(capture)
    outputs = made.train_dataparser_outputs
    frame = {"transform": outputs.dataparser_transform.tolist(), "scale": outputs.dataparser_scale}
    points = torch.zeros(3, 3)
    scene = Scene.from_points(points, points)
    scene = replace(scene, in_model_frame=True, meta={"frame": json.loads(json.dumps(frame))})
    seen = {tuple(camera.center.tolist()) for camera in cameras_of(capture, scene)}
    trained = poses_of(made)[:, :, 3]
    nearest = torch.cdist(trained, torch.tensor(sorted(seen)))
    assert float(nearest.min(dim=1).values.max()) < (1e-5 * max(1.0, float(trained.abs().max())))


@pytest.mark.parametrize("robust", [True, False])
def test_a_packed_scene_is_measured_in_the_frame_of_its_training(still_life, robust):
    manager = SundaeDatamanagerConfig(dataparser=NerfstudioDataParserConfig(), robust_frame=robust)
    stated = json.loads(json.dumps(describe_capture(manager)))
    assert datamanager_of(SimpleNamespace(meta={"capture": stated}), still_life).robust_frame is robust


@pytest.mark.parametrize("scale", [0.01, 7.5])
def test_a_scale_in_the_rotations_is_none_of_the_cameras(capture, still_life, load, edit, scale):
    change_poses(capture, edit, lambda _, pose: pose @ np.diag([scale, scale, scale, 1.0]))
    assert_alike(load(capture), load(still_life))
    torch.testing.assert_close(cameras_of(capture)[2].viewmat, cameras_of(still_life)[2].viewmat, atol=1e-6, rtol=0)


@pytest.mark.parametrize(("place", "value"), [((0, 0), 2.0), ((0, 1), 0.5), ((0, 0), -1), ((3, 0), 4.0)])
def test_axes_that_are_no_rotation_are_refused(capture, load, edit, place, value):
    spoilt = np.eye(4)
    spoilt[place] = value
    change_poses(capture, edit, lambda index, pose: spoilt @ pose if index == 1 else pose)
    words = "the first three columns are not a rotation" if place[0] < 3 else "last row .* is not 0 0 0 1; exchange"
    with pytest.raises(DataError, match=f"frame 1 .*{words}"):
        load(capture)


def test_a_panorama_with_one_step_aside_keeps_its_scale(capture, load, edit, capsys):
    """All cameras but one stand within centimetres; the points are as far as that one, so it is no stray."""
    centres = 0.01 * np.random.default_rng(0).standard_normal((12, 3))
    centres[4] += [2.0, 0, 0]
    change_poses(capture, edit, lambda index, pose: placed(pose, centres[index]))
    assert float(poses_of(load(capture))[:, :, 3].abs().max()) == pytest.approx(1.0, abs=1e-3)
    assert "times as far away" not in said(capsys)


@pytest.mark.parametrize("applied", [None, [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]])
def test_survey_coordinates_train_as_those_near_zero_and_come_back(capture, still_life, load, edit, tmp_path, applied):
    moved(capture, SURVEY, edit)
    edit(capture, applied_transform=applied)
    made = load(capture)
    assert_alike(made, load(still_life))
    assert cloud_of(made)[0].dtype == poses_of(made).dtype == torch.float32
    outputs = made.train_dataparser_outputs
    outputs.save_dataparser_transform(tmp_path / "run" / "dataparser_transforms.json")
    stated = json.loads((tmp_path / "run" / "dataparser_transforms.json").read_text())
    transform = np.array(stated["transform"])
    meta = meta_of(capture)
    poses = {Path(frame["file_path"]).name: np.array(frame["transform_matrix"]) for frame in meta["frames"]}
    centres = outputs.cameras.camera_to_worlds[:, :, 3].double().numpy() / stated["scale"]
    original = np.linalg.solve(transform[:, :3], (centres - transform[:, 3]).T).T
    axes = np.eye(3) if applied is None else np.array(applied, dtype=float)[:, :3]
    expected = [np.linalg.solve(axes, poses[path.name][:3, 3]) for path in outputs.image_filenames]
    np.testing.assert_allclose(original, expected, atol=1e-5)  # metres; float32 has steps of 0.5
    again = outputs.transform_poses_to_original_space(outputs.cameras.camera_to_worlds, camera_convention="opengl")
    np.testing.assert_allclose(again[:, :, 3].numpy(), expected, atol=1e-5)


def test_survey_coordinates_that_shall_not_be_centred_are_refused(capture, load, edit):
    moved(capture, SURVEY, edit)
    cause = r"stand 5\.41e\+06 from the origin.* 0\.5 apart; leave out --center-method none"
    with pytest.raises(DataError, match=cause):
        load(capture, center_method="none")


def test_a_cloud_that_was_rounded_before_is_named(capture, load, edit, capsys):
    moved(capture, SURVEY, edit)
    load(capture)
    assert "sparse_pc.ply has float32 coordinates" not in said(capsys)
    rewrite_cloud(capture, "f4", np.zeros(3))
    load(capture)
    assert "sparse_pc.ply has float32 coordinates that are 0.5 apart" in said(capsys)


@pytest.mark.parametrize("axes", [True, False])
def test_a_colmap_model_in_survey_coordinates(capture, load, axes):
    names = names_of(capture)
    write_model(capture / "sparse" / "0", names, (24, 24))
    options = {"assume_colmap_world_coordinate_convention": axes}
    near = load(capture, colmap="sparse/0", **options)
    write_model(capture / "sparse" / "0", names, (24, 24), origin=tuple(SURVEY))
    far = load(capture, colmap="sparse/0", **options)
    assert_alike(far, near)
    point = in_model(far, torch.from_numpy(SURVEY + [[0.1, 0.2, 0.3]]))
    torch.testing.assert_close(point[0], cloud_of(near)[0][1], atol=1e-6, rtol=0)


def test_a_stray_camera_of_a_colmap_model(capture, load):
    names = names_of(capture)
    write_model(capture / "sparse" / "0", names, (24, 24))
    usual = load(capture, colmap="sparse/0")
    write_model(capture / "sparse" / "0", names, (24, 24), stray=(5, 4000.0))
    made = load(capture, colmap="sparse/0")
    assert float(poses_of(made)[:, :, 3].norm(dim=1).median()) > 0.3
    assert float(cloud_of(made)[0].abs().max()) > 0.2 * float(cloud_of(usual)[0].abs().max())


@pytest.mark.parametrize("scale", [0.1, 25.0])
def test_applied_scale_leaves_the_cloud_beside_its_cameras(capture, load, edit, scale):
    plain = load(capture)
    edit(capture, applied_scale=scale)
    made = load(capture)
    assert_alike(made, plain)
    # Original coordinates times applied_scale are those of the file.
    original = read_point_cloud(capture / "sparse_pc.ply")[0] / scale
    torch.testing.assert_close(in_model(made, original), cloud_of(plain)[0], atol=1e-5, rtol=0)


def test_a_cloud_that_the_views_do_not_show_is_named(capture, load, capsys):
    load(capture)
    assert "show no point" not in said(capsys)
    rewrite_cloud(capture, "f4", (50, 0, 0))
    load(capture)
    assert "views show no point of the sparse cloud: both are probably in different coordinates" in said(capsys)


def test_an_old_capture_takes_the_cloud_of_its_colmap_model(capture, load, edit):
    """Made before ns-process-data wrote clouds; nerfstudio asks, and writes into the capture."""
    (capture / "sparse_pc.ply").unlink()
    edit(capture, ply_file_path=None)
    (capture / "colmap" / "sparse" / "0").mkdir(parents=True)
    assert "points3D_xyz" not in load(capture).train_dataparser_outputs.metadata
    write_model(capture / "colmap" / "sparse" / "0", [f"{index}.png" for index in range(4)], (24, 24))
    before = (capture / "transforms.json").read_bytes()
    made = load(capture)
    points, colours = cloud_of(made)
    assert colours.tolist() == [[10, 20, 30]] * 4
    stated = torch.tensor([[0.1 * index, 0.2, 0.3] for index in range(4)])
    torch.testing.assert_close(points, in_model(made, stated), atol=1e-6, rtol=0)
    assert (capture / "transforms.json").read_bytes() == before
    assert not (capture / "sparse_pc.ply").exists()


@pytest.mark.parametrize("colmap", [None, "sparse/0"])
def test_masks_beside_the_images(capture, load, edit, capsys, colmap):
    if colmap is not None:
        write_model(capture / colmap, names_of(capture), (24, 24))
    load(capture, colmap=colmap)
    assert "masks" not in said(capsys)
    (capture / "masks").mkdir()
    for name in names_of(capture):
        Image.new("L", (24, 24), 255).save(capture / "masks" / name)
    load(capture, colmap=colmap)
    remedy = "mask_path in each frame" if colmap is None else "colmap --masks-path masks"
    assert f"is not used; to leave out what its masks hide, give {remedy}" in said(capsys)
    frames = meta_of(capture)["frames"]
    edit(capture, frames=[{**frame, "mask_path": frame["file_path"].replace("images", "masks")} for frame in frames])
    options = {} if colmap is None else {"masks_path": Path("masks")}
    assert "mask" in load(capture, colmap=colmap, **options).cached_train[0]
    assert "is not used" not in said(capsys)


def test_a_larger_model_beside_the_given_one(capture, load, capsys):
    names = names_of(capture)
    write_model(capture / "sparse" / "0", names[:4], (24, 24))
    write_model(capture / "sparse" / "1", names, (24, 24))
    load(capture, colmap="sparse/0")
    assert f"sparse/0 has 4 images and sparse/1 has {len(names)}" in said(capsys)
    load(capture, colmap="sparse/1")
    assert "for those" not in said(capsys)


def test_a_missing_image_is_named_with_the_one_beside_it(capture, load, edit):
    frames = meta_of(capture)["frames"]
    first, last = (capture / frames[index]["file_path"] for index in (0, -1))
    last.rename(last.with_name(last.name + ".png"))
    with pytest.raises(DataError, match=rf"{last.name} does not exist \(there is {last.name}\.png\)"):
        load(capture).next_train(0)
    first.rename(first.with_suffix(".PNG"))
    with pytest.raises(DataError, match=rf"{first.name} does not exist \(there is {first.stem}\.PNG\)"):
        load(capture)
    write_model(capture / "sparse" / "0", [first.name, last.name], (24, 24))
    with pytest.raises(DataError, match=rf"{first.name} does not exist \(there is {first.stem}\.PNG\)"):
        load(capture, colmap="sparse/0")
    (capture / "sparse" / "0" / "cameras.bin").rename(capture / "sparse" / "0" / "Cameras.bin")
    with pytest.raises(DataError, match=r"nor cameras.txt \(there is Cameras\.bin\)"):
        load(capture, colmap="sparse/0")


def as_photos(data, edit, orientation, *, size=(24, 16)):
    """Turn the images of a capture into JPEG files with an EXIF entry, of another shape than their cameras state."""
    frames = meta_of(data)["frames"]
    for frame in frames:
        path = data / frame["file_path"]
        with Image.open(path) as image:
            entries = Image.Exif()
            entries[0x0112] = orientation
            image.convert("RGB").resize(size).save(path.with_suffix(".jpg"), exif=entries, quality=95)
        path.unlink()
        frame["file_path"] = str(Path(frame["file_path"]).with_suffix(".jpg"))
    gone = dict.fromkeys(("train_filenames", "val_filenames", "test_filenames"))
    edit(data, frames=frames, **{**gone, "w": size[1], "h": size[0], "cx": size[1] / 2, "cy": size[0] / 2})


@pytest.mark.parametrize(("orientation", "turned"), [(5, True), (6, True), (7, True), (8, True), (6, False)])
def test_photos_are_turned_as_their_cameras_see_them(capture, load, edit, orientation, turned):
    """A program may also have estimated the cameras of the pixels as they are stored."""
    as_photos(capture, edit, orientation)
    if not turned:
        edit(capture, w=24, h=16, cx=12.0, cy=8.0)
    made = load(capture)
    for path, batch in zip(made.train_dataset.image_filenames, made.cached_train, strict=True):
        with Image.open(path) as image:
            expected = np.array(ImageOps.exif_transpose(image) if turned else image)
        assert np.array_equal(batch["image"].numpy(), expected)


@pytest.mark.parametrize(
    ("orientation", "size", "advice"),
    [
        (6, (10, 20), "turned by its EXIF entry"),
        (1, (10, 20), "give each size its own camera"),
        (1, (23, 16), "--downscale-rounding-mode round"),
    ],
)
def test_photos_that_fit_neither_way(capture, load, edit, orientation, size, advice):
    as_photos(capture, edit, orientation)
    edit(capture, w=size[0], h=size[1])
    with pytest.raises(DataError, match=f"24 x 16 px but its camera says {size[0]} x {size[1]}; .*{advice}"):
        load(capture).next_train(0)


def test_masks_of_turned_photos(capture, load, edit):
    as_photos(capture, edit, 6)
    frames = meta_of(capture)["frames"]
    mask = Image.new("L", (16, 24), 255)
    mask.paste(0, (0, 0, 16, 4))
    mask.save(capture / "mask.png")
    edit(capture, frames=[{**frame, "mask_path": "mask.png"} for frame in frames])
    batch = load(capture).cached_train[0]
    assert batch["mask"].shape[:2] == batch["image"].shape[:2] == (24, 16)
    assert not batch["mask"][:4].any()
    assert batch["mask"][4:].all()
    photo(capture / "mask.png", image=mask, orientation=3)
    with pytest.raises(DataError, match=r"mask\.png is turned by its EXIF entry, and its image is not"):
        load(capture).next_train(0)
