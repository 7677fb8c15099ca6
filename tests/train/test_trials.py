"""Trials without a trainer: their fields and views, states of checkpoints, and estimated sizes."""

import copy
import math
from types import SimpleNamespace

import pytest
import torch
from fields import random_field
from models import Training
from torch.optim import SGD, Adam
from torch.optim.lr_scheduler import LambdaLR

from sundae_ns.core.errors import CheckpointError
from sundae_ns.core.gaussians import FEATURES
from sundae_ns.head.head import CompensationHead, HeadConfig
from sundae_ns.io.pack.packed_scene import PackedScene, fit_scene, pack_bytes
from sundae_ns.train import trials as trials_module
from sundae_ns.train.choice import HeldOutQuality, Tried
from sundae_ns.train.pruning import COUNT, NEVER, VIEWS, PruningConfig
from sundae_ns.train.schedules import Decay
from sundae_ns.train.trials import Progress, Trial, Trials, packed_size

VIEW = HeldOutQuality(10, 20.0, 0.5)


class FakeRun:
    """A run whose steps add 1 to every centre and to the poses of cameras."""

    def __init__(self, state):
        self.state = state
        self.held_out = []
        self.source = SimpleNamespace(total=20)

    def hold_out(self, indices):
        self.held_out = list(indices)

    def train(self, trials, most=100):
        """Train to the end of the trial, or ``most`` steps; returns their number."""
        for number in range(1, most + 1):
            self.state.step += 1
            self.state.gaussians["means"].data += 1
            self.state.optimizers["camera_opt"].param_groups[0]["params"][0].data += 1
            if trials.advance(self):
                return number
        return most


def trials_for(state, begins_at=-math.inf, mode="auto", keep_ratio=None):
    head, pruning = SimpleNamespace(mode=mode), PruningConfig(keep_ratio=keep_ratio)
    return Trials(SimpleNamespace(pruning=pruning, head=head, ssim_lambda=0.2), state, None, begins_at)


@pytest.fixture
def run(build, monkeypatch):
    monkeypatch.setattr(trials_module, "AVERAGED_EVERY", 1)
    state = build(n=20).state
    state.gaussians["means"].data.zero_()
    state.optimizers = {name: Adam([value]) for name, value in state.gaussians.items()}
    state.optimizers["compensation"] = Adam(state.head.parameters())
    state.optimizers["camera_opt"] = Adam([torch.nn.Parameter(torch.zeros(3, 6))])
    return FakeRun(state)


def height(run):
    return float(run.state.gaussians["means"].detach()[0, 0])


def test_trials_of_several_lengths_go_back_to_any_kept_field(run):
    decay = Decay(0.1, 1000, 1.0, False, 0)
    decay.pruned_at = 0
    run.state.schedulers = {"means": LambdaLR(SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0), lr_lambda=decay)}
    trials, state = trials_for(run.state), run.state

    def age():
        """Steps since the rate has restarted, as far as they count."""
        return state.step - (decay.pruned_at or 0)

    trials.keep("first", state, head=False)
    trials.start(run, "length", 5, [2])
    assert run.held_out == [2]
    assert run.train(trials) == 5
    trials.keep("second", state, head=False)
    trials.start(run, "length", 3, [4])
    assert (run.train(trials), run.held_out, height(run)) == (3, [4], 8.0)
    trials.go_back("second", state)
    assert (height(run), trials.taken_back, age()) == (5.0, 3, 5)
    trials.start(run, "length", 4, [])
    run.train(trials, most=2)
    trials.go_back("first", state)
    assert (height(run), trials.taken_back, age()) == (0.0, 3 + 2 + 5, 0)
    trials.go_back("second", state)  # its five steps count again
    assert (height(run), trials.taken_back, age()) == (5.0, 5, 5)
    assert (state.optimizers["camera_opt"].param_groups[0]["params"][0] == 5).all()
    trials.end(run, "count")
    assert (run.held_out, trials.trial, trials.kept) == ([], None, {})


