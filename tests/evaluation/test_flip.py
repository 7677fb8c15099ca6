from __future__ import annotations

import pytest
import torch

from sundae_ns.errors import DataError
from sundae_ns.evaluation import flip

pytest.importorskip("flip_evaluator")


def test_equal_images_have_no_error_and_worse_ones_more() -> None:
    truth = torch.rand(24, 31, 3)
    assert flip(truth, truth) == 0
    errors = [float(flip((truth + noise).clamp(0, 1), truth)) for noise in (0.02, 0.1, 0.4)]
    assert 0 < errors[0] < errors[1] < errors[2] < 1


def test_black_against_white_is_near_the_maximum() -> None:
    assert float(flip(torch.zeros(64, 64, 3), torch.ones(64, 64, 3))) > 0.9


def test_it_is_the_authors_metric() -> None:
    from flip_evaluator import evaluate

    truth, image = torch.rand(20, 30, 3), torch.rand(20, 30, 3)
    expected = evaluate(truth.numpy(), image.numpy(), "LDR", applyMagma=False)[0].mean()
    assert float(flip(image, truth)) == pytest.approx(float(expected), rel=1e-4)
    # Values are clamped to [0, 1] first.
    assert float(flip(image + 2, truth)) == pytest.approx(float(flip(torch.ones_like(truth), truth)), abs=1e-6)


def test_none_without_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert flip(torch.zeros(4, 4, 3), torch.zeros(4, 4, 3)) is None


def test_images_of_two_sizes() -> None:
    with pytest.raises(DataError, match="shapes"):
        flip(torch.zeros(4, 4, 3), torch.zeros(4, 5, 3))
