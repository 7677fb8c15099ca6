"""The datamanager: an order that resumes, views held back, images cached without CUDA, bad captures named."""

import math
import re
import sys
from contextlib import nullcontext
from pathlib import Path

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.utils.dataloaders import FixedIndicesEvalDataloader
from PIL import Image
from small_captures import meta_of

from sundae_ns.core.errors import ConfigError, DataError
from sundae_ns.plugin.datamanager import SundaeDatamanagerConfig, check_cameras

VIEWS, SIDE = 10, 24


def test_the_order_is_a_function_of_seed_and_step(still_life, load):
    first, again, other = (load(still_life, manager={"train_cameras_sampling_seed": seed}) for seed in (42, 42, 7))
    order = [first.view_of_step(step) for step in range(40)]
    passes = [tuple(order[i : i + VIEWS]) for i in range(0, len(order), VIEWS)]
    assert all(sorted(views) == list(range(VIEWS)) for views in passes)
    assert len(set(passes)) > 1
    # Asked in any order, as a resumed run or a viewer may.
    assert [again.view_of_step(step) for step in reversed(range(40))] == order[::-1]
    assert [other.view_of_step(step) for step in range(40)] != order


def test_next_train_serves_the_view_of_the_step(still_life, load):
    made = load(still_life)
    for step in range(VIEWS):
        camera, batch = made.next_train(step)
        index = made.view_of_step(step)
        assert camera.shape == (1,)
        assert camera.metadata["cam_idx"] == index
        assert torch.equal(camera.camera_to_worlds[0], made.train_dataset.cameras.camera_to_worlds[index])
        assert batch["image"].dtype == torch.uint8
        assert torch.equal(batch["image"], made.train_dataset.get_data(index, image_type="uint8")["image"])
    made.rank = 1
    for step in range(VIEWS):
        assert (made.next_train(step)[0].metadata or {})["cam_idx"] == made.view_of_step(step + 1)


def test_held_back_views_are_not_trained_on_and_are_loaded_when_their_turn_comes(still_life, load, monkeypatch):
    made = load(still_life)
    assert (made.held_out_indices, list(made.cameras([]))) == ([], [])
    made.hold_out([5, 2])
    assert made.held_out_indices == [2, 5]
    assert {made.view_of_step(step) for step in range(50)} == set(range(VIEWS)) - {2, 5}
    cameras, masks = zip(*made.training_views(), strict=True)  # a prune looks at all of them
    assert masks == (None,) * VIEWS
    assert [camera.metadata["cam_idx"] for camera in cameras] == made.train_indices, "a camera optimizer moves them"
    poses = torch.cat([camera.camera_to_worlds for camera in cameras])
    assert torch.equal(poses, made.train_dataset.cameras.camera_to_worlds)
    (camera, batch), _ = made.cameras(made.held_out_indices)
    assert batch["image_idx"] == 2
    assert torch.equal(camera.camera_to_worlds[0], made.train_dataset.cameras.camera_to_worlds[2])
    assert batch["image"].shape == (SIDE, SIDE, 3)
    moved = []
    monkeypatch.setattr(made, "_view", moved.append)
    rest = made.cameras(made.held_out_indices)
    assert moved == []
    next(rest)
    assert moved == [2]


def test_masks_come_with_the_views_that_they_belong_to(capture, load, edit):
    frames = meta_of(capture)["frames"]
    (capture / "masks").mkdir()
    for number, frame in enumerate(frames):
        frame["mask_path"] = f"masks/{number}.png"
        mask = Image.new("L", (SIDE, SIDE))
        mask.paste(255, (0, 0, number + 1, SIDE))
        mask.save(capture / frame["mask_path"])
    edit(capture, frames=frames)
    made = load(capture)
    widths = [int(made.cached_train[index]["mask"][0].sum()) for index in made.train_indices]
    masks = [mask for _, mask in made.training_views() if mask is not None]
    assert [tuple(mask.shape) for mask in masks] == [(SIDE, SIDE, 1)] * VIEWS
    assert [int(mask[0].sum()) for mask in masks] == widths
    assert len(set(widths)) == VIEWS
    edit(capture, k1=0.3, k2=0.1)
    # Before anything else has read the images, which undistortion crops.
    for camera, cropped in load(capture).training_views():
        assert cropped.shape == (int(camera.height), int(camera.width), 1)
        assert cropped.shape != (SIDE, SIDE, 1), "undistortion cuts nothing off"


