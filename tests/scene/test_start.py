"""Start view and up axis of a scene: who states them, who keeps them, and what readers refuse."""

from __future__ import annotations

import base64
import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import run
from short_prunes import short_prunes  # noqa: F401

import sundae_ns as sn
from sundae_ns.core.errors import ConfigError, DataError
from sundae_ns.io.pack import container
from sundae_ns.plugin.distill import distill
from sundae_ns.scene.cameras import camera_in_front, with_start
from sundae_ns.scene.packing import start_of, stated_start
from sundae_ns.scene.page import render_first
from sundae_ns.scene.scene import image_of

UP = (0.6, 0.0, -0.8)


def scene(**options: Any) -> sn.Scene:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(80, 3, generator=generator)
    cameras = tuple(sn.Camera.look_at((0.5 + dx, -2.0, 0.5), (0.5, 0.5, 0.5), width=40, height=30) for dx in (0.0, 0.8))
    return dataclasses.replace(sn.Scene.from_points(points, points), cameras=cameras, **options)


def started() -> sn.Scene:
    return scene(up=UP, start=sn.Camera.look_at((3, 0.5, 0.5), (0.5, 0.5, 0.5), UP, fov=70, width=64, height=48))


def same(one: sn.Scene, other: sn.Scene) -> bool:
    assert one.start is not None
    assert other.start is not None
    alike = all(torch.allclose(a, b, atol=1e-6) for a, b in zip(one.start[:2], other.start[:2], strict=True))
    return alike and one.start[2:] == pytest.approx(other.start[2:]) and one.up == pytest.approx(other.up)


@pytest.mark.usefixtures("short_prunes")
def test_files_and_scenes_made_of_a_scene_keep_both(tmp_path: Path) -> None:
    truth = started()
    sn.save(truth, tmp_path / "a.sundae")
    found = sn.load(tmp_path / "a.sundae")
    assert same(found, truth)
    assert same(sn.prune(found, keep=0.5), truth)
    assert same(distill(found, keep=0.5, steps=1, head=False, size=16), truth)
    assert run("prune", tmp_path / "a.sundae", "-o", tmp_path / "b.sundae") == 0
    assert same(sn.load(tmp_path / "b.sundae"), truth)


def test_a_file_without_them_is_read_and_adds_nothing(tmp_path: Path) -> None:
    sn.save(scene(), tmp_path / "a.sundae")
    header = container.read_header(tmp_path / "a.sundae")
    assert header.meta.keys().isdisjoint({"up", "start"})
    found = sn.load(tmp_path / "a.sundae")
    assert (found.up, found.start) == (None, None)


def test_the_first_image_is_that_of_the_start_view() -> None:
    shown = started()
    assert shown.start is not None
    expected = image_of(sn.render(shown, shown.start).rgb)
    assert np.array_equal(np.asarray(render_first(shown)), np.asarray(expected))
    assert np.asarray(render_first(scene())).shape == (30, 40, 3)


@pytest.mark.parametrize("up", [None, UP, (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (-0.95, 0.3122499, 0.0)])
def test_the_camera_in_front_stands_upright(up: Any) -> None:
    camera = camera_in_front(scene(up=up))
    wanted = torch.tensor(up or (0.0, 0.0, 1.0))
    assert torch.allclose(camera.pose[:, 1], wanted, atol=1e-5)
    if up is None:
        assert torch.allclose(camera.pose[:, 2], torch.tensor([0.0, -1.0, 0.0]), atol=1e-6)


def camera_file(path: Path) -> Path:
    frame = {"transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]}
    camera = {"fl_x": 50, "fl_y": 50, "cx": 32, "cy": 24, "w": 64, "h": 48, "frames": [frame]}
    path.write_text(json.dumps(camera))
    return path


def test_options_name_a_view_or_a_file(tmp_path: Path) -> None:
    plain = scene()
    assert with_start(plain, None, None) is plain
    assert with_start(plain, "1", None).start is plain.cameras[1]
    found = with_start(plain, str(camera_file(tmp_path / "camera.json")), (0, 0, -5))
    assert found.start is not None
    assert found.start.center.tolist() == [0, 0, 3]
    assert found.up == (0, 0, -1)
    for start_view, up, message in (
        ("2", None, "there is no camera 2 in the scene; give --start-view 0 to 1, or a camera file"),
        ("-1", None, "there is no camera -1"),
        (None, (0, 0, 0), "no direction"),
    ):
        with pytest.raises(ConfigError, match=message):
            with_start(plain, start_view, up)
    with pytest.raises(DataError):
        with_start(plain, str(tmp_path / "none.json"), None)
    with pytest.raises(ConfigError, match="no camera 0 in the scene; give a camera file"):
        with_start(dataclasses.replace(plain, cameras=()), "0", None)


def test_values_that_readers_refuse_are_not_written(tmp_path: Path) -> None:
    far = sn.Camera.look_at((2e9, 0, 0), (0, 0, 0))
    for wrong in (far, far._replace(viewmat=torch.zeros(4, 4)), far.zoomed(1e6)):
        with pytest.raises(ConfigError, match="has values that readers refuse"):
            sn.save(scene(start=wrong), tmp_path / "a.sundae")
    assert not list(tmp_path.iterdir())
    assert start_of(stated_start(started()))[0] == pytest.approx(UP)


def test_commands_state_them_without_coding_the_scene_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sn.save(scene(), tmp_path / "a.sundae")
    words = ("--start-view", 1, "--up", 0, -2, 0)
    assert run("export", tmp_path / "a.sundae", "-o", tmp_path / "site", *words) == 0
    before, after = (tmp_path / name for name in ("a.sundae", "site/scene.sundae"))
    found = sn.load(after)
    assert found.up == (0, -1, 0)
    assert found.start is not None
    assert torch.allclose(found.start.viewmat, scene().cameras[1].viewmat, atol=1e-6)
    one, other = (container.read_sections(path, container.read_header(path)) for path in (before, after))
    assert all(np.array_equal(one[name], other[name]) for name in (*one, *other))
    assert run("export", after, "-o", tmp_path / "a.html") == 0
    (code,) = re.findall(r'id="scene"[^>]*>([^<]*)</script>', (tmp_path / "a.html").read_text())
    assert base64.b64decode(code) == after.read_bytes()
    sn.save(scene(), tmp_path / "a.ply")
    camera = camera_file(tmp_path / "camera.json")
    packed = tmp_path / "b.sundae"
    assert run("pack", tmp_path / "a.ply", "-o", packed, "--start-view", camera, "--up", 0, -1, 0) == 0
    found = sn.load(packed)
    assert found.up == (0, -1, 0)
    assert found.start is not None
    assert found.start.center.tolist() == [0, 0, 3]
    capsys.readouterr()
    for words in (
        ("export", tmp_path / "a.sundae", "-o", tmp_path / "b.spz", "--up", 0, 0, 1),
        ("export", tmp_path / "a.sundae", "-o", tmp_path / "b.html", "--start-view", 7),
        ("pack", tmp_path / "a.ply", "-o", tmp_path / "c.sundae", "--start-view", 0),
    ):
        assert run(*words) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert line.startswith("sundae: ")
    assert not {"b.spz", "b.html", "c.sundae"} & {path.name for path in tmp_path.iterdir()}
