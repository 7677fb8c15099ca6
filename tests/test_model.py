"""The model by itself, on the CPU: outputs, losses, pruning and checkpoints of a field made in memory."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from copy import deepcopy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import torchmetrics.image
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox, SceneBox
from nerfstudio.engine.callbacks import TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.models.splatfacto import SplatfactoModel
from nerfstudio.utils import colormaps, writer
from torch import Tensor

from sundae_ns import rendering
from sundae_ns.compensation import HeadConfig, resize
from sundae_ns.datamanager import DATASET_FRAME
from sundae_ns.errors import BackendError, CheckpointError, ConfigError, MemoryExhaustedError
from sundae_ns.model import SundaeModel, SundaeModelConfig
from sundae_ns.optimizers import FusedAdamConfig
from sundae_ns.pruning import PruningConfig
from sundae_ns.storage import similarity, write_ply

N = 60
VIEWER_KEYS = {"rgb": 3, "base_rgb": 3, "depth": 1, "accumulation": 1, "features": 3, "response": 1, "background": 3}


def points(n: int = N) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    xyz = torch.randn(n, 3, generator=generator) * 0.5
    return xyz, torch.randint(0, 256, (n, 3), generator=generator, dtype=torch.uint8)


def build(
    *,
    n: int = N,
    seed_points: Any = "some",
    head: dict[str, Any] | None = None,
    pruning: dict[str, Any] | None = None,
    metadata: dict[str, Any] | None = None,
    **options: Any,
) -> SundaeModel:
    config = SundaeModelConfig(
        pruning=PruningConfig(**{"prune_at": 3, "keep_ratio": 0.5, **(pruning or {})}),
        head=HeadConfig(**{"size": "tiny", "num_features": 5, "pixel_unshuffle": 1, **(head or {})}),
        camera_optimizer=CameraOptimizerConfig(mode="off"),
        **{"sh_degree": 1, "sh_degree_interval": 1, "num_downscales": 0, "background_color": "random", **options},
    )
    box = SceneBox(aabb=torch.tensor([[-1.0] * 3, [1.0] * 3]))
    seeds = points(n) if isinstance(seed_points, str) else seed_points
    return config.setup(scene_box=box, num_train_data=4, metadata=metadata or {}, seed_points=seeds)


def perturb(model: SundaeModel) -> SundaeModel:
    """Give the head an output, and move on to where it takes part."""
    if model.head is not None:
        with torch.no_grad():
            for value in model.head.parameters():
                value += 0.05 * torch.randn(value.shape, generator=torch.Generator().manual_seed(value.numel()))
    model.step = 10
    return model


def camera(width: int = 40, height: int = 32, shift: float = 0.0) -> Cameras:
    pose = torch.eye(4)[None, :3].clone()
    pose[0, :, 3] = torch.tensor([shift, 0.1, 3.0])
    return Cameras(pose, fx=30.0, fy=30.0, cx=width / 2, cy=height / 2, width=width, height=height)


class FakeDatamanager:
    """Three training cameras; no test views."""

    eval_dataset = None

    def training_cameras(self) -> Iterator[Cameras]:
        yield from (camera(shift=shift) for shift in (-0.5, 0.0, 0.5))


def batch(width: int = 40, height: int = 32, channels: int = 3) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(2)
    return {"image": torch.randint(0, 256, (height, width, channels), generator=generator, dtype=torch.uint8)}


class Training:
    """Steps a model as nerfstudio's trainer does, without one."""

    def __init__(self, model: SundaeModel) -> None:
        self.model = model
        groups = model.get_param_groups()
        self.optimizers = Optimizers(
            {name: {"optimizer": FusedAdamConfig(lr=5e-3), "scheduler": None} for name in groups}, groups
        )
        pipeline = SimpleNamespace(datamanager=FakeDatamanager(), model=model)
        self.callbacks = model.get_training_callbacks(
            TrainingCallbackAttributes(self.optimizers, None, pipeline, None)  # type: ignore[arg-type]
        )

    def _call(self, location: TrainingCallbackLocation, step: int) -> None:
        for callback in self.callbacks:
            callback.run_callback_at_location(step, location=location)

    def step(self, step: int) -> dict[str, Tensor]:
        self.model.train()
        self._call(TrainingCallbackLocation.BEFORE_TRAIN_ITERATION, step)
        self.optimizers.zero_grad_all()
        outputs = self.model(camera())
        losses = self.model.get_loss_dict(outputs, batch(), self.model.get_metrics_dict(outputs, batch()))
        torch.stack(list(losses.values())).sum().backward()
        self.optimizers.optimizer_step_all()
        self._call(TrainingCallbackLocation.AFTER_TRAIN_ITERATION, step)
        return losses

    def live(self) -> bool:
        """Whether model, optimizers and nerfstudio's own list hold the same tensors, with moments of their shape."""
        for name, value in self.model.gauss_params.items():
            (held,) = self.optimizers.optimizers[name].param_groups[0]["params"]
            moments = self.optimizers.optimizers[name].state[value]
            if held is not value or self.optimizers.parameters[name] != [value]:
                return False
            if moments and moments["exp_avg"].shape != value.shape:
                return False
        return True


