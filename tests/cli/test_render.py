"""``sundae render``: images, videos, and refusals in one line."""

import dataclasses
import itertools
import json
from functools import partial

import av
import command_line
import numpy as np
import pytest
import torch
from PIL import Image

import sundae_ns as sn

VIEWS = [sn.Camera.look_at((x, -2.0, 0.5), (0.5, 0.5, 0.5), fov=60.0, width=41, height=31) for x in (0.5, 1.3)]
POSE = [*VIEWS[0].pose.tolist(), [0.0, 0.0, 0.0, 1.0]]
run = partial(command_line.run, "render")


def write_json(path, **content):
    path.write_text(json.dumps(content))
    return path


def pixels(path):
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def frames_of(path):
    with av.open(str(path)) as container:
        return list(container.decode(video=0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A scene without views as ``.ply``, and with two of odd sides as ``.sundae``."""
    folder = tmp_path_factory.mktemp("scenes")
    scene = sn.Scene.from_points(*torch.rand(2, 100, 3, generator=torch.Generator().manual_seed(0)))
    sn.save(dataclasses.replace(scene, up=(0.0, 0.0, 1.0)), folder / "cloud.ply")
    sn.save(dataclasses.replace(scene, cameras=tuple(VIEWS)), folder / "packed.sundae")
    return folder


@pytest.mark.parametrize("index", [0, 1])
def test_an_image_of_a_stored_view(folder, tmp_path, index):
    out = tmp_path / "a.png"
    assert run(folder / "packed.sundae", "-o", out, "--view", index) == 0
    scene = sn.load(folder / "packed.sundae")
    expected = (255 * sn.render(scene, scene.cameras[index]).rgb).round().byte().numpy()
    assert expected.std() > 5
    assert np.array_equal(pixels(out), expected)
    words = (folder / "cloud.ply", "--cameras", folder / "packed.sundae", "-o", out, "--view", index)
    assert run(*words, "--overwrite") == 0
    assert np.abs(pixels(out).astype(int) - expected).mean() < 5  # of packing


def test_an_image_of_the_camera_in_a_file(folder, tmp_path, capsys):
    lens, out = {"fl_x": 40.0, "fl_y": 40.0, "cx": 20.0, "cy": 15.0, "w": 40, "h": 30}, tmp_path / "a.jpg"
    camera = write_json(tmp_path / "camera.json", **lens, frames=[{"transform_matrix": POSE}])
    assert run(folder / "cloud.ply", "--cameras", camera, "-o", out) == 0
    assert capsys.readouterr().out == f"{out}: 40 x 30 px\n"
    scene = sn.load(folder / "cloud.ply")
    expected = 255 * sn.render(scene, sn.cameras_of(camera, scene)[0]).rgb.numpy()
    assert np.abs(pixels(out) - expected).mean() < 10  # of JPEG
    assert run(folder / "cloud.ply", "--cameras", camera, "-o", tmp_path / "b.png", "--width", 80) == 0
    assert pixels(tmp_path / "b.png").shape == (60, 80, 3)
    # Without a camera it is seen from the front.
    assert run(folder / "cloud.ply", "-o", tmp_path / "a.webp", "--width", 64) == 0
    assert pixels(tmp_path / "a.webp").shape == (48, 64, 3)


def test_a_video_has_a_frame_for_each_camera_and_even_sides(folder, tmp_path, capsys):
    out, cameras = tmp_path / "a.mp4", [{"camera_to_world": sum(POSE, []), "fov": 60}] * 5
    size = {"render_width": 41, "render_height": 31}
    words = (folder / "cloud.ply", "--cameras", write_json(tmp_path / "a.json", **size, camera_path=cameras, fps=10))
    assert run(*words, "-o", out) == 0
    assert capsys.readouterr().out == f"{out}: 5 frames of 40 x 30 px, 0.5 s\n"
    assert [(frame.width, frame.height) for frame in frames_of(out)] == [(40, 30)] * 5
    assert run(*words, "-o", out, "--fps", 5, "--overwrite") == 0
    assert capsys.readouterr().out == f"{out}: 5 frames of 40 x 30 px, 1.0 s\n"
    assert run(*words, "-o", out, "--seconds", 9, "--overwrite") == 2


@pytest.mark.parametrize("name", ["packed.sundae", "cloud.ply"])
def test_a_film_without_a_camera_path(folder, tmp_path, capsys, name):
    out = tmp_path / "a.mp4"
    assert run(folder / name, "-o", out, "--width", 63, "--seconds", 0.5, "--fps", 10, "--up", 0, 0, 1) == 0
    shown = {"packed.sundae": (62, 48), "cloud.ply": (62, 34)}[name]
    assert capsys.readouterr().out == f"{out}: 5 frames of {shown[0]} x {shown[1]} px, 0.5 s\n"
    frames = [frame.to_ndarray(format="rgb24").astype(int) for frame in frames_of(out)]
    assert [frame.shape[1::-1] for frame in frames] == [shown] * 5
    assert min(frame.std() for frame in frames) > 5
    assert min(np.abs(one - other).mean() for one, other in itertools.pairwise(frames)) > 1
    assert run(folder / name, "-o", out, "--width", 2, "--seconds", 0.1, "--overwrite") == 0


def test_an_image_is_that_of_the_start_view(folder, tmp_path):
    scene = sn.load(folder / "packed.sundae")
    sn.save(dataclasses.replace(scene, start=scene.cameras[1].zoomed(2)), tmp_path / "a.sundae")
    assert run(tmp_path / "a.sundae", "-o", tmp_path / "a.png") == 0
    assert pixels(tmp_path / "a.png").shape == (62, 82, 3)
    assert run(tmp_path / "a.sundae", "-o", tmp_path / "b.png", "--view", 0) == 0
    given = "--cameras", folder / "packed.sundae", "--start-view", 1
    assert run(folder / "packed.sundae", "-o", tmp_path / "c.png", *given) == 0
    assert pixels(tmp_path / "b.png").shape == pixels(tmp_path / "c.png").shape == (31, 41, 3)
