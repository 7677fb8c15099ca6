from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from sundae_ns.evaluation import Configuration, Measured, ViewQuality


def test_a_row_pairs_each_time_with_the_quality_of_its_configuration(measured: Callable[..., Measured]) -> None:
    row = measured().row()
    assert (row.ms_frame, row.psnr) == (3.5, pytest.approx(25.5))
    assert (row.ms_splat, row.psnr_base) == (2.0, pytest.approx(25.0))
    assert (row.ssim, row.ssim_base) == (pytest.approx(0.85), pytest.approx(0.8))
    assert (row.bytes_primitives, row.bytes_head, row.bytes_total) == (2_000_000, 1_000_000, 3_000_000)


def test_without_a_head_full_and_base_are_the_same(measured: Callable[..., Measured]) -> None:
    run = measured(head=False)
    assert not run.has_head
    row = run.row()
    assert (row.psnr, row.ms_frame) == (row.psnr_base, row.ms_splat) == (pytest.approx(25.0), 2.0)


def test_a_mean_needs_all_views() -> None:
    whole = (ViewQuality(20.0, 0.5, 0.1), ViewQuality(22.0, 0.7, 0.3))
    assert Configuration("x", 1.0, 1, whole).mean("flip") == pytest.approx(0.2)
    assert Configuration("x", 1.0, 1, whole).mean("lpips") is None
    assert Configuration("x", 1.0, 1, (*whole, ViewQuality(21.0, math.nan))).mean("flip") is None
    assert Configuration("x", 1.0, 1, (*whole, ViewQuality(21.0, math.nan))).mean("ssim") is None
    assert Configuration("x", 1.0, 1, ()).mean("psnr") is None


def test_the_net_is_named_only_if_lpips_was_measured(measured: Callable[..., Measured]) -> None:
    run = replace(measured(head=False), lpips_net="alex")
    assert run.row().lpips_net == ""
    views = tuple(replace(view, lpips=0.3) for view in run.full.views)
    run = replace(run, configurations=(replace(run.full, views=views),))
    assert (run.row().lpips, run.row().lpips_net) == (pytest.approx(0.3), "alex")


def test_json_has_no_nan(measured: Callable[..., Measured]) -> None:
    run = measured(head=False)
    run = replace(run, configurations=(replace(run.full, views=(ViewQuality(math.inf, math.nan),)),))
    read = json.loads(json.dumps(run.as_json(), allow_nan=False))
    assert read["configurations"][0]["views"][0]["ssim"] is None
    assert read["bytes_total"] == 1_000_000
