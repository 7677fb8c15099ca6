"""Steps that a recording would replay, run kernel by kernel on the CPU, beside nerfstudio's."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from nerfstudio.engine.callbacks import TrainingCallbackLocation

from sundae_ns.core.surgery import change_parameter
from sundae_ns.cuda import adam
from sundae_ns.method_configs.sundae import optimizers
from sundae_ns.plugin.optimizer_configs import RATES
from sundae_ns.train import graphed_step as capture
from sundae_ns.train.graphed_step import Buffers, RecordedStep, StepRecordings, start_moments, trained_parameters


class Recorded:
    """Trains a model by whole steps on buffers."""

    def __init__(self, training, camera, batch):
        self.training, self.model = training, training.model
        self.camera, self.batch = camera, batch
        self.recorded = RecordedStep(self.model.losses, record=self.model.device.type == "cuda")

    def step(self, step):
        self.model.train()
        self.training.run_callbacks(TrainingCallbackLocation.BEFORE_TRAIN_ITERATION, step)
        inputs = self.model.step_inputs(self.camera, self.batch)
        result = self.recorded(self.model.state, inputs, self.model.render_settings(training=True))
        self.training.run_callbacks(TrainingCallbackLocation.AFTER_TRAIN_ITERATION, step)
        return result.losses


@pytest.fixture
def both(build, training_of, camera, batch, monkeypatch):
    """Make two trainings of equal models: by steps of nerfstudio's trainer, and by whole steps on buffers."""
    monkeypatch.setattr(adam, "_PIECE", 100)  # weights of a small head are in pieces too

    def make(device="cpu", **options):
        models = []
        for _ in range(2):
            torch.manual_seed(0)
            models.append(build(**options).to(device))
        trainings = [training_of(model) for model in models]
        for training in trainings:
            # A head of a few steps bursts at the rate of the field, and then shows the last bits of its gradients.
            for group in getattr(training.optimizers.optimizers.get("compensation"), "param_groups", ()):
                group["lr"] = 1e-3
        return trainings[0], Recorded(trainings[1], camera(), batch())

    return make


GROWTH = {
    "warmup_length": 1,
    "refine_every": 2,
    "densify_grad_thresh": 1e-4,
    "reset_alpha_every": 3,
    "pruning": {"prune_at": 9},
    "stop_screen_size_at": 100,
}
"""Options that let the field grow every other step until it is pruned after step 9."""


def test_steps_that_leave_out_another_share_are_another_recording(both):
    _, recorded = both()
    model, inputs = recorded.model, recorded.model.step_inputs(recorded.camera, recorded.batch)
    each = (replace(model.render_settings(training=True), drop_rate=rate) for rate in (0.0, 0.1))
    assert len({capture._kind(model.state, inputs, settings) for settings in each}) == 2