@pytest.mark.parametrize(("averaged", "shown"), [(0.6, 4.0), (0, 5.0)])
def test_the_mean_of_the_last_weights_is_measured(run, monkeypatch, averaged, shown):
    seen = []

    def measured(run, **_):
        seen.append(height(run))
        return [VIEW]

    monkeypatch.setattr(trials_module, "measure_held_out", measured)
    monkeypatch.setattr(trials_module, "MEAN_SHARE", averaged)
    trials = trials_for(run.state)
    trials.start(run, "head", 5, [], width=0)
    run.train(trials)
    assert trials.measure(run) == [VIEW]
    assert (seen, height(run)) == ([shown], 5.0)


def test_a_field_is_provisional_until_the_trials_end(run):
    state, trials = run.state, trials_for(run.state, begins_at=2)
    trials.start(run, "tenth", 5, [], width=5)
    run.train(trials)
    assert state.head_enabled
    assert state.provisional
    trials.end(run, "count")
    assert not state.provisional
    assert state.schedule_step - state.head_starts_at - trials.taken_back == 3


def test_another_width_begins_with_a_fresh_head_and_a_kept_one_comes_back(run):
    state, trials = run.state, trials_for(run.state)
    weights = {name: value.clone() for name, value in state.head.named_parameters()}
    trials.keep("start", state, head=True)
    trials.start(run, "head", 2, [], width=29)
    assert (state.head.config.num_features, state.gaussians["features"].shape) == (29, (20, 29))
    trials.go_back("start", state)
    trials.start(run, "head", 2, [], width=0)
    assert not state.head_enabled
    assert (state.head.config.num_features, state.gaussians["features"].shape) == (5, (20, 5))
    assert all(torch.equal(value, weights[name]) for name, value in state.head.named_parameters())


def test_a_state_in_the_middle_of_a_trial_is_resumed(run, monkeypatch):
    trials, other, state = trials_for(run.state), trials_for(run.state), run.state
    monkeypatch.setattr(trials_module, "MEAN_SHARE", 5 / 6)
    trials.keep("start", state, head=False)
    trials.start(run, "tenth", 6, [1, 3], width=0)
    run.train(trials, most=4)
    saved = copy.deepcopy(trials.state_dict())
    state.provisional = False
    other.load_state_dict(state, saved)
    assert state.provisional
    run.held_out = []
    other.hold_out(run)
    assert run.held_out == [1, 3]
    assert run.train(other) == 2
    monkeypatch.setattr(trials_module, "measure_held_out", lambda run, **_: [VIEW._replace(psnr=height(run))])
    assert other.measure(run)[0].psnr == 4.0  # of the steps 2 to 6
    other.go_back("start", state)
    assert (height(run), other.taken_back) == (0.0, 6)


@pytest.mark.parametrize(
    ("stage", "views", "images", "given", "held_out"),
    [
        ("count", 40, 1, {"keep_ratio": 0.1}, []),
        ("count", 40, 2, {}, []),  # on several GPUs
        ("tenth", 33, 1, {}, [0, 8, 16, 24]),
        ("head", 40, 1, {"keep_ratio": 0.1, "mode": "residual"}, []),
        ("head", 39, 1, {"keep_ratio": 0.1}, []),
    ],
)
def test_a_resumed_run_forgets_what_it_does_not_try_any_more(run, stage, views, images, given, held_out):
    """It would hold views out to the end, keep the field of a trial, or compare views that are not the same."""
    trials, state = trials_for(run.state), run.state
    state.pruning[VIEWS] = 40
    trials.coming = {"head" if stage == "head" else "count": [1, 3]}
    for name in ("start", "plain"):
        trials.keep(name, state, head=False)
    trials.start(run, stage, 5, [1, 3], width=0)
    trials.progress.tried.append(Tried(stage, 20, "plain", 5, [[*VIEW]]))
    run.train(trials, most=2)
    state.pruning.update(pruned_at=0, num_prunes=1)
    state.head_starts_at = 1
    resumed = trials_for(state, **given)
    resumed.load_state_dict(state, trials.state_dict())
    run.view_indices, run.folder = lambda: [*range(views)], None
    run.images_per_step, run.last_step, run.schedule_length = images, 29999, 30000
    resumed.before_training(run)
    assert (height(run), run.held_out) == (0.0, held_out)
    assert (resumed.progress.stage, resumed.progress.tried, resumed.trial) == ("", [], None)
    assert (state.pruning["pruned_at"], state.pruning.get(COUNT)) == (NEVER, 0 if images > 1 else None)
    assert state.head_enabled == (images > 1 or "mode" in given)
    state.head_starts_at = 1
    trials_for(state, begins_at=9, mode="residual").before_training(run)
    assert state.head_starts_at == 1, "as where the run is resumed"