@pytest.fixture(autouse=True)
def _no_leftovers() -> Iterator[None]:
    yield
    writer.EVENT_STORAGE.clear()


# --------------------------------------------------------------------------------------------------------- outputs


@pytest.mark.parametrize("size", [(30, 30), (31, 47), (97, 33)])
@pytest.mark.parametrize("mode", ["residual", "features", "off"])
@torch.no_grad()
def test_every_output_can_be_shown(mode: str, size: tuple[int, int]) -> None:
    model = perturb(build(head={"mode": mode})).eval()
    outputs = model.get_outputs_for_camera(camera(*size))
    assert {name: value.shape for name, value in outputs.items()} == {
        name: (size[1], size[0], channels) for name, channels in VIEWER_KEYS.items()
    }
    for name, value in outputs.items():
        assert value.dtype == torch.float32, name
        assert torch.isfinite(value).all(), name
        shown = colormaps.apply_colormap(value, colormaps.ColormapOptions(normalize=name == "depth"))
        assert shown.shape == (size[1], size[0], 3)
    for name in ("rgb", "base_rgb", "accumulation", "features", "response"):
        assert ((outputs[name] >= 0) & (outputs[name] <= 1)).all(), name
    assert outputs["response"].max() > 0
    assert (outputs["features"].std() > 0) == (mode != "off")


def test_outputs_that_nobody_asks_for_cost_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    model = perturb(build()).eval()
    splatted: list[int] = []
    rasterize = rendering.rasterize
    monkeypatch.setattr(rendering, "rasterize", lambda *a, **kwargs: splatted.append(1) or rasterize(*a, **kwargs))
    outputs = model.get_outputs_for_camera(camera())
    assert outputs["rgb"].shape == outputs["base_rgb"].shape
    assert (len(splatted), model._response.of) == (1, None)
    assert outputs["response"].max() > 0
    assert len(splatted) == 2


def test_outputs_belong_to_the_field_that_was_rendered() -> None:
    model = perturb(build()).eval()
    before = {name: value.clone() for name, value in model.get_outputs_for_camera(camera()).items()}
    outputs = model.get_outputs_for_camera(camera())
    with torch.no_grad():  # a prune, while another thread still shows the picture
        for name, value in model.gauss_params.items():
            model.gauss_params[name] = torch.nn.Parameter(value[::2].clone())
        model.pruning_state["num_prunes"] += 1
    assert {name for name, value in outputs.items() if not torch.equal(value, before[name])} == set()
    after = model.get_outputs_for_camera(camera())
    assert not torch.equal(after["response"], before["response"])