@pytest.mark.parametrize(
    "options",
    [
        GROWTH,
        {**GROWTH, "use_absgrad": True},
        {"pruning": {"prune_at": 4}, "head": {"mode": "off"}, "drop_rate": 0.2, "stop_split_at": 4},
        {"sh_degree": 0, "head": {"mode": "features"}},
    ],
    ids=["densify", "absgrad", "no-head", "logits"],
)
def test_both_train_the_same_field(both, options):
    """Through growth, resets of opacities, the prune and the head."""
    usual, recorded = both(**options)
    counts = []
    for step in range(16):
        # Backgrounds, and places of split Gaussians; with some seeds features have gradients of the size of rounding.
        torch.manual_seed(step + 100)
        expected = usual.step(step)
        torch.manual_seed(step + 100)
        found = recorded.step(step)
        assert found.keys() == expected.keys()
        for name, value in expected.items():
            torch.testing.assert_close(found[name], value.detach(), rtol=2e-4, atol=1e-6)
        assert recorded.model.num_points == usual.model.num_points
        counts.append(usual.model.num_points)
    assert recorded.training.live()
    for name, value in usual.model.gauss_params.items():
        torch.testing.assert_close(recorded.model.gauss_params[name], value, rtol=2e-3, atol=2e-5)
        moments, held = (
            one.optimizers.optimizers[name].state[one.model.gauss_params[name]] for one in (usual, recorded.training)
        )
        assert moments.keys() == held.keys()
        if moments:
            assert float(moments["step"]) == float(held["step"])
    heads = [one.head for one in (recorded.model, usual.model)]
    assert [head is None for head in heads] == 2 * [options.get("head") == {"mode": "off"}]
    for weights, expected_weights in zip(*(head.parameters() if head else () for head in heads), strict=True):
        # Adam moves a weight by its rate of 1e-3 wherever its gradient points, be it of the size of rounding. So one
        # in thousands may be that far off; all together must be near.
        torch.testing.assert_close(weights, expected_weights, rtol=2e-3, atol=1e-4)
        assert (weights - expected_weights).square().mean().sqrt() < 2e-6  # measured: 4.4e-7
    if options is GROWTH:
        assert max(counts) > counts[0] > counts[-1]  # otherwise nothing grew or nothing was pruned


def test_harmonics_are_trained_at_every_second_step_at_twice_the_rate(both):
    def values(training):
        return {name: training.model.gauss_params[name].detach().clone() for name in ("features_dc", "features_rest")}

    trainings = both(head={"mode": "off"}, pruning={"mode": "off"}, sh_degree_interval=1)
    for training in trainings:
        training.model.state.harmonics_every = 2
    for step in range(5):
        for training in trainings:
            before = values(training)
            training.step(step)
            moved = {name: not torch.equal(value, before[name]) for name, value in values(training).items()}
            assert moved == {"features_dc": True, "features_rest": step in (2, 4)}  # at step 0 colours have none
    assert optimizers(30000)["features_rest"]["optimizer"].lr == 2 * RATES["features_rest"]


@pytest.mark.gpu
@pytest.mark.parametrize(
    ("options", "alike"),
    # The prune of the last one enables its head after step 3, so its features drift from step 6 on: by 0.3 to 1.2% of
    # the loss at step 8 on three H100s.
    [(GROWTH, 12), ({**GROWTH, "use_absgrad": True}, 12), ({"sh_degree": 0}, 8)],
    ids=["densify", "absgrad", "logits"],
)
def test_replayed_steps_train_the_same_field(both, options, alike):
    """Gradients are summed in any order, and Adam turns the signs of vanishing ones into steps: fields drift apart."""
    usual, recorded = both("cuda", **options)
    late = {}
    for step in range(40):
        torch.manual_seed(step)
        expected = usual.step(step)
        torch.manual_seed(step)
        found = {name: value.clone() for name, value in recorded.step(step).items()}
        for name, value in expected.items():
            if step < alike:
                torch.testing.assert_close(found[name], value.detach(), rtol=1e-3 * (step + 1), atol=1e-5)
            else:
                late.setdefault(name, []).append((float(found[name]), float(value)))
        assert recorded.model.num_points == pytest.approx(usual.model.num_points, rel=0.05)
    for pairs in late.values():
        assert sum(a for a, _ in pairs) == pytest.approx(sum(b for _, b in pairs), rel=0.1)
    assert recorded.recorded._recordings._recordings
    assert recorded.training.live()


@pytest.mark.gpu
def test_a_step_without_room_for_its_pairs_changes_nothing(both, monkeypatch):
    monkeypatch.setattr(capture, "SPARE_PAIRS", 0.5)
    _, recorded = both("cuda", pruning={"mode": "off"})
    recorded.step(0)
    recorded.step(1)  # another SH degree, kernel by kernel again
    before = {name: value.detach().clone() for name, value in recorded.model.gauss_params.items()}
    held = recorded.training.optimizers.optimizers["means"].state[recorded.model.gauss_params["means"]]
    steps = float(held["step"])
    recorded.step(2)
    torch.cuda.synchronize()
    assert all(torch.equal(recorded.model.gauss_params[name], value) for name, value in before.items())
    assert float(held["step"]) == steps
    monkeypatch.setattr(capture, "SPARE_PAIRS", 2.0)
    recorded.step(3)
    torch.cuda.synchronize()
    assert not torch.equal(recorded.model.gauss_params["means"], before["means"])


