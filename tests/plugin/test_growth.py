"""Prunes of a model: continuous ones while the field grows, and of colours without harmonics."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from sundae_ns.core.gaussians import Gaussians, sh_to_rgb
from sundae_ns.plugin.model import SundaeModel
from sundae_ns.pruning.decision import decide

Build = Callable[..., SundaeModel]
TrainingOf = Callable[[SundaeModel], Any]

N = 60
"""Gaussians of a model that is built without a count."""


@pytest.mark.parametrize("head_start", [None, 2])
def test_continuous_pruning_and_densification_share_a_field(
    build: Build, training_of: TrainingOf, head_start: int | None
) -> None:
    model = build(
        head={"start_at": head_start},
        pruning={
            "mode": "continuous",
            "start": 4,
            "stop": 12,
            "every": 4,
            "target_gaussians": 40,
            "max_gaussians": 70,
        },
        warmup_length=0,
        refine_every=3,
        reset_alpha_every=100,
        densify_grad_thresh=1e-9,
        stop_split_at=14,
    )
    training = training_of(model)
    training.train_callbacks["densification"].strategy.pause_refine_after_reset = 0
    counts = []
    for step in range(15):
        training.step(step)
        counts.append(model.num_points)
        if step > 3:
            assert training.live()
        assert all(
            len(value) == model.num_points
            for value in model.state.densification.values()
            if isinstance(value, Tensor) and value.ndim
        )
    assert [counts[step] for step in (4, 8, 12)] == [40, 40, 40]
    assert max(counts) > 40
    # The cap holds at every step, and between growing and culling; densification ends with the last prune.
    assert 40 < model.state.pruning["peak"] <= 70
    assert counts[12:] == [40, 40, 40]
    assert model.state.head_enabled


def test_continuous_pruning_merges_and_leaves_adam_in_order(
    build: Build, training_of: TrainingOf, capsys: pytest.CaptureFixture[str]
) -> None:
    densified = {"warmup_length": 0, "refine_every": 3, "reset_alpha_every": 100, "stop_split_at": 9}
    model = build(
        pruning={"mode": "continuous", "start": 4, "stop": 10, "every": 4},
        densify_grad_thresh=1e-9,
        **densified,
    )
    training = training_of(model)
    training.train_callbacks["densification"].strategy.pause_refine_after_reset = 0
    for step in range(13):
        training.step(step)
        assert training.live() or step < 4
        assert all(value.isfinite().all() for value in model.gauss_params.values())
        if model.state.pruning["pruned_at"] == step:
            scales = model.gauss_params["scales"]
            direction = training.optimizers.optimizers["scales"].state[scales]["exp_avg"]
            # What was merged starts without one, and what stayed as it is keeps its own.
            assert 0 < int((direction == 0).all(dim=1).sum()) < model.num_points
    counts = [tuple(map(int, pair)) for pair in re.findall(r"kept (\d+) of (\d+)", capsys.readouterr().out)]
    assert len(counts) == 2
    assert all(after == round(before / 2) for after, before in counts)
    assert counts[0][1] > N


@pytest.mark.parametrize("prune_at", [0, 4])
def test_nothing_grows_after_the_prune(build: Build, training_of: TrainingOf, prune_at: int) -> None:
    """Not even where the prune is the first thing that happens, as it may be after a warm start."""
    grows = {"warmup_length": 0, "refine_every": 3, "reset_alpha_every": 100, "densify_grad_thresh": 1e-9}
    model = build(pruning={"prune_at": prune_at}, stop_split_at=14, **grows)
    training, counts = training_of(model), []
    training.train_callbacks["densification"].strategy.pause_refine_after_reset = 0
    for step in range(11):
        training.step(step)
        counts.append(model.num_points)
    assert (max(counts[:prune_at], default=0) > N) == (prune_at > 0)
    assert len(set(counts[prune_at:])) == 1
    assert counts[-1] == round(0.5 * (N if prune_at == 0 else counts[prune_at - 1]))


def test_a_prune_merges_colours(build: Build, training_of: TrainingOf, datamanager: Any) -> None:
    """Without harmonics the first band holds logits of colours; prunes work on the colours."""
    model = build(sh_degree=0)
    training = training_of(model)
    with torch.no_grad():
        model.gauss_params["features_dc"].mul_(4)
    assert model.state.gaussians.encoding == "logits"
    harmonics = Gaussians(
        {name: value.detach().clone() for name, value in model.state.gaussians.as_harmonics().items()}
    )
    count = model.num_points // 2
    expected = decide(harmonics, model.config.pruning, count, model.contribution(datamanager, count)).values
    assert expected is not None
    training.act("pruning", 3)
    assert torch.equal(model.means, expected["means"])
    found = model.gauss_params["features_dc"].detach().sigmoid()
    torch.testing.assert_close(found, sh_to_rgb(expected["features_dc"]), rtol=0, atol=2e-3)