def test_a_round_lens_has_masks_of_its_own(capture, load, edit):
    edit(capture, camera_model="FISHEYE624", distortion_params=[0.01] + [0.0] * 11, fisheye_crop_radius=7.0)
    for camera, mask in load(capture).training_views():
        assert mask.shape == (int(camera.height), int(camera.width), 1)
        assert not mask.all()


def test_cpu_cache_without_cuda(still_life, load, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    made = load(still_life, manager={"cache_images": "cpu"})
    images = [batch["image"] for batch in (*made.cached_train, *made.cached_eval)]
    assert len(images) == VIEWS + 2
    assert not any(image.is_pinned() for image in images)


def test_images_that_do_not_fit_on_the_gpu_stay_in_main_memory(still_life, load, monkeypatch, capsys):
    places = []

    def cached(self, split, cache_images_device):
        places.append(cache_images_device)
        return []

    monkeypatch.setattr(FullImageDatamanager, "_load_images", cached)
    made = load(still_life)
    least = 2 * 3 * VIEWS * SIDE * SIDE
    made.device = torch.device("cuda")
    for kind, free in (("uint8", least), ("uint8", least - 1), ("float32", 4 * least - 1)):
        made.config.cache_images_type = kind
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda _, free=free: (free, 10 * least))
        made._load_images("train", "gpu")
    assert places == ["gpu", "cpu", "cpu"]
    assert "the train images need more than half of the free GPU memory" in " ".join(capsys.readouterr().out.split())


def test_undistorted_test_views_are_not_checked_against_their_cropped_cameras(capture, load, edit):
    edit(capture, k1=0.3, k2=0.1)
    made = load(capture)
    # nerfstudio's viewer loads the test views first.
    assert made.cached_eval[0]["image"].shape != (SIDE, SIDE, 3), "undistortion cuts nothing off"
    assert len(made.cached_train) == VIEWS


def test_images_may_differ_where_each_has_its_own_camera(capture, load, edit):
    frames = meta_of(capture)["frames"]
    for index, frame in enumerate(frames):
        size = (20 + 2 * index, 16)
        frame.update(w=size[0], h=size[1], fl_x=20.0, fl_y=20.0, cx=size[0] / 2, cy=8.0)
        Image.new("RGB", size).save(capture / frame["file_path"])
    edit(capture, frames=frames, w=None, h=None, fl_x=None, fl_y=None, cx=None, cy=None)
    assert len({batch["image"].shape for batch in load(capture).cached_train}) == VIEWS


