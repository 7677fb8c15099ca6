"""How a search looks at held-back views, and what masks leave out of that."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from budget_runs import Make
from nerfstudio.engine.trainer import Trainer
from torch import Tensor

from sundae_ns.errors import DataError
from sundae_ns.training.budget.run import EXACT
from sundae_ns.training.budget.run import Run as Searched
from sundae_ns.training.budget.search import NO_PICTURE


def searched(trainer: Trainer) -> Searched:
    return Searched(trainer.pipeline.model, None, trainer.pipeline.datamanager)  # type: ignore[arg-type]


def test_a_look_is_always_a_number(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    run = searched(make())
    model: Any = run.model
    assert 5 < run.measure() < 40
    views = list(run.datamanager.holdout_views())
    model.eval()
    with torch.no_grad():
        exact = model.get_outputs_for_camera(views[0][0])["rgb"]
    model.train()
    monkeypatch.setattr(run.datamanager, "holdout_views", lambda: [(views[0][0], {"image": exact})])
    assert run.measure() == EXACT
    model.gauss_params["features_dc"].data[:] = torch.nan
    assert run.measure() == NO_PICTURE


def test_what_masks_leave_out_of_training_judges_nothing(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    run = searched(make())
    views = list(run.datamanager.holdout_views())

    def measured(mask: Tensor | None, color: int = 0) -> float:
        shown = []
        for camera, batch in views:
            image = batch["image"].clone()
            if mask is not None:
                image[~mask] = color
            shown.append((camera, {"image": image, **({} if mask is None else {"mask": mask[..., None]})}))
        monkeypatch.setattr(run.datamanager, "holdout_views", lambda: iter(shown))
        return run.measure()

    left = torch.zeros(24, 24, dtype=torch.bool)
    left[:, :12] = True
    assert measured(left) != pytest.approx(measured(~left), abs=0.01)
    assert measured(left) == measured(left, 255)
    assert measured(torch.ones_like(left)) == pytest.approx(measured(None), abs=1e-4)
    with pytest.raises(DataError, match="masks leave nothing of the held-back views"):
        measured(torch.zeros_like(left))


def test_what_masks_leave_out_of_training_asks_for_nothing(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    run = searched(make())
    cameras = [camera for camera, _ in run.datamanager.training_views()]
    whole = run.contribution()
    left = torch.zeros(24, 24, 1, dtype=torch.bool)
    left[:, :12] = True
    parts = []
    for mask in (left, ~left):
        shown = [(camera, mask) for camera in cameras]
        monkeypatch.setattr(run.datamanager, "training_views", lambda shown=shown: iter(shown))
        parts.append(run.contribution())
    assert not torch.equal(parts[0], whole)
    torch.testing.assert_close(parts[0] + parts[1], whole)


def test_a_view_that_is_masked_whole_is_passed_over(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    run = searched(make())
    first, *others = run.datamanager.holdout_views()
    monkeypatch.setattr(run.datamanager, "holdout_views", lambda: iter(others))
    expected = run.measure()
    hidden = (first[0], {**first[1], "mask": torch.zeros(24, 24, 1, dtype=torch.bool)})
    monkeypatch.setattr(run.datamanager, "holdout_views", lambda: iter([hidden, *others]))
    assert run.measure() == expected
