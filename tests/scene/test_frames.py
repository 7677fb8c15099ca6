"""Frames as viewers ask for them: outputs that are made when they are read, recorded frames, and their colours."""

import copy
import logging
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from threading import Barrier
from types import SimpleNamespace

import pytest
import torch
from nerfstudio.data.scene_box import OrientedBox

from sundae_ns.core.errors import BackendError
from sundae_ns.core.gaussians import Gaussians
from sundae_ns.cuda.cuda_graphs import RECORD_AT
from sundae_ns.scene import frames
from sundae_ns.scene.frames import FrameReplay, LazyOutputs
from sundae_ns.scene.render import GaussianSource, render_view


@pytest.fixture
def view(camera):
    """Outputs of a model from a camera, at the last of some times that it is asked for them."""

    def outputs(model, times=RECORD_AT, box=None, **options):
        return [model.get_outputs_for_camera(camera(**options), box) for _ in range(times)][-1]

    return outputs


def test_outputs_belong_to_the_field_that_was_rendered(model, view):
    before = {name: value.clone() for name, value in view(model, times=1).items()}
    outputs = view(model, times=1)
    with torch.no_grad():  # a prune, while another thread still shows the picture
        for name, value in model.gauss_params.items():
            model.gauss_params[name] = torch.nn.Parameter(value[::2].clone())
        model.state.pruning["num_prunes"] += 1
    assert {name for name, value in outputs.items() if not torch.equal(value, before[name])} == set()
    assert not torch.equal(view(model, times=1)["response"], before["response"])


def test_an_output_is_made_once_by_every_way_to_it_and_without_gradients():
    calls, weight = [], torch.ones(1, requires_grad=True)

    def make(name):
        calls.append(name)
        return 2 * weight

    outputs = LazyOutputs(rgb="RGB", depth=lambda: make("depth"), features=lambda: make("features"))
    for look in (dict, lambda o: {**o}, lambda o: dict(o.items()), lambda o: dict(zip(o, o.values(), strict=True))):
        assert look(copy.copy(outputs)) == {"rgb": "RGB", "depth": 2, "features": 2}
    assert callable(outputs.data["depth"])
    calls.clear()
    assert not any(value.requires_grad for value in (outputs["depth"], outputs["depth"], outputs.get("depth")))
    assert calls == ["depth"]
    assert outputs.pop("depth") == 2
    assert list(outputs) == ["rgb", "features"]


def test_two_threads_get_values():
    barrier = Barrier(2, timeout=10)  # both are in it before either has its value
    outputs = LazyOutputs(x=lambda: barrier.wait() >= 0)
    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(lambda _: outputs["x"], range(2))) == [True, True]


class Recorder:
    """In place of the GPU's: what it plays is rendered anew, and it notes what it was asked for."""

    def __init__(self):
        self.recorded, self.played, self.needed, self.fails = [], 0, 100, None

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


def test_a_size_that_stays_is_recorded_and_played_back(build, perturb, view, recorder):
    model = perturb(build(background_color="black")).eval()
    shown = [view(model, times=1, shift=0.1 * i)["rgb"] for i in range(RECORD_AT + 2)]
    assert (len(recorder.recorded), recorder.played) == (1, 3)
    model._replay = FrameReplay()
    for i, picture in enumerate(shown):
        assert torch.equal(picture, view(model, times=1, shift=0.1 * i)["rgb"])
        view(model, times=1, width=20 + i)


def test_what_a_recording_has_fixed_makes_another_one(model, view, recorder):
    def show(**options):
        view(model, **options)
        return len(recorder.recorded)

    assert show() == 1
    assert show(width=41) == 2
    assert show(height=33) == 3
    model.compensated = False
    assert show() == 4
    model.compensated = True
    model.head.config = replace(model.head.config, precision="fp32")
    assert show() == 5
    model.state.trained_focal = (10.0, 10.0)  # the camera's is 30: the head runs at another scale
    assert show() == 6
    with torch.no_grad():
        model.gauss_params["means"] = torch.nn.Parameter(model.gauss_params["means"].clone())
    assert show() == 7
    assert len(model._replay._frames._graphs) == 1
    model.step = 0  # fewer bands of the harmonics take part
    assert show() == 8
    model.config.rasterize_mode = "antialiased"
    assert show() == 9
    model.step = 10
    assert show() == 10  # those of a field that is gone hold memory for nothing


