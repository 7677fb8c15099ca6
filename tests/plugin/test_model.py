"""The model: what it is to nerfstudio, its checkpoints, prunes and metrics."""

import weakref
from copy import deepcopy

import pytest
import torch
import torchmetrics.image
from nerfstudio.models.splatfacto import SplatfactoModel
from torch import Tensor
from trial_runs import same

from sundae_ns.core.camera import crop_image
from sundae_ns.core.errors import BackendError, CheckpointError, ConfigError, DataError
from sundae_ns.core.gaussians import Gaussians, sh_to_rgb
from sundae_ns.core.metrics import psnr
from sundae_ns.pruning.decision import decide


def test_it_is_a_splatfacto_whose_groups_have_features_and_head(build):
    model = build()
    assert isinstance(model, SplatfactoModel)
    groups = model.get_param_groups()
    assert set(groups) == {*model.gauss_params, "compensation"}
    assert "features" in groups
    assert set(build(head={"mode": "off"}).get_param_groups()) == set(groups) - {"compensation", "features"}


@pytest.mark.parametrize(
    ("options", "cause"),
    [
        ({"pruning": {"keep_ratio": 0.0}}, "keep_ratio"),
        ({"head": {"num_features": 0}}, "head.num-features is 0; set at least 1"),
        ({"head": {"pixel_unshuffle": 0}}, "head.pixel-unshuffle is 0; set 1, 2 or 4"),
        ({"drop_rate": 1.0}, "drop-rate is 1.0; give a share of the Gaussians"),
        ({"prior_after_prune": float("nan")}, "prior-after-prune is nan; give 0 or more"),
        ({"use_bilateral_grid": True}, "use-bilateral-grid is True; give False"),
        ({"use_scale_regularization": True}, "False: only splatfacto has it"),
        ({"sh_degree": 5}, "sh-degree is 5; give 0 to 4"),
        ({"ssim_lambda": 1.5}, "ssim-lambda is 1.5; give a share"),
    ],
)
def test_options_that_cannot_work(build, options, cause):
    with pytest.raises(ConfigError, match=f"^.*({cause}).*$"):
        build(**options)


