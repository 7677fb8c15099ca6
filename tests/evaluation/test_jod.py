"""JOD of images: what is handed to the package of its authors, and what comes back."""

from __future__ import annotations

import sys
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from sundae_ns.errors import DataError
from sundae_ns.evaluation import jod as module
from sundae_ns.evaluation.jod import JOD_DISPLAY, jod, jod_available


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """A package in place of the authors', which notes what it is asked."""
    asked: list[dict[str, Any]] = []

    class Metric:
        def __init__(self, **options: Any) -> None:
            asked.append(options)

        def predict(self, test: Tensor, reference: Tensor, dim_order: str) -> tuple[Tensor, None]:
            asked.append({"test": test, "reference": reference, "dim_order": dim_order})
            return 10 - (test - reference).abs().max(), None

    monkeypatch.setitem(sys.modules, "pycvvdp", SimpleNamespace(cvvdp=Metric, __spec__=object()))
    module.jod_metric.cache_clear()
    yield asked  # type: ignore[misc]
    module.jod_metric.cache_clear()


def test_the_rendering_is_judged_against_its_truth(package: list[dict[str, Any]]) -> None:
    truth, image = torch.full((4, 6, 3), 0.5, dtype=torch.float64), torch.full((4, 6, 3), 1.5, dtype=torch.float64)
    found = jod(image, truth)
    assert found is not None
    assert (found.shape, found.dtype, float(found)) == ((), torch.float32, 9.5)  # the rendering is clamped
    made, call = package
    assert (made["display_name"], made["device"]) == (JOD_DISPLAY, torch.device("cpu"))
    assert call["dim_order"] == "HWC"
    assert float(call["reference"].max()) == 0.5
    jod(image, truth)
    assert len(package) == 3, "the metric is made once"


def test_without_the_package_there_is_no_figure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module.importlib.util, "find_spec", lambda name: None)
    assert jod(torch.zeros(4, 6, 3), torch.zeros(4, 6, 3)) is None


def test_images_of_two_sizes_are_refused() -> None:
    with pytest.raises(DataError, match="two of one size"):
        jod(torch.zeros(4, 6, 3), torch.zeros(4, 5, 3))


@pytest.mark.skipif(not jod_available(), reason="pip install cvvdp")
def test_differences_that_show_cost_more() -> None:
    truth = torch.rand(64, 96, 3, generator=torch.Generator().manual_seed(0))
    same, little, much = (float(jod((truth + step).clamp(0, 1), truth)) for step in (0.0, 0.05, 0.3))  # type: ignore[arg-type]
    assert same == 10
    assert same > little > much
