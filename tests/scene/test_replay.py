"""Replays of frames: when they are recorded, here by a fake recorder, and on a GPU their images."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from torch import Tensor

from sundae_ns.core.camera import Camera
from sundae_ns.core.errors import BackendError
from sundae_ns.core.gaussians import Gaussians
from sundae_ns.cuda.cuda_graphs import RECORD_AT
from sundae_ns.plugin.model import SundaeModel
from sundae_ns.rasterize.gsplat_backend import RecordableGsplat
from sundae_ns.rasterize.gsplat_kernels import Capacity
from sundae_ns.scene import frames
from sundae_ns.scene.frames import FrameReplay
from sundae_ns.scene.render import GaussianSource, RenderSettings, render_view

Build = Callable[..., SundaeModel]
Perturb = Callable[[SundaeModel], SundaeModel]
MakeCamera = Callable[..., Cameras]


class Recorder:
    """In place of the GPU's: what it plays is rendered anew, and it notes what it was asked for."""

    def __init__(self) -> None:
        self.recorded: list[int | None] = []
        self.played = 0
        self.needed = 100
        self.fails: Exception | None = None

    def record(
        self,
        source: GaussianSource,
        camera: Camera,
        background: Tensor,
        settings: RenderSettings,
        capacity: int | None = None,
    ) -> Any:
        if self.fails is not None:
            raise self.fails
        self.recorded.append(capacity)
        shown = {}

        def show(camera: Camera, background: Tensor) -> dict[str, Tensor]:
            shown.update(render_view(source, camera, background, settings, depth=False)[0])
            return {name: shown[name] for name in frames.REPLAYED}

        return SimpleNamespace(show=show, capacity=capacity or 120)

    def play(self, recording: Any, camera: Camera, background: Tensor) -> tuple[dict[str, Tensor], int]:
        self.played += 1
        return recording.show(camera, background), self.needed


@pytest.fixture
def recorder(monkeypatch: pytest.MonkeyPatch) -> Recorder:
    found = Recorder()
    monkeypatch.setattr(frames, "_record", found.record)
    monkeypatch.setattr(frames, "_replay", found.play)
    monkeypatch.setattr(frames, "_recordable", lambda source, settings: source.replayable)
    return found


def test_a_size_that_stays_is_recorded_and_played_back(
    build: Build, perturb: Perturb, camera: MakeCamera, recorder: Recorder
) -> None:
    model = perturb(build(background_color="black")).eval()
    shown = [model.get_outputs_for_camera(camera(shift=0.1 * i))["rgb"] for i in range(RECORD_AT + 2)]
    assert (len(recorder.recorded), recorder.played) == (1, 3)
    model._replay = FrameReplay()
    for i, picture in enumerate(shown):
        assert torch.equal(picture, model.get_outputs_for_camera(camera(shift=0.1 * i))["rgb"])
        model.get_outputs_for_camera(camera(width=20 + i))


def test_what_a_recording_has_fixed_makes_another_one(
    build: Build, perturb: Perturb, camera: MakeCamera, recorder: Recorder
) -> None:
    model = perturb(build()).eval()

    def show(**options: Any) -> int:
        for _ in range(RECORD_AT):
            model.get_outputs_for_camera(camera(**options))
        return len(recorder.recorded)

    assert show() == 1
    assert show(width=41) == 2
    assert show(height=33) == 3
    model.compensated = False
    assert show() == 4
    model.compensated = True
    assert model.head is not None
    model.head.config = replace(model.head.config, precision="fp32")
    assert show() == 5
    model.state.trained_focal = (10.0, 10.0)  # the camera's is 30: the head runs at another scale
    assert show() == 6
    with torch.no_grad():
        model.gauss_params["means"] = torch.nn.Parameter(model.gauss_params["means"].clone())
    assert show() == 7
    assert len(model._replay._frames) == 1
    model.step = 0  # fewer bands of the harmonics take part
    assert show() == 8
    model.config.rasterize_mode = "antialiased"
    assert show() == 9
    model.step = 10
    assert show() == 10  # those of a field that is gone hold memory for nothing


