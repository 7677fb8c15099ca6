"""How a search evaluates held-out views, and what masks leave out."""

from __future__ import annotations

import pytest
import torch
from budget_runs import Make, searched_field
from torch import Tensor

from sundae_ns.errors import DataError
from sundae_ns.training.budget.search import NO_IMAGE
from sundae_ns.training.heldout import EXACT


def test_an_evaluation_is_always_a_number(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = make()
    searched, manager, model = searched_field(trainer), trainer.pipeline.datamanager, trainer.pipeline.model
    assert 5 < searched.measure() < 40
    views = list(manager.holdout_views())
    model.eval()
    with torch.no_grad():
        exact = model.get_outputs_for_camera(views[0][0])["rgb"]
    model.train()
    monkeypatch.setattr(manager, "holdout_views", lambda: [(views[0][0], {"image": exact})])
    assert searched.measure() == EXACT
    model.gauss_params["features_dc"].data[:] = torch.nan
    assert searched.measure() == NO_IMAGE


def test_masked_pixels_do_not_count(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = make()
    searched, manager = searched_field(trainer), trainer.pipeline.datamanager
    views = list(manager.holdout_views())

    def measured(mask: Tensor | None, color: int = 0) -> float:
        shown = []
        for camera, batch in views:
            image = batch["image"].clone()
            if mask is not None:
                image[~mask] = color
            shown.append((camera, {"image": image, **({} if mask is None else {"mask": mask[..., None]})}))
        monkeypatch.setattr(manager, "holdout_views", lambda: iter(shown))
        return searched.measure()

    left = torch.zeros(24, 24, dtype=torch.bool)
    left[:, :12] = True
    assert measured(left) != pytest.approx(measured(~left), abs=0.01)
    assert measured(left) == measured(left, 255)
    assert measured(torch.ones_like(left)) == pytest.approx(measured(None), abs=1e-4)
    with pytest.raises(DataError, match="masks leave no pixel of the held-out views"):
        measured(torch.zeros_like(left))


def test_masked_pixels_add_no_contribution(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = make()
    searched, manager = searched_field(trainer), trainer.pipeline.datamanager
    cameras = [camera for camera, _ in manager.training_views()]
    whole = searched.contribution()
    left = torch.zeros(24, 24, 1, dtype=torch.bool)
    left[:, :12] = True
    parts = []
    for mask in (left, ~left):
        shown = [(camera, mask) for camera in cameras]
        monkeypatch.setattr(manager, "training_views", lambda shown=shown: iter(shown))
        parts.append(searched.contribution())
    assert not torch.equal(parts[0], whole)
    torch.testing.assert_close(parts[0] + parts[1], whole)


def test_a_wholly_masked_view_is_skipped(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = make()
    searched, manager = searched_field(trainer), trainer.pipeline.datamanager
    first, *others = manager.holdout_views()
    monkeypatch.setattr(manager, "holdout_views", lambda: iter(others))
    expected = searched.measure()
    hidden = (first[0], {**first[1], "mask": torch.zeros(24, 24, 1, dtype=torch.bool)})
    monkeypatch.setattr(manager, "holdout_views", lambda: iter([hidden, *others]))
    assert searched.measure() == expected