def test_a_view_of_more_pairs_than_there_is_room_for_is_recorded_again(model, view, recorder):
    view(model)
    recorder.needed = 121
    outputs = view(model, times=1)
    assert recorder.recorded == [None, int(frames.SPARE_CAPACITY * 121)]
    assert outputs["rgb"].shape == (32, 40, 3)
    recorder.needed = 150
    view(model, times=1)
    assert len(recorder.recorded) == 2


def test_one_thread_plays_at_a_time(model, view, recorder, monkeypatch):
    def play(*arguments):
        assert model._replay._lock.locked()
        return recorder.play(*arguments)

    monkeypatch.setattr(frames, "_replay", play)
    view(model)
    assert recorder.played == 1
    assert not model._replay._lock.locked()


@pytest.mark.parametrize("error", [BackendError("no compiler: install one"), torch.cuda.OutOfMemoryError("full")])
def test_what_cannot_be_recorded_is_rendered_and_said_once(model, view, recorder, caplog, error):
    recorder.fails = error
    with caplog.at_level(logging.WARNING):
        shown = [view(model, times=1)["rgb"] for _ in range(2 * RECORD_AT)]
    assert caplog.text.count("cannot be recorded") == 1
    assert all(torch.equal(picture, shown[0]) for picture in shown)