def test_a_view_of_more_pairs_than_there_is_room_for_is_recorded_again(
    build: Build, perturb: Perturb, camera: MakeCamera, recorder: Recorder
) -> None:
    model = perturb(build()).eval()
    for _ in range(RECORD_AT):
        model.get_outputs_for_camera(camera())
    recorder.needed = 121
    outputs = model.get_outputs_for_camera(camera())
    assert recorder.recorded == [None, int(frames.SPARE_CAPACITY * 121)]
    assert outputs["rgb"].shape == (32, 40, 3)
    recorder.needed = 150
    model.get_outputs_for_camera(camera())
    assert len(recorder.recorded) == 2


def test_one_thread_plays_at_a_time(
    build: Build, perturb: Perturb, camera: MakeCamera, recorder: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = perturb(build()).eval()
    inside, most, play = [0], [0], recorder.play

    def slowly(*arguments: Any) -> Any:
        inside[0] += 1
        most[0] = max(most[0], inside[0])
        time.sleep(0.02)
        made = play(*arguments)
        inside[0] -= 1
        return made

    monkeypatch.setattr(frames, "_replay", slowly)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda _: model.get_outputs_for_camera(camera())["rgb"], range(12)))
    assert (most[0], recorder.played) == (1, 10)


@pytest.mark.parametrize("error", [BackendError("no compiler: install one"), torch.cuda.OutOfMemoryError("full")])
def test_what_cannot_be_recorded_is_rendered_and_said_once(
    build: Build,
    perturb: Perturb,
    camera: MakeCamera,
    recorder: Recorder,
    caplog: pytest.LogCaptureFixture,
    error: Exception,
) -> None:
    model = perturb(build()).eval()
    recorder.fails = error
    with caplog.at_level(logging.WARNING):
        shown = [model.get_outputs_for_camera(camera())["rgb"] for _ in range(2 * RECORD_AT)]
    assert caplog.text.count("cannot be recorded") == 1
    assert all(torch.equal(picture, shown[0]) for picture in shown)


