"""Exposure compensation: what differs from the neighbours is taken out, what the place explains is not."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from photographed import ANGLES, COUNT, batch_of, begin, image_of, measure, ring, run_of, update

from sundae_ns.core.camera import Camera
from sundae_ns.train import exposure
from sundae_ns.train.exposure import LEAST_PHOTOS, ExposureCompensation, view_points

ON_CPU = SimpleNamespace(device=torch.device("cpu"))


def found(gains):
    """The gains that photos are divided by ``[COUNT, 3]``."""
    white = torch.ones(48, 64, 3)
    return torch.stack([(1 / gains.balanced(white, batch_of(index)))[0, 0] for index in range(COUNT)])


def photos_by(gains):
    """Photos of the field by their indices, taken with these gains."""
    return lambda index: image_of(index) * gains[index]


def random_gains(spread, seed):
    return torch.exp(spread * torch.randn(COUNT, 3, generator=torch.Generator().manual_seed(seed)))


def test_photos_that_differ_from_their_neighbours_are_evened_out():
    true, (gains, run) = random_gains(0.2, 0), begin()
    measure(gains, run, photos_by(true))
    left = true.log() - found(gains).log()
    assert left.std() < 0.4 * true.log().std(), "what neighbours have in common stays in the photos"
    assert float(found(gains).log().mean(dim=0).abs().max()) < 1e-3, "the light of the whole field stays"


PLACE = torch.exp(0.2 * torch.sin(ANGLES))[:, None].expand(-1, 3)  # Light that neighbours share
EVEN = random_gains(0.8 * exposure.NOISE, 0)  # Differences no larger than the errors of a field
THREE = torch.where(torch.arange(COUNT) < 3, 2.5, 1.0)[:, None].expand(-1, 3)


@pytest.mark.parametrize(("true", "most"), [(PLACE, 0.02), (EVEN, 0.0)], ids=["the place", "a field's errors"])
def test_differences_that_a_field_explains_stay_in_the_photos(true, most):
    """So a capture whose light does not change is trained as without gains, to the bit."""
    gains, run = begin()
    measure(gains, run, photos_by(true))
    assert found(gains).log().abs().max() <= most


def test_gains_settle_whatever_they_were_at_first():
    """They are measured against photos that were divided by them: an error must not feed itself."""
    true = random_gains(0.2, 1)
    ends = []
    for first in (1.0, 1.5):
        gains, run = begin()
        measure(gains, run, photos_by(first * true), rounds=1)
        measure(gains, run, photos_by(true), rounds=20)
        ends.append(found(gains))
    torch.testing.assert_close(ends[0], ends[1], rtol=1e-3, atol=1e-3)


def test_clipped_and_masked_pixels_do_not_count():
    gains, run = begin()
    one = batch_of(5)
    photo, mask = image_of(5) * 1.3, torch.ones(48, 64, 1)
    photo[:10], mask[20:30], photo[20:30] = 1.0, 0.0, 0.0
    for index in range(COUNT):
        if index != 5:
            gains.observe(image_of(index), image_of(index), None, batch_of(index))
    gains.observe(image_of(5), photo, mask, one)
    update(gains, run)
    measured = gains.state_dict()["measured"]
    torch.testing.assert_close(measured[5], torch.full((3,), math.log(1.3), dtype=torch.float64), rtol=1e-4, atol=1e-4)
    assert measured[6].abs().max() < 1e-6


@pytest.mark.parametrize("spoilt", [torch.zeros(48, 64, 3), torch.full((48, 64, 3), math.nan), torch.ones(48, 64, 3)])
def test_a_photo_that_says_nothing_has_no_gain(spoilt):
    gains, run = begin()
    measure(gains, run, lambda index: spoilt if index == 7 else image_of(index), rounds=3)
    state = gains.state_dict()
    assert state["counts"][7] == 0
    assert state["counts"][8] == 3
    torch.testing.assert_close(found(gains), torch.ones(COUNT, 3), rtol=1e-4, atol=1e-4)


def test_photos_with_an_alpha_channel_few_photos_and_the_option_off_are_left_alone(capsys):
    photo, (gains, run) = image_of(0), begin()
    measure(gains, run, lambda index: image_of(index) * (1 + index % 2))
    assert gains.balanced(photo, batch_of(0)) is not photo
    assert gains.balanced(photo, batch_of(0, channels=4)) is photo
    assert gains.balanced(photo, {"image": photo}) is photo
    before = gains.state_dict()
    gains.observe(photo, photo, None, batch_of(0, channels=4))
    assert torch.equal(gains.state_dict()["sums"], before["sums"])
    for mode in ("on", "auto", "off"):
        few = ExposureCompensation(LEAST_PHOTOS - 1, mode)
        few.before_training(run_of(ring(LEAST_PHOTOS - 1)))
        few.observe(photo, few.balanced(photo * 2, batch_of(0)), None, batch_of(0))
        update(few, run)
        assert few.balanced(photo, batch_of(0)) is photo
        few.finish(run)
    # Once: nobody has asked for the others.
    assert " ".join(capsys.readouterr().out.split()).count("31 training photos are too few") == 1


def test_a_resumed_training_goes_on_as_one_that_was_never_stopped():
    photos = photos_by(random_gains(0.2, 2))

    def half(gains, run):
        measure(gains, run, photos, rounds=2)
        gains.observe(image_of(3), gains.balanced(photos(3), batch_of(3)), None, batch_of(3))

    gains, run = begin()
    half(gains, run)
    saved = gains.state_dict()
    resumed = ExposureCompensation(COUNT, "on")
    resumed.load_state_dict(ON_CPU, saved)
    assert torch.equal(found(resumed), found(gains)), "a fine-tune has no run"
    resumed.before_training(run)
    half(gains, run)
    half(resumed, run)
    assert torch.equal(found(resumed), found(gains))
    assert saved["counts"].max() < gains.state_dict()["counts"].max(), "a saved state does not change"
    for other in ({}, ExposureCompensation(COUNT + 1, "on").state_dict()):
        fresh = ExposureCompensation(COUNT, "on")
        fresh.load_state_dict(ON_CPU, other)
        assert torch.equal(found(fresh), torch.ones(COUNT, 3))


def test_ranks_add_up_what_each_has_measured():
    gains, run = begin()
    gains.total = lambda sums: sums * 1.0 + elsewhere
    elsewhere = torch.zeros(COUNT, 2, 3)
    elsewhere[9] = torch.tensor([[2.0], [1.0]])
    measure(gains, run, image_of, rounds=1)
    assert gains.state_dict()["measured"][9].min() > 0
    assert gains.state_dict()["measured"][8].abs().max() < 1e-6
    unseen, _ = begin(device="meta")  # as of photos with an alpha channel
    assert unseen.state_dict()["sums"].is_meta, "ranks add up what is on their GPUs"


def test_cameras_at_one_place_are_apart_by_what_they_see():
    cameras = [Camera.look_at(torch.zeros(3), (math.cos(a), math.sin(a), 0.0)) for a in ANGLES]
    cameras += [Camera.look_at((4.0, 0.0, 0.0), (9.0, 0.0, 0.0))]
    apart = np.linalg.norm(view_points(cameras)[:-1].diff(dim=0).numpy(), axis=1)
    assert apart == pytest.approx(apart[0], rel=1e-3)
    assert apart[0] > 0.01


def test_training_compares_with_the_balanced_photo_and_evaluation_with_the_true_one(build, batch, camera):
    model, photo = build(exposure_compensation="on"), {**batch(), "image_idx": 2}
    gains = model.exposure_compensation.state_dict()
    gains["gains"][2] = torch.tensor([0.5, 1.0, 2.0])
    model.exposure_compensation.load_state_dict(model.state, gains)
    background = {"background": torch.zeros(3)}
    true = photo["image"].float() / 255
    model.train()
    for target in (model.target(photo, background), model.step_inputs(camera(), photo).target):
        torch.testing.assert_close(target, true / torch.tensor([0.5, 1.0, 2.0]))
    for target in (model.truth(photo, background), model.eval().target(photo, background)):
        torch.testing.assert_close(target, true)


def test_auto_divides_photos_of_changing_light_from_the_decision_on():
    photos, (gains, run) = photos_by(random_gains(0.15, 3)), begin("auto")
    photo = photos(5)
    measure(gains, run, photos, late=False)
    assert gains.balanced(photo, batch_of(5)) is photo, "a young field errs more than photos differ"
    assert gains.state_dict()["divides"] is None
    measure(gains, run, photos, rounds=1)
    assert gains.state_dict()["divides"] is True
    seldom, run = begin("auto")
    measure(seldom, run, photos, rounds=1)
    assert seldom.state_dict()["divides"] is None, "photos were not measured often enough"
    measure(seldom, run, photos, rounds=1)
    assert seldom.state_dict()["divides"] is True
    asked, run = begin("on")
    measure(asked, run, photos, rounds=13)
    torch.testing.assert_close(found(gains), found(asked), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("true", [EVEN, PLACE, THREE], ids=["even light", "the place", "three photos"])
def test_auto_leaves_a_capture_of_even_light_alone_and_measures_no_more(true):
    """So it is trained as without gains, to the bit. A few photos in other light are no change of exposure."""
    gains, run = begin("auto")
    measure(gains, run, photos_by(0.3 * true))
    photo, before = image_of(0), gains.state_dict()
    assert before["divides"] is False
    assert gains.balanced(photo, batch_of(0)) is photo
    gains.observe(photo, photo * 2, None, batch_of(0))
    update(gains, run)
    assert all(torch.equal(gains.state_dict()[name], before[name]) for name in ("sums", "counts", "gains"))


def test_a_decision_is_resumed_and_an_option_replaces_it():
    gains, run = begin("auto")
    measure(gains, run, lambda index: image_of(index) * (1 + index % 2))
    saved = gains.state_dict()
    for mode, divides in (("auto", True), ("on", True), ("off", False)):
        other, _ = begin(mode)
        other.load_state_dict(ON_CPU, saved)
        assert other.state_dict()["divides"] is divides
        photo = image_of(1)
        assert (other.balanced(photo, batch_of(1)) is not photo) is divides


def test_the_end_says_what_was_taken_out(capsys):
    gains, run = begin()
    gains.finish(run)
    assert "as bright as those beside them" in " ".join(capsys.readouterr().out.split())
    measure(gains, run, lambda index: image_of(index) * (1.3 if index % 2 else 1.0))
    gains.finish(run)
    assert "up to 12% brighter or darker" in " ".join(capsys.readouterr().out.split())
    quiet, run = begin("auto")
    measure(quiet, run, image_of)
    quiet.finish(run)
    assert capsys.readouterr().out == ""