def test_a_part_of_a_field_is_never_recorded(model, view, recorder, monkeypatch):
    """Its tensors are gone with the frame."""
    box = OrientedBox.from_params((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    cropped = view(model, times=2 * RECORD_AT, box=box)["rgb"]
    mask = torch.arange(60) % 2 == 0
    half = SimpleNamespace(gaussians=model.state.gaussians.rows(mask), decision=SimpleNamespace(mask=mask))
    monkeypatch.setattr(model.viewer_controls, "preview", lambda: half)
    previewed = view(model, times=2 * RECORD_AT)["rgb"]
    assert recorder.recorded == []
    monkeypatch.undo()
    whole = view(model, times=1)["rgb"]
    assert not torch.equal(cropped, whole)
    assert not torch.equal(previewed, whole)


def test_nothing_is_recorded_on_a_cpu_or_in_training(model, view, monkeypatch):
    monkeypatch.delattr(frames, "_record")
    view(model, times=2 * RECORD_AT)
    source, empty = (GaussianSource(Gaussians({"means": torch.zeros(n, 3)})) for n in (1, 0))
    settings = model.render_settings(training=False)
    settings = replace(settings, backend=SimpleNamespace(name="gsplat"))
    with torch.no_grad():
        assert frames._recordable(source, settings)
        assert not frames._recordable(empty, settings)
        assert not frames._recordable(source, replace(settings, training=True))
        assert not frames._recordable(GaussianSource(source.gaussians, replayable=False), settings)
    assert not frames._recordable(source, settings)  # with gradients


def eager(model, camera):
    model._replay = FrameReplay()
    outputs = model.get_outputs_for_camera(camera)
    assert len(model._replay._frames._graphs) == 0
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
    assert len(replayed._frames._graphs) == 1
    assert replayed._can_record
    for found, truth in zip(shown, expected, strict=True):
        for name, picture in truth.items():
            torch.testing.assert_close(found[name], picture, rtol=0, atol=2e-3 if name == "rgb" else 1e-6)
    assert not torch.equal(shown[0]["rgb"], shown[1]["rgb"])
    assert shown[1]["depth"].isfinite().all()
    assert bool(shown[1]["features"].any()) == (head.get("mode") != "off")


@pytest.mark.gpu
def test_what_is_trained_meanwhile_is_seen(build, perturb, camera, view):
    model = perturb(build(n=500)).cuda().eval()
    before = view(model, times=RECORD_AT + 1)["rgb"]
    with torch.no_grad():
        model.gauss_params["features_dc"] += 0.5
        for value in model.head.parameters():
            value += 0.02
    after = view(model, times=1)["rgb"]
    assert len(model._replay._frames._graphs) == 1
    assert not torch.equal(after, before)
    torch.testing.assert_close(after, eager(model, camera())["rgb"], rtol=0, atol=2e-3)
    with torch.no_grad():  # a prune
        for name, value in list(model.gauss_params.items()):
            model.gauss_params[name] = torch.nn.Parameter(value[::2].clone())
    torch.testing.assert_close(view(model)["rgb"], eager(model, camera())["rgb"], rtol=0, atol=2e-3)


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


def features(n=2000):
    spread = torch.tensor([0.1, 3.0, 0.01, 1.0, 0.3])
    return torch.randn(n, 5, generator=torch.Generator().manual_seed(0)) * spread + torch.arange(5.0)


def test_principal_components_are_sorted_by_variance():
    mean, basis, deviations = frames.principal_components(features())
    torch.testing.assert_close(mean, torch.arange(5.0), atol=0.2, rtol=0)
    assert basis.abs().argmax(dim=0).tolist() == [1, 3, 4]
    torch.testing.assert_close(basis.T @ basis, torch.eye(3), atol=1e-5, rtol=0)
    torch.testing.assert_close(deviations, torch.tensor([3.0, 1.0, 0.3]), atol=0, rtol=0.1)
    for seed in range(8):  # signs are fixed
        values = torch.randn(50, 6, generator=torch.Generator().manual_seed(seed))
        assert (frames.principal_components(values)[1].sum(dim=0) > 0).all()


@pytest.mark.parametrize("width", [1, 2])
def test_fewer_channels_than_colours(width):
    parts = frames.principal_components(features()[:, :width])
    assert parts[1].shape == (width, 3)
    assert not parts[1][:, width:].any()
    colors = frames.feature_colors(torch.randn(4, 6, width), *parts, torch.ones(4, 6, 1))
    assert torch.isfinite(colors).all()
    # A missing direction shows mid-grey, not noise.
    torch.testing.assert_close(colors[..., width:], torch.full((4, 6, 3 - width), 0.5))


def test_colours_are_in_range_grey_at_the_mean_and_black_in_empty_pixels():
    def colors(shown, of, alpha=1.0):
        return frames.feature_colors(shown, *frames.principal_components(of), torch.full((*shown.shape[:2], 1), alpha))

    shown = colors(features().reshape(40, 50, 5), features())
    assert ((shown >= 0) & (shown <= 1)).all()
    # Three deviations fill the range: almost nothing is clipped, and all channels vary equally.
    assert ((shown > 0) & (shown < 1)).float().mean() > 0.99
    torch.testing.assert_close(shown.reshape(-1, 3).std(dim=0), torch.full((3,), 1 / 6), atol=0.01, rtol=0)
    grey = colors(features().mean(dim=0).expand(2, 2, 5), features())
    torch.testing.assert_close(grey, torch.full((2, 2, 3), 0.5))
    assert not colors(torch.zeros(2, 2, 5), features(), alpha=0.0).any()
    equal = torch.full((2, 3, 4), 0.3)
    level = colors(equal, equal.reshape(-1, 4))
    assert ((level >= 0) & (level <= 1)).all(), "features of no variance have finite colours"


def test_response_values_are_ranks():
    response = torch.tensor([10.0, torch.nan, 0.1, 1e6, 0.0])
    for same in (response, response * 1e-7, response.double()):
        values = frames.response_values(same)
        assert values.tolist() == [0.75, 0.0, 0.5, 1.0, 0.25]
        assert values.dtype == torch.float32, "the viewer needs it"
    assert frames.response_values(torch.full((3,), torch.nan)).tolist() == [0.0] * 3
