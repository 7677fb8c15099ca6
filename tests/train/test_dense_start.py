"""The dense start: who gets it, what it puts into the field, and that it happens once."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from sundae_ns.core.gaussians import sh_to_rgb
from sundae_ns.plugin.model import SundaeModel
from sundae_ns.train import initialize

Build = Callable[..., SundaeModel]
TrainingOf = Callable[..., Any]
FOUND = 40


class FakeSweep:
    """Finds points at a known place, of a known colour."""

    longest = 0
    wanted = 0
    seen: Tensor
    most = FOUND

    def __init__(self, photos: Iterable[Any], sparse: Tensor, longest: int) -> None:
        self.photos, self.swept = list(photos), set[int]()
        FakeSweep.longest, FakeSweep.seen = longest, sparse

    def add(self, index: int) -> None:
        self.swept.add(index)

    def points(self, wanted: int) -> tuple[Tensor, Tensor]:
        assert self.swept == {0, 1, 2}
        FakeSweep.wanted = wanted
        place = torch.arange(3.0 * self.most).reshape(-1, 3) / self.most + 5
        return place, torch.tensor([[0.2, 0.4, 0.6]]).repeat(self.most, 1)


@pytest.fixture(autouse=True)
def fake(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(initialize, "Sweep", FakeSweep)
    monkeypatch.setattr(FakeSweep, "most", FOUND)


def few(build: Build, **options: Any) -> SundaeModel:
    return build(**{"dense_start_views": 24, **options})


def test_the_field_starts_from_both_clouds(
    build: Build, training_of: TrainingOf, points: Callable[..., Any], capsys: pytest.CaptureFixture[str]
) -> None:
    model = few(build, sh_degree=1)
    alone = model.scales.detach().clone()
    training = training_of(model)
    assert model.num_points == 60 + FOUND
    assert torch.equal(model.means[:60].detach(), points()[0])
    assert torch.equal(FakeSweep.seen, points()[0])
    assert (FakeSweep.longest, FakeSweep.wanted) == (initialize.SIDES["cpu"], initialize.FILLED["cpu"] - 60)
    assert float((model.means[60:].detach() - 5).min()) >= 0
    colours = sh_to_rgb(model.gauss_params["features_dc"][60:].detach())
    assert torch.allclose(colours, torch.tensor([0.2, 0.4, 0.6]).expand(FOUND, 3), atol=1e-5)
    # Widths follow the neighbours in both clouds: those of the dense one are a twentieth of the distances of the other.
    assert float(model.scales[60:].detach().max()) < float(alone.median())
    assert "40 points by a plane sweep beside 60 sparse ones" in " ".join(capsys.readouterr().out.split())
    assert training.live()
    training.step(0)
    assert training.live()


@pytest.mark.parametrize(
    "options",
    [
        {"dense_start_views": 3},  # the model has 4 training images
        {"dense_start_views": 0},
        {"random_init": True, "num_random": 60},
        {"seed_points": None, "num_random": 60},
    ],
)
def test_other_fields_stay_as_they_are(build: Build, training_of: TrainingOf, options: dict[str, Any]) -> None:
    model = few(build, **options)
    before = {name: value.detach().clone() for name, value in model.gauss_params.items()}
    training_of(model)
    assert all(torch.equal(before[name], value) for name, value in model.gauss_params.items())


def test_a_resumed_run_goes_on_with_its_own_field(build: Build, training_of: TrainingOf) -> None:
    training = training_of(few(build))
    training.step(0)
    saved = {
        name: value.clone() if isinstance(value, Tensor) else value
        for name, value in training.model.state_dict().items()
    }
    model = few(build)
    model.load_state_dict(saved)
    training_of(model)
    assert model.num_points == 60 + FOUND
    assert torch.equal(model.means.detach(), saved["gauss_params.means"])


def test_more_points_than_wanted_are_thinned_evenly(
    build: Build, training_of: TrainingOf, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FakeSweep, "most", 900)
    monkeypatch.setitem(initialize.FILLED, "cpu", 60 + 90)
    model = few(build)
    training_of(model)
    added = model.means[60:, 0].detach()
    assert len(added) == 90
    # Each tenth of the row has a tenth of them.
    assert torch.histc(added, bins=9, min=5, max=8).tolist() == pytest.approx([10] * 9, abs=1)


def test_a_cloud_that_is_not_sparse_stays_as_it_is(
    build: Build, training_of: TrainingOf, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(initialize.FILLED, "cpu", 60)
    monkeypatch.setattr(initialize, "Sweep", None)
    model = few(build)
    training_of(model)
    assert model.num_points == 60


@pytest.mark.parametrize(("most", "swept"), [(2, False), (3, True)])
def test_a_cpu_sweeps_few_views(
    build: Build, training_of: TrainingOf, monkeypatch: pytest.MonkeyPatch, most: int, swept: bool
) -> None:
    monkeypatch.setattr(initialize, "MOST_ON_CPU", most)
    model = few(build)
    training_of(model)
    assert model.num_points == 60 + swept * FOUND


def test_photos_are_the_training_images_with_their_views(build: Build, training_of: TrainingOf) -> None:
    training = training_of(build())
    run = training.callbacks[0].func.__self__
    photos = list(run.photos())
    assert [float(photo.camera.center[0]) for photo in photos] == pytest.approx([-0.5, 0.0, 0.5])
    assert [photo.mask for photo in photos] == [None] * 3
    (_, batch), *_ = run._datamanager.cameras([0])
    assert torch.allclose(photos[0].target, batch["image"].float() / 255)


def test_transparent_and_masked_pixels_are_masked(
    build: Build, training_of: TrainingOf, batch: Callable[..., dict[str, Tensor]], camera: Callable[..., Any]
) -> None:
    training = training_of(build())
    run = training.callbacks[0].func.__self__
    image = {**batch(channels=4), "mask": torch.ones(32, 40, 1, dtype=torch.bool)}
    image["mask"][:4] = False
    image["image"][..., 3] = 255
    image["image"][:, :7, 3] = 100
    run._pipeline.datamanager = SimpleNamespace(
        train_indices=[0], cached_train=[image], cameras=lambda indices: [(camera(), image) for _ in indices]
    )
    (photo,) = run.photos()
    expected = torch.ones(32, 40, dtype=torch.bool)
    expected[:4] = expected[:, :7] = False
    assert torch.equal(photo.mask, expected)