@torch.no_grad()
def test_a_crop_without_primitives_has_the_same_keys() -> None:
    model = perturb(build()).eval()
    whole = model.get_outputs_for_camera(camera())
    far = OrientedBox.from_params((50.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    empty = model.get_outputs_for_camera(camera(), obb_box=far)
    assert list(empty) == list(whole)
    assert {name: value.shape for name, value in empty.items()} == {n: v.shape for n, v in whole.items()}
    assert torch.equal(empty["rgb"], empty["background"])
    assert not empty["accumulation"].any()
    half = OrientedBox.from_params((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), (2.0, 9.0, 9.0))
    cropped = model.get_outputs_for_camera(camera(), obb_box=half)
    assert 0 < cropped["accumulation"].sum() < whole["accumulation"].sum()
    assert torch.equal(model.get_outputs_for_camera(camera())["rgb"], whole["rgb"])


@torch.no_grad()
def test_a_primitive_lands_where_the_pinhole_says() -> None:
    xyz = torch.tensor([[0.55, 0.35, 0.0]])
    model = build(seed_points=(xyz, torch.zeros(1, 3, dtype=torch.uint8))).eval()
    model.gauss_params["scales"].data.fill_(-5)
    alpha = model.get_outputs_for_camera(camera())["accumulation"][..., 0]
    row, column = divmod(int(alpha.argmax()), 40)
    # In front of the camera by 3; x to the right, y up, pixel centres at one half.
    assert (column, row) == (int(20 + 30 * 0.55 / 3), int(16 - 30 * 0.25 / 3))


@torch.no_grad()
def test_view_of_downscales_and_leaves_the_camera_alone() -> None:
    model = build().eval()
    shown = camera(41, 33)
    view = model.view_of(shown, downscale=2)
    assert (view.width, view.height) == (20, 16)
    torch.testing.assert_close(view.K, torch.tensor([[15.0, 0, 10.25], [0, 15.0, 8.25], [0, 0, 1]]))
    assert int(shown.width) == 41
    assert float(shown.fx) == 30.0
    torch.testing.assert_close(view.viewmat @ torch.tensor([0.0, 0.1, 3.0, 1.0]), torch.tensor([0.0, 0, 0, 1]))


@torch.no_grad()
def test_without_the_head_the_picture_is_the_base_exactly() -> None:
    model = perturb(build()).eval()
    on = model.get_outputs_for_camera(camera())
    assert (on["rgb"] - on["base_rgb"]).abs().max() > 1e-3
    off, _ = model.render(model.gaussians, model.view_of(camera()), on["background"], compensate=False)
    assert torch.equal(off["rgb"], off["base_rgb"])
    # With features in the same pass the sums are taken in another order.
    torch.testing.assert_close(off["base_rgb"], on["base_rgb"], atol=1e-6, rtol=0)
    model.step = 3
    before = model.get_outputs_for_camera(camera())
    assert torch.equal(before["rgb"], before["base_rgb"])


@torch.no_grad()
def test_residual_head_starts_at_the_base_and_features_head_does_not_need_it() -> None:
    residual, features = build(), build(head={"mode": "features"})
    residual.step = features.step = 10
    outputs = residual.eval().get_outputs_for_camera(camera())
    torch.testing.assert_close(outputs["rgb"], outputs["base_rgb"])
    first = features.eval().get_outputs_for_camera(camera())
    features.gauss_params["features_dc"].data.zero_()
    second = features.get_outputs_for_camera(camera())
    assert not torch.equal(first["base_rgb"], second["base_rgb"])
    assert torch.equal(first["rgb"], second["rgb"])


@torch.no_grad()
def test_viewer_may_switch_modes_between_frames() -> None:
    model = perturb(build()).eval()
    expected = model.get_outputs_for_camera(camera())["rgb"]
    model.train()
    model.get_outputs(camera())
    model.eval()
    assert torch.equal(model.get_outputs_for_camera(camera())["rgb"], expected)


@torch.no_grad()
@pytest.mark.parametrize("n", [1, 5])
def test_one_primitive_has_no_response_to_show_and_few_have_one(n: int) -> None:
    picture = build(n=n).eval().get_outputs_for_camera(camera())["response"]
    assert picture.isfinite().all()
    assert bool(picture.any()) == (n > 1)


@torch.no_grad()
def test_background_shows_where_nothing_is() -> None:
    model = build().eval()
    model.set_background(torch.tensor([0.2, 0.4, 0.6]))
    model.gauss_params["means"].data += 100.0
    outputs = model.get_outputs_for_camera(camera())
    torch.testing.assert_close(outputs["rgb"], torch.tensor([0.2, 0.4, 0.6]).expand(32, 40, 3))


# ------------------------------------------------------------------------------------------------- losses, metrics


@pytest.mark.parametrize("mode", ["residual", "features"])
def test_head_and_field_learn_together(mode: str) -> None:
    model = perturb(build(head={"mode": mode}))
    model.train()
    outputs = model.get_outputs(camera())
    losses = model.get_loss_dict(outputs, batch())
    assert set(losses) == {"main_loss", "base_loss"}
    assert all(isinstance(value, Tensor) for value in losses.values())
    torch.stack(list(losses.values())).sum().backward()
    for name, value in (*model.gauss_params.items(), *model.head.named_parameters()):  # type: ignore[union-attr]
        assert value.grad is not None, name
        assert torch.isfinite(value.grad).all(), name
        assert value.grad.any(), name


def test_before_the_head_starts_there_is_one_loss() -> None:
    assert set(Training(build()).step(0)) == {"main_loss"}
    assert set(Training(build(base_loss_weight=0.0)).step(10)) == {"main_loss"}


def test_masked_pixels_do_not_count() -> None:
    model = perturb(build(ssim_lambda=0.0))
    model.eval()
    outputs, target = model.get_outputs(camera()), batch()
    mask = torch.zeros(32, 40, 1, dtype=torch.bool)
    mask[:, :20] = True
    losses = model.get_loss_dict(outputs, {**target, "mask": mask})
    target["image"][:, 20:] = 0
    for name, value in model.get_loss_dict(outputs, {**target, "mask": mask}).items():
        assert torch.equal(value, losses[name])
    truth = target["image"].float() / 255
    expected = (outputs["rgb"] - truth).abs()[:, :20].sum() / truth.numel()
    torch.testing.assert_close(losses["main_loss"], expected)


def test_lower_resolution_at_first() -> None:
    model = build(num_downscales=1)
    assert torch.isfinite(Training(model).step(0)["main_loss"])
    assert model.get_outputs(camera())["rgb"].shape == (16, 20, 3)
    assert model.eval().get_outputs(camera())["rgb"].shape == (32, 40, 3)


def test_images_smaller_than_the_window_of_ssim() -> None:
    model = build().eval()
    outputs = model.get_outputs(camera(9, 8))
    loss = model.get_loss_dict(outputs, batch(9, 8))["main_loss"]
    truth = batch(9, 8)["image"].float() / 255
    torch.testing.assert_close(loss, (outputs["rgb"] - truth).abs().mean())


def test_metrics_with_and_without_the_head(monkeypatch: pytest.MonkeyPatch) -> None:
    model = perturb(build()).eval()
    monkeypatch.setattr(model.lpips, "download", False)
    monkeypatch.setattr("sundae_ns.evaluation.lpips.lpips_weights_available", lambda _: False)
    with torch.no_grad():
        outputs = model.get_outputs_for_camera(camera())
    metrics, images = model.get_image_metrics_and_images(outputs, batch())
    assert set(metrics) == {"gaussian_count", "psnr", "ssim", "psnr_base", "ssim_base"}
    assert all(type(value) is float for value in metrics.values())
    truth = batch()["image"].float() / 255
    for suffix, name in (("", "rgb"), ("_base", "base_rgb")):
        mse = ((outputs[name] - truth) ** 2).mean()
        assert metrics["psnr" + suffix] == pytest.approx(float(-10 * mse.log10()), abs=1e-4)
    assert metrics["psnr"] != metrics["psnr_base"]
    assert images["img"].shape == (32, 80, 3)
    # A picture with alpha is composited over the background that it was rendered with.
    assert torch.isfinite(torch.tensor(model.get_image_metrics_and_images(outputs, batch(channels=4))[0]["psnr"]))


def test_lpips_is_not_built_and_not_saved(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("LPIPS was built")

    monkeypatch.setattr(torchmetrics.image.LearnedPerceptualImagePatchSimilarity, "__init__", refuse)
    model = build()
    assert not [name for name in model.state_dict() if "lpips" in name]
    assert not [name for name, _ in model.named_modules() if "lpips" in name]
    # The field, the head and nerfstudio's empty marker of the device; nothing else costs bytes.
    known = ("gauss_params.", "head.", "device_indicator_param", "_extra_state", "ssim.", "camera_optimizer.")
    assert not [name for name in model.state_dict() if not name.startswith(known)]


# --------------------------------------------------------------------------------------------------------- pruning


@pytest.mark.parametrize("score", ["detail-contribution", "response-contribution", "opacity"])
def test_prune_keeps_the_count_and_training_goes_on(score: str, capsys: pytest.CaptureFixture[str]) -> None:
    training = Training(build(pruning={"score": score}, background_color="black"))
    losses = [training.step(step) for step in range(3)]
    assert training.model.num_points == N
    training.step(3)
    assert training.model.num_points == N // 2
    assert training.live()
    assert "kept 30 of 60" in " ".join(capsys.readouterr().out.split())
    before = training.model.means.detach().clone()
    losses += [training.step(step) for step in range(4, 20)]
    assert training.model.num_points == N // 2
    assert training.live()
    assert (training.model.means.detach() - before).abs().max() > 0
    assert losses[-1]["main_loss"] < losses[3]["main_loss"] - 0.01
    assert "base_loss" in losses[-1]
    assert "base_loss" not in losses[0]


def test_primitives_that_are_not_finite_are_dropped_and_counted(capsys: pytest.CaptureFixture[str]) -> None:
    training = Training(build())
    training.step(0)
    training.step(1)
    with torch.no_grad():
        training.model.gauss_params["means"][[3, 5]] = torch.nan
        training.model.gauss_params["scales"][7, 1] = torch.inf
        training.model.gauss_params["features"][9, 0] = torch.nan
    # A step on a broken field would spread the damage; the prune itself is what is tested.
    training._call(TrainingCallbackLocation.BEFORE_TRAIN_ITERATION, 3)
    training.callbacks[-1].run_callback_at_location(3, location=TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
    assert training.model.num_points == round(0.5 * (N - 4))
    assert all(torch.isfinite(value).all() for value in training.model.gauss_params.values())
    assert training.live()
    out = " ".join(capsys.readouterr().out.split())
    assert "dropped 4 primitives that were not finite" in out
    assert training.step(4)["main_loss"].isfinite()


@pytest.mark.parametrize("options", [{"mode": "off"}, {"keep_ratio": 1.0}])
def test_nothing_goes_unless_asked_for(options: dict[str, Any]) -> None:
    training = Training(build(pruning=options))
    for step in range(6):
        training.step(step)
    assert training.model.num_points == N


@pytest.mark.parametrize("head_start", [None, 2])
def test_continuous_pruning_and_densification_share_a_field(head_start: int | None) -> None:
    model = build(
        head={"start_at": head_start},
        pruning={
            "mode": "continuous",
            "start": 4,
            "stop": 12,
            "every": 4,
            "target_primitives": 40,
            "max_primitives": 70,
        },
        warmup_length=0,
        refine_every=3,
        reset_alpha_every=100,
        densify_grad_thresh=1e-9,
        stop_split_at=14,
    )
    model.strategy.pause_refine_after_reset = 0
    training = Training(model)
    counts = []
    for step in range(15):
        training.step(step)
        counts.append(model.num_points)
        if step > 3:
            assert training.live()
        assert all(
            len(value) == model.num_points
            for value in model.strategy_state.values()
            if isinstance(value, Tensor) and value.ndim
        )
    assert [counts[step] for step in (4, 8, 12)] == [40, 40, 40]
    assert max(counts) > 40
    # The cap holds at every step, and between growing and culling; densification ends with the last prune.
    assert 40 < model.pruning_state["peak"] <= 70
    assert counts[12:] == [40, 40, 40]
    assert model.head_active


def test_a_cloud_above_the_cap_is_cut_before_the_first_step(capsys: pytest.CaptureFixture[str]) -> None:
    model = build(pruning={"mode": "continuous", "max_primitives": 25})
    assert model.num_points == 25
    assert "starting from 25 of them" in " ".join(capsys.readouterr().out.split())


def test_continuous_pruning_merges_and_leaves_adam_in_order(capsys: pytest.CaptureFixture[str]) -> None:
    densified = {"warmup_length": 0, "refine_every": 3, "reset_alpha_every": 100, "stop_split_at": 9}
    model = build(
        pruning={"mode": "continuous", "start": 4, "stop": 10, "every": 4},
        densify_grad_thresh=1e-9,
        **densified,
    )
    model.strategy.pause_refine_after_reset = 0
    training = Training(model)
    for step in range(13):
        training.step(step)
        assert training.live() or step < 4
        assert all(value.isfinite().all() for value in model.gauss_params.values())
        if model.pruning_state["pruned_at"] == step:
            scales = model.gauss_params["scales"]
            direction = training.optimizers.optimizers["scales"].state[scales]["exp_avg"]
            # What was merged starts without one, and what stayed as it is keeps its own.
            assert 0 < int((direction == 0).all(dim=1).sum()) < model.num_points
    counts = [tuple(map(int, pair)) for pair in re.findall(r"kept (\d+) of (\d+)", capsys.readouterr().out)]
    assert len(counts) == 2
    assert all(after == round(before / 2) for after, before in counts)
    assert counts[0][1] > N


def test_the_detail_is_that_of_what_the_cap_leaves() -> None:
    config = PruningConfig(mode="continuous", max_primitives=30)
    assert (config.share(60), config.share(10), PruningConfig(keep_ratio=0.2).share(60)) == (0.5, 1.0, 0.2)


def test_contribution_is_the_weight_in_the_pictures() -> None:
    model = build(pruning={"score": "contribution"})
    model.gauss_params["means"].data[4] = torch.tensor([0.0, 0.0, 50.0])
    total = model.contribution(FakeDatamanager())  # type: ignore[arg-type]
    assert total.shape == (N,)
    assert not total.requires_grad
    assert (total >= 0).all()
    assert total[4] == 0
    model.eval()
    with torch.no_grad():
        alphas = [model.get_outputs_for_camera(view)["accumulation"] for view in FakeDatamanager().training_cameras()]
    assert float(total.sum()) == pytest.approx(float(torch.stack(alphas).sum()), rel=1e-4)


def test_contribution_to_detail_weighs_the_pixels_and_is_the_same_each_time() -> None:
    plain, weighted = (build(pruning={"score": f"{name}contribution"}) for name in ("", "detail-"))
    weighted.gauss_params.load_state_dict(plain.gauss_params.state_dict())
    found = [model.contribution(FakeDatamanager()) for model in (plain, weighted, weighted)]  # type: ignore[arg-type]
    assert torch.equal(found[1], found[2])
    assert torch.equal(found[1] > 0, found[0] > 0)
    seen = found[0] > 0
    ratio = found[1][seen] / found[0][seen]
    assert float(ratio.max()) > 1.1
    assert float(ratio.min()) < 0.9


@pytest.mark.parametrize("redistribution", ["merge", "grow"])
def test_rounds_prune_to_the_count_and_the_head_waits_for_the_last(redistribution: str) -> None:
    options = {"rounds": 3, "round_every": 2, "keep_ratio": 0.4, "redistribution": redistribution, "num_neighbors": 5}
    training = Training(build(pruning={**options, "selection": "systematic", "edges": "appearance"}))
    counts, active = [], []
    for step in range(11):
        training.step(step)
        counts.append(training.model.num_points)
        active.append(training.model.head_active)
        assert training.live()
    assert counts == [60] * 3 + [44] * 2 + [33] * 2 + [24] * 4
    assert active == [False] * 8 + [True] * 3
    assert all(torch.isfinite(value).all() for value in training.model.gauss_params.values())


@pytest.mark.parametrize(
    ("options", "cause"),
    [
        ({"pruning": {"keep_ratio": 0.0}}, "keep_ratio"),
        ({"pruning": {"keep_ratio": 1.2}}, "keep_ratio"),
        ({"pruning": {"gamma": -0.1}}, "gamma"),
        ({"pruning": {"gamma": 1.5}}, "gamma"),
        ({"head": {"num_features": 0}}, "num-features"),
        ({"base_loss_weight": -1.0}, "base-loss-weight"),
        ({"use_bilateral_grid": True}, "bilateral"),
    ],
)
def test_options_that_cannot_work(options: dict[str, Any], cause: str) -> None:
    with pytest.raises(ConfigError, match=cause) as caught:
        build(**options)
    assert "\n" not in str(caught.value)


def test_gsplat_without_cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    model = build(rasterizer="gsplat")
    with pytest.raises(BackendError, match="CUDA is not available") as caught:
        Training(model)
    assert "\n" not in str(caught.value)
    assert build(rasterizer="auto").backend.name == "cpu"


# -------------------------------------------------------------------------------------------------- initialisation


@pytest.mark.parametrize("seed_points", [None, (torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8))])
def test_without_a_sparse_cloud_points_are_random(seed_points: Any, capsys: pytest.CaptureFixture[str]) -> None:
    model = build(seed_points=seed_points, num_random=40, random_scale=2.0)
    assert model.num_points == 40
    assert model.means.abs().max() <= 1
    assert "no sparse point cloud" in " ".join(capsys.readouterr().out.split())


def test_random_points_on_request_need_no_warning(capsys: pytest.CaptureFixture[str]) -> None:
    model = build(random_init=True, num_random=40)
    assert model.num_points == 40
    assert "Warning" not in capsys.readouterr().out


def test_it_is_a_splatfacto_whose_groups_have_features_and_head() -> None:
    model = build()
    assert isinstance(model, SplatfactoModel)
    groups = model.get_param_groups()
    assert set(groups) == {*model.gauss_params, "compensation"}
    assert "features" in groups
    assert set(build(head={"mode": "off"}).get_param_groups()) == set(groups) - {"compensation", "features"}


# ----------------------------------------------------------------------------------------------------- checkpoints


def saved(model: SundaeModel, path: Path) -> dict[str, Any]:
    torch.save(model.state_dict(), path)
    return torch.load(path, weights_only=True)


def test_round_trip_into_another_count_keeps_optimizers_alive(tmp_path: Path) -> None:
    source = Training(build())
    for step in range(5):
        source.step(step)
    state = saved(source.model, tmp_path / "a.pt")
    assert source.model.num_points == 30

    target = Training(build(n=25))
    held = dict(target.model.gauss_params.items())
    target.model.load_state_dict(state)
    for name, value in target.model.gauss_params.items():
        assert value is held[name]
        assert torch.equal(value, source.model.gauss_params[name])
    assert target.model.step == 4
    assert target.model.pruning_state == source.model.pruning_state
    assert target.model.head_active
    for (_, ours), (_, theirs) in zip(
        target.model.head.named_parameters(),  # type: ignore[union-attr]
        source.model.head.named_parameters(),  # type: ignore[union-attr]
        strict=True,
    ):
        assert torch.equal(ours, theirs)
    target.optimizers.load_optimizers(deepcopy({k: v.state_dict() for k, v in source.optimizers.optimizers.items()}))
    assert target.live()
    torch.manual_seed(5)
    expected = source.step(5)
    torch.manual_seed(5)
    found = target.step(5)
    assert target.model.num_points == 30
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value)
    for name, value in target.model.gauss_params.items():
        torch.testing.assert_close(value, source.model.gauss_params[name])


def test_state_of_densification_is_kept(tmp_path: Path) -> None:
    source = Training(build())
    source.step(0)
    assert source.model.strategy_state["grad2d"].any()
    target = build(n=25)
    target.load_state_dict(saved(source.model, tmp_path / "a.pt"))
    assert torch.equal(target.strategy_state["grad2d"], source.model.strategy_state["grad2d"])
    assert target.strategy_state["scene_scale"] == source.model.strategy_state["scene_scale"]


def _stock(state: dict[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in state.items() if k.startswith("gauss_params.") and not k.endswith(".features")}


@pytest.mark.parametrize(
    ("options", "change", "cause"),
    [
        ({}, _stock, "splatfacto checkpoint.*warm-start"),
        ({"head": {"num_features": 1}}, None, "length 1"),
        ({"head": {"mode": "off"}}, None, "length 0"),
        ({"head": {"size": "small"}}, None, "head"),
        ({"head": {"mode": "features"}}, None, "head"),
        ({"sh_degree": 2}, None, "features_rest"),
    ],
)
def test_other_checkpoints_are_refused_and_nothing_changes(
    options: dict[str, Any], change: Callable[[dict[str, Any]], dict[str, Any]] | None, cause: str
) -> None:
    state = build(n=25, **options).state_dict()
    model = build()
    before = {name: value.detach().clone() for name, value in model.named_parameters()}
    with pytest.raises(CheckpointError, match=cause) as caught:
        model.load_state_dict(change(state) if change else state)
    assert isinstance(caught.value, ValueError)
    assert "\n" not in str(caught.value)
    assert all(torch.equal(value, before[name]) for name, value in model.named_parameters())


# ------------------------------------------------------------------------------------------------------ warm start


def _ply(path: Path, degree: int = 1, **options: Any) -> dict[str, Tensor]:
    params = {name: value.detach() for name, value in build(sh_degree=degree).gauss_params.items()}
    params["features_rest"] = torch.randn_like(params["features_rest"])
    write_ply(path, params, **options)
    return params


def _frame() -> tuple[Tensor, float]:
    turn = torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    return torch.cat([turn, torch.tensor([[0.1], [0.2], [0.3]])], dim=1), 0.5


def test_a_ply_of_the_capture_is_moved_into_the_model(tmp_path: Path) -> None:
    params = _ply(tmp_path / "a.ply")
    model = build(warm_start=tmp_path / "a.ply", metadata={DATASET_FRAME: _frame()})
    expected = similarity(params, *_frame())
    for name in ("means", "scales", "quats", "features_rest", "opacities"):
        torch.testing.assert_close(model.gauss_params[name].detach(), expected[name])
    assert model.gauss_params["features"].shape == (N, 5)
    as_is = build(warm_start=tmp_path / "a.ply", warm_start_frame="model")
    torch.testing.assert_close(as_is.means.detach(), params["means"])


def test_a_ply_of_the_capture_needs_to_know_the_way(tmp_path: Path) -> None:
    _ply(tmp_path / "a.ply")
    with pytest.raises(CheckpointError, match="warm-start-frame model") as caught:
        Training(build(warm_start=tmp_path / "a.ply"))
    assert "\n" not in str(caught.value)


def test_a_finished_run_opens_without_what_it_started_from(tmp_path: Path) -> None:
    """Training without the warm start is refused in one line; loading the run's checkpoint needs it no more."""
    _ply(tmp_path / "a.ply")
    state = build(warm_start=tmp_path / "a.ply", warm_start_frame="model").state_dict()
    (tmp_path / "a.ply").unlink()
    orphan = build(warm_start=tmp_path / "a.ply", warm_start_frame="model")
    with pytest.raises(CheckpointError, match="does not exist"):
        Training(orphan)
    orphan.load_state_dict(state)
    assert torch.equal(orphan.means, state["gauss_params.means"])
    Training(orphan)


@pytest.mark.parametrize("degree", [0, 1])
def test_colours_are_those_of_the_cloud_and_of_the_warm_start(tmp_path: Path, degree: int) -> None:
    xyz, rgb = points()
    model = build(sh_degree=degree, seed_points=(xyz, rgb))
    shown = model._colors(model.gaussians, model.view_of(camera()).center).detach()
    torch.testing.assert_close(shown, rgb / 255, rtol=0, atol=2e-3)
    torch.save(
        {"pipeline": {f"_model.{k}": v for k, v in model.state_dict().items()}}, tmp_path / "step-000000001.ckpt"
    )
    for wanted in (0, 1):
        warm = build(sh_degree=wanted, warm_start=tmp_path / "step-000000001.ckpt")
        again = warm._colors(warm.gaussians, warm.view_of(camera()).center).detach()
        torch.testing.assert_close(again, shown, rtol=0, atol=2e-3)


def test_a_warm_start_trains_at_full_resolution(tmp_path: Path) -> None:
    _ply(tmp_path / "a.ply")
    options = {"num_downscales": 2, "resolution_schedule": 3000}
    cold, warm = build(**options), build(warm_start=tmp_path / "a.ply", warm_start_frame="model", **options)
    assert cold.train()._get_downscale_factor() == 4
    assert warm.train()._get_downscale_factor() == 1


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_a_warm_start_of_another_sh_degree(tmp_path: Path, degree: int) -> None:
    params = _ply(tmp_path / "a.ply", degree=degree)
    model = build(warm_start=tmp_path / "a.ply", warm_start_frame="model", sh_degree=1)
    rest = model.gauss_params["features_rest"].detach()
    assert rest.shape == (N, 3, 3)
    shared = min(3, params["features_rest"].shape[1])
    assert torch.equal(rest[:, :shared], params["features_rest"][:, :shared])
    assert not rest[:, shared:].any()


def test_a_warm_start_prunes_at_its_first_step(tmp_path: Path) -> None:
    _ply(tmp_path / "a.ply")
    training = Training(build(warm_start=tmp_path / "a.ply", warm_start_frame="model", pruning={"prune_at": 15000}))
    training.step(0)
    assert training.model.num_points == N // 2
    assert training.live()
    assert "base_loss" in training.step(1)
    assert training.model.num_points == N // 2


# --------------------------------------------------------------------------------------------------------- windows


def test_a_window_is_a_part_of_the_whole_picture() -> None:
    """Pictures, truth and mask of a window are what the whole picture shows there."""
    whole, cut = (perturb(build(head={"max_train_pixels": limit}, background_color="black")) for limit in (0, 600))
    with torch.no_grad():
        # Rasterisers clamp how they linearise large primitives far outside of the picture, and a window is a picture.
        whole.gauss_params["scales"] -= 2
    cut.load_state_dict(whole.state_dict())
    masked = {**batch(), "mask": torch.rand(32, 40, 1, generator=torch.Generator().manual_seed(4)) > 0.5}
    for model in (whole, cut):
        model.train()
    outputs = {model: model.get_outputs(camera()) for model in (whole, cut)}
    window = outputs[cut]["window"]
    assert outputs[whole]["window"] is None
    assert window.width * window.height <= 600
    rows, columns = slice(window.top, window.top + window.height), slice(window.left, window.left + window.width)
    for name in ("base_rgb", "accumulation"):
        torch.testing.assert_close(outputs[cut][name], outputs[whole][name][rows, columns], atol=1e-5, rtol=0)
    truth = whole._target(masked, outputs[whole])[rows, columns]
    assert torch.equal(cut._target(masked, outputs[cut]), truth)
    losses = cut.get_loss_dict(outputs[cut], masked, {})
    expected = ((outputs[cut]["base_rgb"] - truth).abs() * masked["mask"][rows, columns]).mean()
    torch.testing.assert_close(losses["base_loss"], cut.config.base_loss_weight * expected)


def test_windows_wait_for_the_head_and_for_densification() -> None:
    model = build(head={"max_train_pixels": 600})
    assert not model.head_active
    assert model._look(0).window_pixels == 0
    perturb(model)
    assert model._look(0).window_pixels == 600
    assert model.eval().get_outputs(camera())["rgb"].shape == (32, 40, 3)  # what is shown is whole
    early = perturb(
        build(head={"max_train_pixels": 600, "start_at": 0}, pruning={"mode": "continuous", "start": 5, "stop": 50})
    )
    assert early.head_active
    assert early._look(0).window_pixels == 0  # densification takes its statistics from whole pictures


# ---------------------------------------------------------------------------------------------------------- scales


def at_focal(factor: float) -> Cameras:
    """The test camera, its picture magnified."""
    small = camera()
    sides = {"width": round(40 * factor), "height": round(32 * factor)}
    center = {"cx": 20.0 * factor, "cy": 16.0 * factor}
    return Cameras(small.camera_to_worlds, fx=30.0 * factor, fy=30.0 * factor, **center, **sides)


@pytest.mark.parametrize("mode", ["residual", "features"])
def test_other_scales_get_the_correction_of_the_trained_one(mode: Any) -> None:
    model = perturb(build(head={"mode": mode}, background_color="black")).eval()
    model.trained_focal = (30.0, 30.0)
    own = model.get_outputs(camera())
    correction = own["rgb"] - own["base_rgb"]
    assert correction.abs().max() > 1e-3
    double = model.get_outputs(at_focal(2))
    expected = (double["base_rgb"] + resize(correction, 64, 80)).clamp(0, 1)
    torch.testing.assert_close(double["rgb"], expected, atol=1e-5, rtol=0)
    # Within the tolerance the head sees the picture itself.
    near = model.get_outputs(at_focal(1.1))
    model.trained_focal = None
    assert torch.equal(near["rgb"], model.get_outputs(at_focal(1.1))["rgb"])


def test_thumbnails_are_base_colours() -> None:
    model = perturb(build(background_color="black")).eval()
    model.trained_focal = (300.0, 300.0)
    outputs = model.get_outputs(camera())
    assert torch.equal(outputs["rgb"], outputs["base_rgb"])


def test_the_head_remembers_its_scale() -> None:
    training = Training(build(background_color="black"))
    for step in range(4):
        training.step(step)
    assert training.model.trained_focal is None  # the head took no part so far
    training.step(4)
    assert training.model.trained_focal == (30.0, 30.0)
    other = build(background_color="black")
    other.load_state_dict(training.model.state_dict())
    assert other.trained_focal == (30.0, 30.0)


class FullBackend:
    """A rasteriser on a device without room."""

    name = "full"

    def rasterize(self, *_: Any, **__: Any) -> Any:
        raise torch.cuda.OutOfMemoryError(
            "CUDA out of memory. Tried to allocate 2.50 GiB. GPU 0 has a total capacity of 79.10 GiB of which 1 MiB is free."
        )

    def spherical_harmonics(self, degree: int, directions: Tensor, coeffs: Tensor) -> Tensor:
        return torch.zeros_like(directions)


@pytest.mark.parametrize("training", [True, False], ids=["training", "rendering"])
def test_full_memory_says_how_much_and_what_to_try(training: bool) -> None:
    model = build().train(training)
    model._backend = FullBackend()  # type: ignore[assignment]
    with pytest.raises(
        MemoryExhaustedError, match=rf"2\.50 GiB more were asked for, with {N} primitives; try"
    ) as caught:
        model.get_outputs_for_camera(camera())
    text = str(caught.value)
    assert "\n" not in text
    for option in ("cache-images cpu", "camera-res-scale-factor", f"max-primitives {N // 2}"):
        assert option in text