def test_a_part_of_a_field_is_never_recorded(
    build: Build, perturb: Perturb, camera: MakeCamera, recorder: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its tensors are gone with the frame."""
    model = perturb(build()).eval()
    box = OrientedBox.from_params((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    for _ in range(2 * RECORD_AT):
        cropped = model.get_outputs_for_camera(camera(), obb_box=box)["rgb"]
    mask = torch.arange(60) % 2 == 0
    half = SimpleNamespace(gaussians=model.state.gaussians.rows(mask), decision=SimpleNamespace(mask=mask))
    monkeypatch.setattr(model.viewer_controls, "preview", lambda: half)
    for _ in range(2 * RECORD_AT):
        previewed = model.get_outputs_for_camera(camera())["rgb"]
    assert recorder.recorded == []
    monkeypatch.undo()
    whole = model.get_outputs_for_camera(camera())["rgb"]
    assert not torch.equal(cropped, whole)
    assert not torch.equal(previewed, whole)


def test_nothing_is_recorded_on_a_cpu_or_in_training(
    build: Build, perturb: Perturb, camera: MakeCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("recorded")

    monkeypatch.setattr(frames, "_record", refuse)
    model = perturb(build()).eval()
    for _ in range(2 * RECORD_AT):
        model.get_outputs_for_camera(camera())
    source, empty = (GaussianSource(Gaussians({"means": torch.zeros(n, 3)})) for n in (1, 0))
    settings = model.render_settings(training=False)
    settings = replace(settings, backend=SimpleNamespace(name="gsplat"))  # type: ignore[arg-type]
    with torch.no_grad():
        assert frames._recordable(source, settings)
        assert not frames._recordable(empty, settings)
        assert not frames._recordable(source, replace(settings, training=True))
        assert not frames._recordable(GaussianSource(source.gaussians, whole=False), settings)
    assert not frames._recordable(source, settings)  # with gradients


# ------------------------------------------------------------------------------------------------------------- on a GPU


def eager(model: SundaeModel, camera: Cameras) -> dict[str, Tensor]:
    model._replay = FrameReplay()
    outputs = model.get_outputs_for_camera(camera)
    assert len(model._replay._frames) == 0
    return {name: outputs[name] for name in frames.REPLAYED}


@pytest.mark.gpu
@pytest.mark.parametrize("head", [{}, {"precision": "fp32"}, {"mode": "features"}, {"mode": "off"}])
@pytest.mark.parametrize("focal", [None, 12.0])
def test_what_is_played_back_is_what_would_be_rendered(
    build: Build, perturb: Perturb, camera: MakeCamera, head: dict[str, Any], focal: float | None
) -> None:
    model = perturb(build(n=2000, sh_degree=3, head=head, background_color="white")).cuda().eval()
    model.step = 10_000
    if focal is not None:
        model.state.trained_focal = (focal, focal)
    cameras = [camera(width=150, height=101, shift=shift) for shift in (0.0, 0.3, -0.6, 0.1)]
    expected = [eager(model, cam) for cam in cameras]
    replayed = model._replay = FrameReplay()
    for _ in range(RECORD_AT):
        model.get_outputs_for_camera(cameras[0])
    shown = [model.get_outputs_for_camera(cam) for cam in cameras]
    assert len(replayed._frames) == 1
    assert replayed._can_record
    for found, truth in zip(shown, expected, strict=True):
        for name, picture in truth.items():
            torch.testing.assert_close(found[name], picture, rtol=0, atol=2e-3 if name == "rgb" else 1e-6)
    assert not torch.equal(shown[0]["rgb"], shown[1]["rgb"])
    assert shown[1]["depth"].isfinite().all()
    assert bool(shown[1]["features"].any()) == (head.get("mode") != "off")


@pytest.mark.gpu
def test_what_is_trained_meanwhile_is_seen(build: Build, perturb: Perturb, camera: MakeCamera) -> None:
    model = perturb(build(n=500)).cuda().eval()
    before = [model.get_outputs_for_camera(camera())["rgb"] for _ in range(RECORD_AT + 1)][-1]
    with torch.no_grad():
        model.gauss_params["features_dc"] += 0.5
        for value in model.head.parameters():  # type: ignore[union-attr]
            value += 0.02
    after = model.get_outputs_for_camera(camera())["rgb"]
    assert len(model._replay._frames) == 1
    assert not torch.equal(after, before)
    torch.testing.assert_close(after, eager(model, camera())["rgb"], rtol=0, atol=2e-3)
    with torch.no_grad():  # a prune
        for name, value in list(model.gauss_params.items()):
            model.gauss_params[name] = torch.nn.Parameter(value[::2].clone())
    for _ in range(RECORD_AT):
        pruned = model.get_outputs_for_camera(camera())["rgb"]
    torch.testing.assert_close(pruned, eager(model, camera())["rgb"], rtol=0, atol=2e-3)


@pytest.mark.gpu
def test_a_view_of_many_more_pairs(build: Build, perturb: Perturb, camera: MakeCamera) -> None:
    model = perturb(build(n=3000)).cuda().eval()
    far, near = camera(width=640, height=480, shift=300.0), camera(width=640, height=480)
    expected = eager(model, near)["base_rgb"]
    model._replay = FrameReplay()
    for _ in range(RECORD_AT):
        model.get_outputs_for_camera(far)
    (small,) = model._replay._frames._graphs.values()
    found = model.get_outputs_for_camera(near)["base_rgb"]
    (large,) = model._replay._frames._graphs.values()
    assert large.capacity > small.capacity
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)
    assert model._replay._can_record


@pytest.mark.gpu
@pytest.mark.parametrize("size", [(640, 480), (1600, 1000)])
@torch.no_grad()
def test_shorter_lists_make_the_same_picture(build: Build, camera: MakeCamera, size: tuple[int, int]) -> None:
    model = build(n=5000).cuda().eval()
    model.gauss_params["scales"] += 2 * torch.randn_like(model.gauss_params["scales"])
    cam, background = model.camera_of(camera(width=size[0], height=size[1])), torch.zeros(3, device="cuda")
    settings = model.render_settings(training=False)
    theirs = render_view(model.source, cam, background, settings)[0]
    capacity = Capacity()
    ours = render_view(model.source, cam, background, replace(settings, backend=RecordableGsplat(capacity)))[0]
    assert int(capacity.needed[0]) > 0
    for name in ("depth", "accumulation"):
        assert torch.equal(ours[name], theirs[name])
    torch.testing.assert_close(ours["base_rgb"], theirs["base_rgb"], rtol=0, atol=2e-6)  # harmonics of our own