def test_point_cloud_needs_no_open3d(still_life, load, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    made = load(still_life)
    metadata = made.train_dataparser_outputs.metadata
    assert len(metadata["points3D_xyz"]) == 80
    assert metadata.pop("points3D_rgb").dtype == torch.uint8
    made.create_train_dataset()  # of a parser that gives no colours, which nerfstudio's pipeline reads
    assert metadata["points3D_rgb"].shape == (0, 3)


def cameras(*, focal=20.0, cx=10.0, cy=8.0, mirrored=False, spread=1.0, outlier=0.0, kind=CameraType.PERSPECTIVE):
    poses = torch.eye(4)[None, :3].repeat(6, 1, 1)
    poses[:, :, 3] = spread * torch.randn(6, 3, generator=torch.Generator().manual_seed(0))
    poses[4, 0, 0] = -1.0 if mirrored else 1.0
    poses[4, 0, 3] += outlier
    return Cameras(poses, fx=focal, fy=focal, cx=cx, cy=cy, width=20, height=16, camera_type=kind)


NAMES = [Path(f"{index}.png") for index in range(6)]


@pytest.mark.parametrize(
    ("options", "cause"),
    [
        ({"kind": CameraType.VR180_L}, r"camera of 0\.png is of type VR180_L; .*such as cube faces"),
        ({"mirrored": True}, r"pose of 4\.png mirrors an axis \(1 of 6"),
        ({"focal": 1e-5}, r"0\.png has fl_x 1e-05, cx 10, cy 8 at a width of 20 px"),
        ({"focal": 1e9}, r"no lens has; give all in pixels"),
        ({"cx": 50.5}, r"has fl_x 20, cx 50\.5, cy 8 at"),
        ({"cx": 0.5, "cy": 0.4}, r"cx 0\.5, cy 0\.4 at"),
    ],
)
def test_cameras_that_cannot_be(options, cause):
    with pytest.raises(DataError, match=f"^.*({cause}).*$"):
        check_cameras(cameras(**options), NAMES)


@pytest.mark.parametrize(
    ("options", "cause"),
    [
        ({}, None),
        ({"outlier": 5.0}, None),
        ({"outlier": 100.0}, "the camera of 4.png is .* times as far away as most .1 of 6 are.; check its pose"),
        ({"spread": 0.0}, "all cameras stand at one place"),
        ({"cx": 20.0, "cy": 16.0}, "cx and cy lie far from the middle of all images; if they are of images of another"),
        ({"outlier": 1e11}, "the camera of 4.png is .* times as far away as most .1 of 6"),
    ],
)
def test_cameras_that_make_no_good_scene(options, cause, caplog):
    check_cameras(cameras(**options), NAMES)
    assert [bool(cause and re.search(cause, line)) for line in caplog.messages] == [True] * bool(cause)


def changed(data, change, count):
    """Change the first images of a capture."""
    for path in sorted((data / "images").iterdir())[:count]:
        with Image.open(path) as opened:
            image = change(opened.convert("RGBA"))
        image.save(path)


def test_alpha_is_named(capture, load, capsys):
    load(capture).next_train(0)
    assert "alpha" not in capsys.readouterr().out
    changed(capture, lambda image: image, 3)
    made = load(capture)
    made.next_train(0)
    kept = sum(batch["image"].shape[-1] == 4 for batch in made.cached_train)
    assert 0 < kept < VIEWS
    shown = " ".join(capsys.readouterr().out.split())
    assert f"{kept} of {VIEWS} training images have an alpha channel: transparent pixels are trained as" in shown


@pytest.mark.parametrize("way", ["transparent", "masked", "transparent where it is not masked"])
def test_images_that_show_nothing(capture, load, edit, way):
    def change(image):
        if way != "masked":
            image.putalpha(0)
        if way.endswith("not masked"):
            image.putpixel((0, 0), (9, 9, 9, 255))
        return image

    changed(capture, change, VIEWS + 2)
    meta = meta_of(capture)
    if way != "transparent":
        mask = Image.new("L", (SIDE, SIDE), 0 if way == "masked" else 255)
        mask.putpixel((0, 0), 0)
        mask.save(capture / "mask.png")
        edit(capture, frames=[{**frame, "mask_path": "mask.png"} for frame in meta["frames"]])
    with pytest.raises(DataError, match=f"all {VIEWS} training images are fully transparent or masked"):
        load(capture).next_train(0)
    if way == "transparent":  # one image is enough
        Image.new("RGB", (SIDE, SIDE)).save(capture / meta["train_filenames"][0])
        load(capture).next_train(0)


def test_a_question_without_a_terminal(still_life, monkeypatch):
    """What nerfstudio's COLMAP parser asks if images_2 is missing."""
    monkeypatch.setattr("sundae_ns.plugin.datamanager.check_capture", lambda *_, **__: None)

    def ask(*_, **__):
        raise EOFError

    monkeypatch.setattr(ColmapDataParserConfig().__class__, "setup", ask)
    config = SundaeDatamanagerConfig(data=still_life, dataparser=ColmapDataParserConfig(downscale_factor=2))
    with pytest.raises(DataError, match="^.*start the command once in a terminal and answer y.*$"):
        config.setup(device="cpu", test_mode="val")


@pytest.mark.parametrize(
    ("edits", "options", "cause"),
    [
        ({"train_filenames": []}, {}, "has no training images, and training needs 2 or more; check the path and"),
        ({"train_filenames": ["images/frame_00001.png"]}, {}, "has 1 training image, and training needs 2"),
        ({"fl_x": 1e-5, "fl_y": 1e-5}, {}, "frame_.* has fl_x 1e-05"),
        ({}, {"manager": {"train_cameras_sampling_strategy": "fps"}}, "fps is not a function of seed and step"),
        ({}, {"manager": {"camera_res_scale_factor": math.nan}}, "--camera-res-scale-factor is nan; give a positive"),
        ({}, {"manager": {"camera_res_scale_factor": 0.01}}, "has no pixel at the given scale of images"),
        ({}, {"downscale_factor": 0}, "--downscale-factor is 0; give 1 or more"),
        ({}, {"train_split_fraction": 1.5}, r"--train-split-fraction is 1.5; give a share in \(0, 1\]"),
        ({}, {"colmap": "sparse/0", "eval_interval": 1}, "--eval-interval is 1; give 2 or more"),
        ({}, {"scale_factor": -1.0}, "--scale-factor is -1.0; give a positive number"),
    ],
)
def test_captures_and_options_that_cannot_be_used(capture, load, edit, edits, options, cause):
    edit(capture, **edits)
    with pytest.raises((ConfigError, DataError), match=f"^.*({cause}).*$"):
        load(capture, **options).next_train(0)


@pytest.mark.parametrize("scaled", [True, False])
def test_cameras_at_one_place_have_no_scale(capture, load, edit, caplog, scaled):
    frames = meta_of(capture)["frames"]
    edit(capture, frames=[{**frame, "transform_matrix": frames[0]["transform_matrix"]} for frame in frames])
    if scaled:
        with pytest.raises(DataError, match="stand at one place, .* for a panorama, give --auto-scale-poses False"):
            load(capture)
    else:
        load(capture, auto_scale_poses=False)
        assert "all cameras stand at one place" in caplog.text


def test_what_needs_test_views_says_so(capture, load, edit):
    """ns-eval asks for batches, ns-render for cameras; training and ns-viewer need neither."""
    edit(capture, val_filenames=[], test_filenames=[])
    made = load(capture)
    assert not made.eval_dataset
    assert made.next_train(0)[1]["image"].shape == (SIDE, SIDE, 3)
    for needed in (
        lambda: made.fixed_indices_eval_dataloader,
        lambda: len(made.eval_dataset.cameras),
        lambda: made.eval_dataset.cameras.fx[0],
        lambda: FixedIndicesEvalDataloader(input_dataset=made.eval_dataset, device="cpu"),
    ):
        with pytest.raises(DataError, match="too few test views to measure or render; give ns-render --pose-source"):
            needed()


def test_a_path_between_test_views_needs_two(capture, load, edit, monkeypatch):
    first = meta_of(capture)["test_filenames"][:1]
    edit(capture, val_filenames=first, test_filenames=first)
    for words, few in ((["dataset"], False), (["interpolate"], True)):
        monkeypatch.setattr("sys.argv", ["ns-render", *words])
        with pytest.raises(DataError, match="too few test views") if few else nullcontext():
            assert len(load(capture).eval_dataset.cameras) == 1