def test_more_image_sizes_than_recordings(monkeypatch):
    """The last sizes run kernel by kernel until a recording has not been used for long; recording would take longer."""
    recordings, made = StepRecordings(), []

    def recorded(*arguments):
        made.append(arguments[-1])
        return SimpleNamespace(pairs=arguments[-1])

    monkeypatch.setattr(recordings, "_recorded", recorded)
    recordings._most_on_host = torch.tensor(5)

    def ask(kind):
        recordings._steps += 1
        return recordings._recording(None, None, None, kind, None)

    sizes = capture.MAX_RECORDINGS
    for _ in range(3):
        assert all(ask(kind) is not None for kind in range(sizes))
        assert ask(sizes) is None
    assert made == [8] * sizes
    recordings._most_on_host.fill_(12)  # a view needed more pairs than fit
    assert ask(0).pairs == 19
    recordings._steps += capture.UNUSED
    assert ask(sizes) is not None
    assert len(recordings._recordings) == sizes


def test_the_field_lies_in_the_buffers_and_unseen_rows_stay_as_they_are(both):
    _, recorded = both(**GROWTH)
    for step in range(7):
        recorded.step(step)
    buffers, n = recorded.recorded._buffers, recorded.model.num_points
    # The last call grew the field after the step.
    recorded.recorded._buffers.hold(recorded.model.state, trained_parameters(recorded.model.state), growing=True)
    assert n < buffers.capacity <= 2 * n
    for name in ("means", "opacities", "quats"):
        held = buffers.tensors[name]
        assert held.data_ptr() == recorded.model.gauss_params[name].data_ptr()
        assert (held[n:] == held[-1]).all()
        assert not buffers.tensors[f"{name}.exp_avg"][n:].any()
    assert recorded.model.gauss_params["means"].abs().max() < 100


def test_buffers_are_new_only_when_the_field_does_not_fit(build, training_of, monkeypatch):
    training = training_of(build(n=60))
    monkeypatch.setattr(capture, "SPARE", 1.25)
    state = training.model.state
    trained = trained_parameters(state)
    start_moments(state, trained)
    buffers = Buffers()
    assert buffers.hold(state, trained, growing=True)
    assert not buffers.hold(state, trained, growing=True)
    places = {name: value.data_ptr() for name, value in buffers.tensors.items()}
    values = {name: state.gaussians[name].detach().clone() for name in trained}
    for name in trained:  # surgery makes new tensors
        parameter = state.gaussians[name]
        parameter.data = torch.cat([parameter.data, parameter.data[:5]])
        for moment in ("exp_avg", "exp_avg_sq"):
            state.optimizers[name].state[parameter][moment] = torch.ones_like(parameter)
    assert not buffers.hold(state, trained, growing=True)
    assert places == {name: value.data_ptr() for name, value in buffers.tensors.items()}
    assert all(torch.equal(state.gaussians[name], torch.cat([values[name], values[name][:5]])) for name in trained)
    assert int(buffers.tensors["means.exp_avg"].sum()) == 65 * 3
    assert buffers.hold(state, trained, growing=False)
    assert buffers.capacity == 65
    assert not buffers.hold(state, trained, growing=False)
    change_parameter(state.gaussians, state.optimizers, "features_rest", lambda value: value[:, :2].clone())
    assert buffers.hold(state, trained, growing=False)
    assert buffers.tensors["features_rest"].shape == buffers.tensors["features_rest.exp_avg"].shape == (65, 2, 3)
