"""Images of the model: its outputs, made when they are read, crops, other scales, full memory, and recorded frames."""

import copy
import logging
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from threading import Barrier
from types import SimpleNamespace

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.utils import colormaps

from sundae_ns.core.errors import BackendError, MemoryExhaustedError
from sundae_ns.core.gaussians import Gaussians
from sundae_ns.cuda.cuda_graphs import RECORD_AT
from sundae_ns.head.head import resize
from sundae_ns.scene import frames
from sundae_ns.scene.frames import FrameReplay, Later, LazyOutputs
from sundae_ns.scene.render import GaussianSource, render_view

N = 60
"""Gaussians of a model that is built without a count."""
VIEWER_KEYS = {"rgb": 3, "base_rgb": 3, "depth": 1, "accumulation": 1, "features": 3, "response": 1, "background": 3}


@pytest.fixture
def model(build, perturb):
    return perturb(build()).eval()


@pytest.mark.parametrize("size", [(30, 30), (31, 47), (97, 33)])
@pytest.mark.parametrize("mode", ["residual", "features", "off"])
@torch.no_grad()
def test_every_output_can_be_shown(build, perturb, camera, mode, size):
    model = perturb(build(head={"mode": mode})).eval()
    outputs = model.get_outputs_for_camera(camera(*size))
    assert {name: (*size[::-1], count) for name, count in VIEWER_KEYS.items()} == {
        k: v.shape for k, v in outputs.items()
    }
    for name, value in outputs.items():
        assert value.dtype == torch.float32, name
        assert torch.isfinite(value).all(), name
        shown = colormaps.apply_colormap(value, colormaps.ColormapOptions(normalize=name == "depth"))
        assert shown.shape == (size[1], size[0], 3)
    for name in ("rgb", "base_rgb", "accumulation", "features", "response"):
        assert ((outputs[name] >= 0) & (outputs[name] <= 1)).all(), name
    assert outputs["response"].max() > 0
    assert (outputs["features"].std() > 0) == (mode != "off")


@torch.no_grad()
def test_depth_is_splatted_when_it_is_looked_at(build, perturb, camera, monkeypatch):
    """The same depth as in one pass with the colours, of what was drawn: in a box, of what lies in the box."""
    model = perturb(build(head={"mode": "residual"})).eval()
    box = OrientedBox(torch.eye(3), torch.tensor([0.0, 0.0, 0.0]), torch.tensor([1.0, 1.0, 1.0]))
    cam, background = model.camera_of(camera()), model._get_background_color()
    rasterise, passes = model.backend.rasterize, []
    monkeypatch.setattr(model.backend, "rasterize", lambda inputs: passes.append(inputs) or rasterise(inputs))
    found = []
    for crop in (None, box):
        outputs = model.get_outputs_for_camera(camera(), crop)
        assert outputs["rgb"].shape[-1] == 3
        assert [p.render_depth for p in passes] == [False]
        inside = slice(None) if crop is None else crop.within(model.means).squeeze(-1)
        part = GaussianSource(Gaussians({k: v[inside] for k, v in model.state.gaussians.items()}))
        images, _ = render_view(part, cam, background, model.render_settings(training=False))
        seen = images["accumulation"] > 0
        passes.clear()
        found.append(outputs["depth"])
        assert [p.render_depth for p in passes] == [True]
        torch.testing.assert_close(found[-1][seen], images["depth"][seen])
        passes.clear()
    assert not torch.equal(*found)


