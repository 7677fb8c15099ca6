"""The mean of the weights over the last steps."""

from types import SimpleNamespace

import pytest
import torch

from sundae_ns.train import averaging
from sundae_ns.train.averaging import Averaging

LAST = 99


def run_of(state, *, images=1, last=LAST, length=LAST + 1):
    return SimpleNamespace(state=state, last_step=last, schedule_length=length, images_per_step=images)


@pytest.fixture
def state(build, monkeypatch):
    monkeypatch.setattr(averaging, "AVERAGED_EVERY", 3)
    return build(n=20).state


def train(state, mean, steps, *, last=LAST, images=1):
    """Steps that change the weights at random; the centres at the steps from 90 on that are averaged."""
    seen = []
    mean.before_training(run_of(state, last=last, images=images))
    for step in steps:
        state.step = step
        torch.manual_seed(step)
        for value in state.gaussians.values():
            value.data += torch.randn_like(value)
        if step >= 90 and step % averaging.AVERAGED_EVERY == 0:
            seen.append(state.gaussians["means"].detach().clone())
        mean.after_step(run_of(state, last=last))
    return seen


def assert_mean(state, seen, count):
    assert len(seen) == count
    torch.testing.assert_close(state.gaussians["means"].detach(), torch.stack(seen).mean(dim=0))


def test_the_last_weights_become_the_mean(state):
    assert_mean(state, train(state, Averaging(0.09, settled_at=0), range(LAST + 1)), 4)


def test_a_mean_that_an_interruption_has_cut_short_is_dropped(state):
    """A run that stops in its last part and is resumed for a longer one ends with weights of the end alone."""
    first, longer = Averaging(0.3, settled_at=0), Averaging(0.09, settled_at=0)
    train(state, first, range(90))
    assert first.state_dict()["count"] > 0
    longer.load_state_dict(state, first.state_dict())
    assert_mean(state, train(state, longer, range(80, LAST + 1)), 4)


def test_no_mean_of_fields_that_differ(state):
    """After a prune, or a return to an earlier field, only the weights since then count."""
    for change in ("prune", "return"):
        mean = Averaging(0.3, settled_at=0)
        train(state, mean, range(91))
        if change == "prune":
            for value in state.gaussians.values():
                value.data = value.data[:10].clone()
        else:
            state.restored += 1
        assert_mean(state, train(state, mean, range(91, LAST + 1)), 3)


def test_unfinished_schedules_and_growing_fields_keep_their_weights(state):
    for mean, length in ((Averaging(0.1, settled_at=1000), LAST + 1), (Averaging(0.1, settled_at=0), 2 * LAST)):
        state.step = LAST
        before = state.gaussians["means"].detach().clone()
        mean.before_training(run_of(state, length=length))
        mean.after_step(run_of(state, length=length))
        assert torch.equal(state.gaussians["means"], before)


def test_a_longer_training_goes_on_from_the_last_weights(state):
    """Not from their mean, which does not belong to the state of the optimizers."""
    mean, again = Averaging(0.5, settled_at=0), Averaging(0.5, settled_at=0)
    train(state, mean, range(LAST))
    state.step = LAST
    last = {name: value.detach().clone() for name, value in state.gaussians.items()}
    mean.after_step(run_of(state))
    assert not torch.equal(state.gaussians["means"], last["means"])
    shown = state.gaussians["means"].detach().clone()
    again.load_state_dict(state, mean.state_dict())
    assert torch.equal(state.gaussians["means"], shown)  # who only looks sees the mean
    again.before_training(run_of(state))
    assert all(torch.equal(value, last[name]) for name, value in state.gaussians.items())
    assert not again.state_dict()["replaced"]


def test_a_first_part_ends_with_the_mean_of_its_last_steps(state):
    """As far as it reaches into the share: what is packed from there on begins at the mean."""
    assert_mean(state, train(state, mean := Averaging(0.09, settled_at=0), range(96), last=95), 2)
    assert mean.state_dict()["replaced"]


def test_ranks_do_not_save_the_mean_of_their_shard_which_may_be_empty(state):
    train(state, mean := Averaging(1.0, settled_at=0), range(20), images=2)
    assert not mean.state_dict()
    for value in state.gaussians.values():
        value.data = value.data[:0].clone()
    train(state, Averaging(1.0, settled_at=0), range(LAST - 9, LAST))