def test_gsplat_without_cuda_is_refused_before_the_first_step(build, training_of, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    model = build(rasterizer="gsplat")
    with pytest.raises(BackendError, match="CUDA is not available[^\n]*$"):
        training_of(model)


@pytest.mark.parametrize("steps", [1, 5])
def test_round_trip_into_another_count_keeps_optimizers_alive(build, training_of, tmp_path, steps):
    """During densification, and after the prune."""
    source, target = training_of(build()), training_of(build(n=25))
    for step in range(steps):
        source.step(step)
    assert source.model.num_points == (60 if steps == 1 else 30)
    held = dict(target.model.gauss_params.items())
    torch.save(source.model.state_dict(), tmp_path / "a.pt")
    target.model.load_state_dict(torch.load(tmp_path / "a.pt", weights_only=True))
    assert all(target.model.gauss_params[name] is value for name, value in held.items())
    for name, value in source.model.state_dict().items():
        if isinstance(value, Tensor):
            assert torch.equal(target.model.state_dict()[name], value), name
    assert target.model.step == steps - 1
    same(*(made.model.get_extra_state()["running"] for made in (target, source)))
    assert target.model.state.head_enabled == source.model.state.head_enabled == (steps == 5)
    target.optimizers.load_optimizers(deepcopy({k: v.state_dict() for k, v in source.optimizers.optimizers.items()}))
    assert target.live()
    losses = []
    for training in (source, target):
        torch.manual_seed(5)
        losses.append(training.step(steps))
    torch.testing.assert_close(losses[1], losses[0])
    for name, value in target.model.gauss_params.items():
        torch.testing.assert_close(value, source.model.gauss_params[name])


@pytest.mark.parametrize(
    ("options", "cause"),
    [
        ({"head": {"mode": "off"}}, "has num_features 0, the model 5"),
        ({"head": {"size": "compact"}}, "head"),
        ({"head": {"mode": "features"}}, "head"),
        ({"sh_degree": 2}, "features_rest"),
    ],
)
def test_other_checkpoints_are_refused_and_nothing_changes(build, options, cause):
    state, model = build(n=25, **options).state_dict(), build()
    before = {name: value.detach().clone() for name, value in model.named_parameters()}
    with pytest.raises(CheckpointError, match=f"{cause}[^\n]*$") as caught:
        model.load_state_dict(state)
    assert isinstance(caught.value, ValueError), "nerfstudio would catch a RuntimeError, and load what fits"
    assert all(torch.equal(value, before[name]) for name, value in model.named_parameters())


N = 60  # Gaussians of a model that is built without a count
GROWTH = {"warmup_length": 0, "refine_every": 3, "reset_alpha_every": 100, "densify_grad_thresh": 1e-9}
"""A step of growth every third step."""


def test_continuous_pruning_and_densification_share_a_field(build, training_of):
    span = {"mode": "continuous", "start": 4, "stop": 12, "every": 4, "target_gaussians": 40, "max_gaussians": 70}
    model = build(head={"start_at": 2}, pruning=span, stop_split_at=14, **GROWTH)
    training = training_of(model)
    training.train_callbacks["densification"].strategy.pause_refine_after_reset = 0
    counts = []
    for step in range(15):
        training.step(step)
        counts.append(model.num_points)
        if step > 3:
            assert training.live()
        assert all(value.isfinite().all() for value in model.gauss_params.values())
        if model.state.pruning["pruned_at"] == step:
            direction = training.optimizers.optimizers["scales"].state[model.gauss_params["scales"]]["exp_avg"]
            # What was merged starts without one, and what stayed as it is keeps its own.
            assert 0 < int((direction == 0).all(dim=1).sum()) < model.num_points
        rows = [value for value in model.state.densification.values() if isinstance(value, Tensor) and value.ndim]
        assert {len(value) for value in rows} <= {model.num_points}
    # The cap holds at every step, and between growing and culling; densification ends with the last prune.
    assert 40 < max(counts) <= model.state.pruning["peak"] <= 70
    assert [counts[step] for step in (4, 8, 12, 13, 14)] == [40] * 5
    assert model.state.head_enabled


@pytest.mark.parametrize("prune_at", [0, 4])
def test_nothing_grows_after_the_prune(build, training_of, prune_at):
    """Not even where the prune is the first thing that happens, as it may be after a warm start."""
    model = build(pruning={"prune_at": prune_at}, stop_split_at=14, **GROWTH)
    training, counts = training_of(model), []
    training.train_callbacks["densification"].strategy.pause_refine_after_reset = 0
    for step in range(11):
        training.step(step)
        counts.append(model.num_points)
    assert (max(counts[:prune_at], default=0) > N) == (prune_at > 0)
    assert len(set(counts[prune_at:])) == 1
    assert counts[-1] == round(0.5 * (N if prune_at == 0 else counts[prune_at - 1]))


def test_a_field_that_loses_its_last_gaussian_ends_the_training(build, training_of):
    training = training_of(build(pruning={"prune_at": 9}, cull_alpha_thresh=1.0, **GROWTH))
    with pytest.raises(DataError, match="no Gaussian is left: all became transparent"):
        list(map(training.step, range(9)))


def test_a_prune_merges_colours(build, training_of, datamanager):
    """Without harmonics the first band holds logits of colours; prunes work on the colours."""
    model = build(sh_degree=0)
    training = training_of(model)
    with torch.no_grad():
        model.gauss_params["features_dc"].mul_(4)
    assert model.state.gaussians.encoding == "logits"
    harmonics = Gaussians({name: value.clone() for name, value in model.state.gaussians.as_harmonics().items()})
    count = model.num_points // 2
    expected = decide(harmonics, model.config.pruning, count, model.contribution(datamanager, count)).values
    training.act("pruning", 3)
    assert torch.equal(model.means, expected["means"])
    found = model.gauss_params["features_dc"].detach().sigmoid()
    torch.testing.assert_close(found, sh_to_rgb(expected["features_dc"]), rtol=0, atol=2e-3)


def test_metrics_with_and_without_the_head(build, perturb, camera, batch, monkeypatch):
    model = perturb(build()).eval()
    monkeypatch.setattr(model.lpips, "_failed", True)
    with torch.no_grad():
        outputs = model.get_outputs_for_camera(camera())
    metrics, images = model.get_image_metrics_and_images(outputs, batch())
    assert set(metrics) == {"gaussian_count"} | {a + b for a in ("psnr", "psnr_fitted", "ssim") for b in ("", "_base")}
    assert all(type(value) is float for value in metrics.values())
    truth = batch()["image"].float() / 255
    for suffix, name in (("", "rgb"), ("_base", "base_rgb")):
        assert metrics["psnr" + suffix] == pytest.approx(float(psnr(outputs[name], truth)), abs=1e-4)
    assert metrics["psnr"] != metrics["psnr_base"]
    assert metrics["psnr_fitted"] > metrics["psnr"]
    assert images["img"].shape == (32, 80, 3)
    # A picture with alpha is composited over the background that it was rendered with.
    assert torch.isfinite(torch.tensor(model.get_image_metrics_and_images(outputs, batch(channels=4))[0]["psnr"]))


def test_metrics_of_a_step_cost_nothing_until_they_are_looked_at(build, perturb, camera, batch, monkeypatch):
    model = perturb(build()).train()
    outputs, asked = model.get_outputs(camera()), []
    monkeypatch.setattr("sundae_ns.plugin.model.psnr", lambda *pictures: asked.append(pictures) or psnr(*pictures))
    metrics = model.get_metrics_dict(outputs, batch())
    assert set(metrics) == {"psnr", "psnr_base", "gaussian_count"}
    assert not asked
    rgb, graph = outputs["rgb"].detach().clamp(0, 1), weakref.ref(outputs["rgb"])
    truth = crop_image(batch()["image"].float() / 255, outputs["window"])  # as mirrored as the picture
    del outputs  # what the picture was made from goes with it
    assert graph() is None
    assert float(metrics["psnr"]) == pytest.approx(float(psnr(rgb, truth)), abs=1e-4)
    assert metrics["psnr"] != metrics["psnr_base"]
    assert len(asked) == 2


@pytest.mark.parametrize("training", [True, False])
def test_late_metrics_are_of_the_step_they_were_asked_in(build, perturb, camera, batch, training):
    options = {"num_downscales": 2, "resolution_schedule": 3000, "background_color": "black"}
    model = perturb(build(**options)).train(training)

    def asked():
        with torch.no_grad():
            return model.get_metrics_dict(model.get_outputs(camera()), batch())

    at_once, later = asked(), asked()
    expected = [float(at_once[name]) for name in ("psnr", "psnr_base")]
    model.train(not training)  # a viewer's thread, or an evaluation, in between
    model.step = 9000
    assert [float(later[name]) for name in ("psnr", "psnr_base")] == expected


def test_lpips_is_not_built_and_not_saved(build, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("LPIPS was built")

    monkeypatch.setattr(torchmetrics.image.LearnedPerceptualImagePatchSimilarity, "__init__", refuse)
    model = build()
    assert not [name for name in model.state_dict() if "lpips" in name]
    assert not [name for name, _ in model.named_modules() if "lpips" in name]
    # The field, the head and nerfstudio's empty marker of the device; nothing else costs bytes.
    known = ("gauss_params.", "networks.head.", "device_indicator_param", "_extra_state", "ssim.", "camera_optimizer.")
    assert not [name for name in model.state_dict() if not name.startswith(known)]