@torch.no_grad()
def test_a_crop_without_primitives_has_the_same_keys(model, camera):
    whole = model.get_outputs_for_camera(camera())
    far = OrientedBox.from_params((50.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    empty = model.get_outputs_for_camera(camera(), obb_box=far)
    assert [(name, value.shape) for name, value in empty.items()] == [(n, v.shape) for n, v in whole.items()]
    assert torch.equal(empty["rgb"], empty["background"])
    assert not empty["accumulation"].any()
    half = OrientedBox.from_params((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), (2.0, 9.0, 9.0))
    cropped = model.get_outputs_for_camera(camera(), obb_box=half)
    assert 0 < cropped["accumulation"].sum() < whole["accumulation"].sum()
    assert torch.equal(model.get_outputs_for_camera(camera())["rgb"], whole["rgb"])


@torch.no_grad()
def test_without_the_head_the_picture_is_the_base_exactly(model, camera):
    on = model.get_outputs_for_camera(camera())
    assert (on["rgb"] - on["base_rgb"]).abs().max() > 1e-3
    settings = model.render_settings(training=False).without_head()
    off, _ = render_view(model.source, model.camera_of(camera()), on["background"], settings)
    assert torch.equal(off["rgb"], off["base_rgb"])
    # With features in the same pass the sums are taken in another order.
    torch.testing.assert_close(off["base_rgb"], on["base_rgb"], atol=1e-6, rtol=0)
    model.step = 3
    before = model.get_outputs_for_camera(camera())
    assert torch.equal(before["rgb"], before["base_rgb"])


@torch.no_grad()
def test_residual_head_starts_at_the_base_and_features_head_does_not_need_it(build, camera):
    residual, features = build(), build(head={"mode": "features"})
    residual.step = features.step = 10
    outputs = residual.eval().get_outputs_for_camera(camera())
    torch.testing.assert_close(outputs["rgb"], outputs["base_rgb"])
    first = features.eval().get_outputs_for_camera(camera())
    features.gauss_params["features_dc"].data.zero_()
    second = features.get_outputs_for_camera(camera())
    assert not torch.equal(first["base_rgb"], second["base_rgb"])
    assert torch.equal(first["rgb"], second["rgb"])


@pytest.mark.parametrize("mode", ["residual", "features"])
@pytest.mark.parametrize("factor", [1.0, 3.0])
@torch.no_grad()
def test_background_shows_where_nothing_is(build, perturb, camera, mode, factor):
    """Whatever the head has learnt, at its own scale and at another one."""
    model = perturb(build(head={"mode": mode})).eval()
    model.step, model.state.trained_focal = 10_000, (30.0, 30.0)
    assert model.state.head_enabled
    model.set_background(torch.tensor([0.2, 0.4, 0.6]))
    model.gauss_params["means"].data += 100.0
    picture = model.get_outputs_for_camera(at_focal(camera, factor))["rgb"]
    torch.testing.assert_close(picture, torch.tensor([0.2, 0.4, 0.6]).expand_as(picture))


@torch.no_grad()
def test_what_features_make_lies_over_the_background(build, perturb, camera):
    """Once, by accumulation: between two backgrounds the picture differs by what shines through."""
    model = perturb(build(head={"mode": "features"})).eval()
    model.step = 10_000
    model.gauss_params["opacities"].data -= 3.0
    images = []
    for value in (0.25, 0.75):
        model.set_background(torch.full((3,), value))
        images.append(model.get_outputs_for_camera(camera()))
    dark, light, alpha = images[0]["rgb"], images[1]["rgb"], images[0]["accumulation"]
    inside = ((dark > 0) & (light < 1)).all(dim=-1, keepdim=True) & (alpha > 0.01) & (alpha < 0.99)
    assert inside.sum() > 50
    torch.testing.assert_close((light - dark)[inside[..., 0]], (0.5 * (1 - alpha))[inside].expand(3, -1).T)


def at_focal(camera, factor):
    """The test camera, its picture magnified."""
    small = camera()
    sides = {"width": round(40 * factor), "height": round(32 * factor)}
    center = {"cx": 20.0 * factor, "cy": 16.0 * factor}
    return Cameras(small.camera_to_worlds, fx=30.0 * factor, fy=30.0 * factor, **center, **sides)


@pytest.mark.parametrize("mode", ["residual", "features"])
def test_other_scales_get_the_correction_of_the_trained_one(build, perturb, camera, mode):
    model = perturb(build(head={"mode": mode}, background_color="black")).eval()
    model.state.trained_focal = (30.0, 30.0)
    own = model.get_outputs(camera())
    correction = own["rgb"] - own["base_rgb"]
    assert correction.abs().max() > 1e-3
    double = model.get_outputs(at_focal(camera, 2))
    expected = (double["base_rgb"] + resize(correction, 64, 80)).clamp(0, 1)
    torch.testing.assert_close(double["rgb"], expected, atol=1e-5, rtol=0)
    # Within the tolerance the head sees the picture itself.
    model.state.trained_focal = (300.0, 300.0)
    near = model.get_outputs(at_focal(camera, 10.05))
    model.state.trained_focal = None
    assert torch.equal(near["rgb"], model.get_outputs(at_focal(camera, 10.05))["rgb"])


def test_the_head_remembers_its_scale(build, training_of):
    training = training_of(build(background_color="black"))
    for step in range(4):
        training.step(step)
    assert training.model.state.trained_focal is None  # the head took no part so far
    training.step(4)
    assert training.model.state.trained_focal == (30.0, 30.0)
    other = build(background_color="black")
    other.load_state_dict(training.model.state_dict())
    assert other.state.trained_focal == (30.0, 30.0)


class FullBackend:
    """A rasteriser on a device without room."""

    name = "full"

    def rasterize(self, *_, **__):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.50 GiB. GPU 0 has a total ...")

    def spherical_harmonics(self, degree, directions, coeffs):
        return torch.zeros_like(directions)


@pytest.mark.parametrize("training", [True, False], ids=["training", "rendering"])
def test_full_memory_says_how_much_and_what_to_try(build, camera, training):
    model = build().train(training)
    model.backend = FullBackend()
    options = f"cache-images cpu .*camera-res-scale-factor .*max-gaussians {N // 2}"
    with pytest.raises(MemoryExhaustedError, match=rf"cannot allocate 2\.50 GiB more with {N} Gaussians; .*{options}"):
        model.get_outputs_for_camera(camera())


def test_outputs_that_nobody_asks_for_cost_nothing(model, camera, monkeypatch):
    splatted = []
    rendering = sys.modules["sundae_ns.scene.render"]  # its name is also that of a function
    rasterize = rendering.rasterize
    monkeypatch.setattr(rendering, "rasterize", lambda *a, **kwargs: splatted.append(1) or rasterize(*a, **kwargs))
    outputs = model.get_outputs_for_camera(camera())
    assert outputs["rgb"].shape == outputs["base_rgb"].shape
    assert (len(splatted), model._response._last[0]) == (1, None)
    assert outputs["response"].max() > 0
    assert len(splatted) == 2


def test_outputs_belong_to_the_field_that_was_rendered(model, camera):
    before = {name: value.clone() for name, value in model.get_outputs_for_camera(camera()).items()}
    outputs = model.get_outputs_for_camera(camera())
    with torch.no_grad():  # a prune, while another thread still shows the picture
        for name, value in model.gauss_params.items():
            model.gauss_params[name] = torch.nn.Parameter(value[::2].clone())
        model.state.pruning["num_prunes"] += 1
    assert {name for name, value in outputs.items() if not torch.equal(value, before[name])} == set()
    after = model.get_outputs_for_camera(camera())
    assert not torch.equal(after["response"], before["response"])


@torch.no_grad()
@pytest.mark.parametrize("n", [1, 5])
def test_one_primitive_has_no_response_to_show_and_few_have_one(build, camera, n):
    picture = build(n=n).eval().get_outputs_for_camera(camera())["response"]
    assert picture.isfinite().all()
    assert bool(picture.any()) == (n > 1)


def test_an_output_is_made_once_by_every_way_to_it_and_without_gradients():
    calls, weight = [], torch.ones(1, requires_grad=True)

    def make(name):
        calls.append(name)
        return 2 * weight

    outputs = LazyOutputs(rgb="RGB", depth=Later(lambda: make("depth")), features=Later(lambda: make("features")))
    for look in (dict, lambda o: {**o}, lambda o: dict(o.items()), lambda o: dict(zip(o, o.values(), strict=True))):
        assert look(copy.copy(outputs)) == {"rgb": "RGB", "depth": 2, "features": 2}
    assert isinstance(outputs.data["depth"], Later)
    calls.clear()
    assert not any(value.requires_grad for value in (outputs["depth"], outputs["depth"], outputs.get("depth")))
    assert calls == ["depth"]
    assert outputs.pop("depth") == 2
    assert list(outputs) == ["rgb", "features"]


def test_two_threads_get_values():
    barrier = Barrier(2, timeout=10)  # both are in it before either has its value
    outputs = LazyOutputs(x=Later(lambda: barrier.wait() >= 0))
    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(lambda _: outputs["x"], range(2))) == [True, True]


class Recorder:
    """In place of the GPU's: what it plays is rendered anew, and it notes what it was asked for."""

    def __init__(self):
        self.recorded = []
        self.played = 0
        self.needed = 100
        self.fails = None

    def record(self, source, _, __, settings, capacity=None):
        if self.fails is not None:
            raise self.fails
        self.recorded.append(capacity)

        def show(camera, background):
            shown = render_view(source, camera, background, settings, depth=False)[0]
            return {name: shown[name] for name in frames.REPLAYED}

        return SimpleNamespace(show=show, capacity=capacity or 120)

    def play(self, recording, camera, background):
        self.played += 1
        return recording.show(camera, background), self.needed


@pytest.fixture
def recorder(monkeypatch):
    found = Recorder()
    monkeypatch.setattr(frames, "_record", found.record)
    monkeypatch.setattr(frames, "_replay", found.play)
    monkeypatch.setattr(frames, "_recordable", lambda source, settings: source.replayable)
    return found


def test_a_size_that_stays_is_recorded_and_played_back(build, perturb, camera, recorder):
    model = perturb(build(background_color="black")).eval()
    shown = [model.get_outputs_for_camera(camera(shift=0.1 * i))["rgb"] for i in range(RECORD_AT + 2)]
    assert (len(recorder.recorded), recorder.played) == (1, 3)
    model._replay = FrameReplay()
    for i, picture in enumerate(shown):
        assert torch.equal(picture, model.get_outputs_for_camera(camera(shift=0.1 * i))["rgb"])
        model.get_outputs_for_camera(camera(width=20 + i))


def test_what_a_recording_has_fixed_makes_another_one(model, camera, recorder):
    def show(**options):
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


def test_a_view_of_more_pairs_than_there_is_room_for_is_recorded_again(model, camera, recorder):
    for _ in range(RECORD_AT):
        model.get_outputs_for_camera(camera())
    recorder.needed = 121
    outputs = model.get_outputs_for_camera(camera())
    assert recorder.recorded == [None, int(frames.SPARE_CAPACITY * 121)]
    assert outputs["rgb"].shape == (32, 40, 3)
    recorder.needed = 150
    model.get_outputs_for_camera(camera())
    assert len(recorder.recorded) == 2


def test_one_thread_plays_at_a_time(model, camera, recorder, monkeypatch):
    inside, most, play = [0], [0], recorder.play

    def slowly(*arguments):
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
def test_what_cannot_be_recorded_is_rendered_and_said_once(model, camera, recorder, caplog, error):
    recorder.fails = error
    with caplog.at_level(logging.WARNING):
        shown = [model.get_outputs_for_camera(camera())["rgb"] for _ in range(2 * RECORD_AT)]
    assert caplog.text.count("cannot be recorded") == 1
    assert all(torch.equal(picture, shown[0]) for picture in shown)


def test_a_part_of_a_field_is_never_recorded(model, camera, recorder, monkeypatch):
    """Its tensors are gone with the frame."""
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


def test_nothing_is_recorded_on_a_cpu_or_in_training(model, camera, monkeypatch):
    monkeypatch.delattr(frames, "_record")
    for _ in range(2 * RECORD_AT):
        model.get_outputs_for_camera(camera())
    source, empty = (GaussianSource(Gaussians({"means": torch.zeros(n, 3)})) for n in (1, 0))
    settings = model.render_settings(training=False)
    settings = replace(settings, backend=SimpleNamespace(name="gsplat"))
    with torch.no_grad():
        assert frames._recordable(source, settings)
        assert not frames._recordable(empty, settings)
        assert not frames._recordable(source, replace(settings, training=True))
        assert not frames._recordable(GaussianSource(source.gaussians, whole=False), settings)
    assert not frames._recordable(source, settings)  # with gradients


def eager(model, camera):
    model._replay = FrameReplay()
    outputs = model.get_outputs_for_camera(camera)
    assert len(model._replay._frames) == 0
    return {name: outputs[name] for name in frames.REPLAYED}


@pytest.mark.gpu
@pytest.mark.parametrize("head", [{}, {"precision": "fp32"}, {"mode": "features"}, {"mode": "off"}])
@pytest.mark.parametrize("focal", [None, 12.0])
def test_what_is_played_back_is_what_would_be_rendered(build, perturb, camera, head, focal):
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
def test_what_is_trained_meanwhile_is_seen(build, perturb, camera):
    model = perturb(build(n=500)).cuda().eval()
    before = [model.get_outputs_for_camera(camera())["rgb"] for _ in range(RECORD_AT + 1)][-1]
    with torch.no_grad():
        model.gauss_params["features_dc"] += 0.5
        for value in model.head.parameters():
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
def test_a_view_of_many_more_pairs(build, perturb, camera):
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