def test_an_undecided_head_is_disabled_and_trials_act_on_both_sides_of_the_prune(build):
    model = build(head={"mode": "auto"})
    model.step = 10**6
    assert model.head.config.mode == "residual"
    assert not model.state.head_enabled
    names = [callback.name for callback in model.train_callbacks]
    assert names.index("trials") < names.index("pruning") < names.index("after-prune")


def test_a_removed_head_leaves_no_values_and_no_moments(build):
    model = build(head={"mode": "residual"})
    training = Training(model)
    for step in range(3, 7):
        training.step(step)
    assert model.state.head_enabled
    assert training.optimizers.optimizers["compensation"].state
    features = model.gauss_params["features"]
    model.state.remove_head()
    assert model.head is None
    assert model.gauss_params["features"] is features
    assert features.numel() == 0
    assert not training.optimizers.optimizers["compensation"].state
    assert not training.optimizers.optimizers["features"].state
    before = model.gauss_params["means"].detach().clone()
    training.step(7)
    assert not model.gauss_params["means"].detach().equal(before)


@pytest.fixture
def undecided(build):
    """A model whose head is to be decided about, and its trials."""
    model = build(head={"mode": "auto"})
    return model, next(one for one in model.train_callbacks if isinstance(one, Trials))


def saved(state, stage="", kept=(), **progress):
    """A state of trials."""
    trials = trials_for(state)
    trials.progress, trials.kept = Progress(stage, **progress), dict(kept)
    trials.trial = Trial(10, num_features=5, counts=False) if stage else None
    return trials.state_dict()


@pytest.mark.parametrize(("stage", "kept"), [("head", {"start": {}}), ("count", {"start": {"head": {}}})])
def test_a_state_without_a_decision_or_a_field_to_go_back_to_is_refused(undecided, stage, kept):
    model, trials = undecided
    with pytest.raises(CheckpointError, match=r"--pipeline.model.head.mode"):
        trials.prepare_loading(model.state, {})
    tried = [Tried("head", 9, "plain", 9)]
    with pytest.raises(CheckpointError, match="^.*lacks a field.*$"):
        trials.load_state_dict(model.state, saved(model.state, stage, kept, tried=tried))


def test_only_trials_do_without_mirrored_images(undecided):
    """They are too short to see what these bring; a run that resumes in a trial goes on with it."""
    model, trials = undecided
    for options, mirrored in (({"stage": "head", "kept": {"start": {}}}, False), ({"chosen": {"head": "head"}}, True)):
        trials.load_state_dict(model.state, saved(model.state, **options))
        model.step = 10**6
        assert model.state.head_enabled
        assert model.resolution(model.step).mirror == mirrored


@pytest.mark.parametrize("with_head", [False, True])
def test_a_part_of_a_field_tells_the_size_of_all_of_it(with_head, monkeypatch):
    monkeypatch.setattr(trials_module, "SAMPLE", 2000)
    gaussians = random_field(5000, degree=1)
    head = CompensationHead(HeadConfig(mode="residual", size="tiny", num_features=5)) if with_head else None
    found = packed_size(gaussians, head)
    packed = {name: value for name, value in gaussians.items() if with_head or name != FEATURES}
    data, sections = pack_bytes(*fit_scene(PackedScene(packed, {} if head is None else dict(head.state_dict()))))
    of_head = sum(size for name, size in sections.items() if name.startswith("head/"))
    assert found[1] == pytest.approx(of_head, rel=0.01)
    assert (found[1] > 0) == with_head
    assert found[0] == pytest.approx(len(data) - of_head, rel=0.1)
    assert packed_size({**gaussians, "means": gaussians["means"].index_fill(0, torch.tensor(0), torch.nan)}) is None
