"""The SUNDAE model: splatfacto's field with spectral pruning and neural compensation. Orchestrates, and holds no maths.

The module path and the class names are written into every run's ``config.yml``: moving them breaks saved runs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, MutableMapping
from dataclasses import dataclass, field, replace
from functools import partial, wraps
from pathlib import Path
from typing import Any, Literal, cast

import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizer
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.models.splatfacto import SplatfactoModel, SplatfactoModelConfig, resize_image
from nerfstudio.utils.colors import get_color
from nerfstudio.utils.rich_utils import CONSOLE
from nerfstudio.viewer.viewer_elements import ViewerCheckbox, ViewerDropdown
from pytorch_msssim import SSIM
from rich.progress import track
from torch import Tensor

from sundae_ns.compensation import PHASES, CompensationHead, HeadConfig, training_window
from sundae_ns.datamanager import NO_PICTURES, SundaeDatamanager, without_pictures
from sundae_ns.distributed import Arrived, Course, GlobalPruning, Look, Shards, Timetable, slack_of_step
from sundae_ns.errors import ConfigError, out_of_memory
from sundae_ns.evaluation import Lpips, psnr, ssim
from sundae_ns.pruning import PruningConfig
from sundae_ns.rasterization import Backend, Rasterization, select_backend
from sundae_ns.rendering.lazy import Later, LazyOutputs
from sundae_ns.rendering.outputs import OUTPUTS, FieldKey, ShownResponse, empty_outputs, late_outputs
from sundae_ns.rendering.render import NEAR_PLANE, Style, colors_of, render, weights_of
from sundae_ns.rendering.replay import Recordings
from sundae_ns.rendering.views import View, cut, view_of
from sundae_ns.storage.runs import checkpoint
from sundae_ns.training.after_step import finish, prune_if_due, warn_if_too_short
from sundae_ns.training.budget import Budget
from sundae_ns.training.densification import CappedStrategy, make_strategy
from sundae_ns.training.initial_field import Start, initial_field
from sundae_ns.training.losses import chain_losses, picture_losses
from sundae_ns.training.schedules import PruningPolicy, make_policy
from sundae_ns.viewer import Preview, in_viewer

_Outputs = MutableMapping[str, Any]


@dataclass
class SundaeModelConfig(SplatfactoModelConfig):
    """Splatfacto, spectrally pruned and compensated. Options of splatfacto keep their meaning."""

    _target: type = field(default_factory=lambda: SundaeModel)
    pruning: PruningConfig = field(default_factory=PruningConfig)
    """When to prune, how many primitives to keep, and which."""
    head: HeadConfig = field(default_factory=HeadConfig)
    """The compensation head."""
    rasterizer: Literal["auto", "gsplat", "cpu", "reference"] = "auto"
    """auto takes gsplat where CUDA works, and on a CPU the loops that numba compiles; reference is slow, in plain PyTorch."""
    base_loss_weight: float = 0.2
    """Weight of the loss on the picture without the head, which keeps exported .ply files valid."""
    warm_start: Path | None = None
    """Start from a finished field instead of warming up: a splatfacto or sundae .ckpt (or the folder), or a 3DGS .ply."""
    warm_start_frame: Literal["auto", "model", "capture"] = "auto"
    """Coordinates of the warm start: nerfstudio's model, or the capture's own (COLMAP). auto goes by the kind of file."""
    warmup: Literal["densify", "mcmc"] = "densify"
    """How the field grows: by gradients (3DGS), or as a Markov chain with an exact cap (3DGS-MCMC)."""
    mcmc_cap: int = 1_000_000
    """Most primitives of a warm-up by mcmc, at any step."""
    evaluate_prune: bool = True
    """Evaluate all test views right before and right after the prune, and record both."""


def _names_full_memory(render: Callable[..., _Outputs]) -> Callable[..., _Outputs]:
    """Let a method of the model that runs out of the GPU's memory say how many primitives there were."""

    @wraps(render)
    def wrapper(model: SundaeModel, *arguments: Any, **options: Any) -> _Outputs:
        try:
            return render(model, *arguments, **options)
        except torch.cuda.OutOfMemoryError as error:
            raise out_of_memory(error, model.num_points) from error

    return wrapper


class SundaeModel(SplatfactoModel):
    """Warms up a Gaussian field, prunes it spectrally, and compensates for the loss.

    A subclass of ``SplatfactoModel`` because nerfstudio's exporter and viewer test for it; what ties the original to CUDA
    or to downloads (initialisation, view matrix, outputs, LPIPS) is replaced.

    Args:
        config: the configuration.
        scene_box, num_train_data, metadata, seed_points: as nerfstudio's pipeline passes them.

    Raises:
        ConfigError: options that cannot work.
        CheckpointError: the warm start cannot be read.
    """

    config: SundaeModelConfig

    def populate_modules(self) -> None:
        """Build the field, the head and what training needs. The model's device is not known yet."""
        config = self.config
        config.pruning = replace(config.pruning, logits=config.sh_degree == 0)
        config.pruning.validate()
        if config.head.mode != "off":
            config.head.validate()
        if config.mcmc_cap < 1:
            raise ConfigError(f"mcmc-cap is {config.mcmc_cap}; give the most primitives that the field may have")
        if config.base_loss_weight < 0:
            raise ConfigError(f"base-loss-weight is {config.base_loss_weight}; give 0 or more")
        if config.warm_start is not None and config.pruning.mode == "continuous":
            raise ConfigError("a warm start is pruned at once, not while it grows: set pruning.mode to one-shot")
        if config.use_bilateral_grid:
            raise ConfigError("sundae has no bilateral grid: the head would learn against it; use splatfacto for it")

        self.step = 0
        self.num_features = 0 if config.head.mode == "off" else config.head.num_features
        self.strategy = make_strategy(config, self.num_train_data)
        params, self._start = initial_field(
            config,
            self.seed_points,
            self.kwargs.get("metadata") or {},
            num_features=self.num_features,
            cap=getattr(self.strategy, "cap", None),
        )
        self.gauss_params = torch.nn.ParameterDict({name: torch.nn.Parameter(value) for name, value in params.items()})
        self.head = None if config.head.mode == "off" else CompensationHead(config.head)
        self.camera_optimizer: CameraOptimizer = config.camera_optimizer.setup(
            num_cameras=self.num_train_data, device="cpu"
        )

        self.policy: PruningPolicy | GlobalPruning = make_policy(config.pruning)
        self.shards: Shards | None = None
        """The ranks that hold the field together; None where one process holds it all."""
        self.budget = Budget(config.pruning, config.head) if config.pruning.mode == "auto" else None
        self.pruning_state: dict[str, Any] = self.policy.initialize_state()
        self.strategy_state: dict[str, Any] = self.strategy.initialize_state(scene_scale=1.0)

        self.ssim = SSIM(data_range=1.0, size_average=True, channel=3)
        self.lpips = Lpips()  # type: ignore[assignment]
        self.crop_box: OrientedBox | None = None
        # Viser's own background, as in splatfacto: training backgrounds are random, shown ones are this.
        random_background = config.background_color == "random"
        self.background_color = (
            torch.tensor([0.1490, 0.1647, 0.2157]) if random_background else get_color(config.background_color)
        )
        self.compensate = ViewerCheckbox("Neural compensation", True, hint="Off shows the base colours alone")
        self.phases: ViewerDropdown[str] = ViewerDropdown(
            "Runs of the head",
            str(config.head.phases),
            [str(count) for count in PHASES],
            hint="Mean over so many places of its grid of pixels: slower, and flickers less",
            cb_hook=self._set_phases,
        )
        self.compensated = True
        """Whether pictures that nobody looks at in a viewer get the head's correction."""
        self.preview = Preview()
        self._backend: Backend | None = None
        self._response = ShownResponse()
        self._recordings = Recordings()
        self.attached = False
        """Whether a trainer drives this model."""
        self.trained_focal: tuple[float, float] | None = None
        """Shortest and longest focal length, pixels, of the pictures that the head was trained on."""

    # ---------------------------------------------------------------------------------------------------- the field

    @property
    def gaussians(self) -> MutableMapping[str, torch.nn.Parameter]:
        """The parameters of the field; a ``ParameterDict`` is a mapping in all but its declared type."""
        return cast(MutableMapping[str, torch.nn.Parameter], self.gauss_params)

    @property
    def schedule_step(self) -> int:
        """Step of the schedule: a warm start begins where the warm-up would have ended."""
        return self.step + (self.config.pruning.prune_at if self.config.warm_start is not None else 0)

    @property
    def densifying(self) -> bool:
        """Whether the field still grows."""
        return self.schedule_step < self.strategy.refine_stop_iter

    @property
    def most_bands(self) -> int | None:
        """Highest degree of the harmonics that takes part so far; None for all, as after a warm start."""
        return None if self.config.warm_start is not None else self.step // max(self.config.sh_degree_interval, 1)

    @property
    def head_active(self) -> bool:
        """Whether the head takes part: it starts when pruning has ended, unless told otherwise, or when auto lets it."""
        if self.budget is not None:
            return self.head is not None and self.budget.search.head
        return self.head is not None and self.schedule_step > self.head_starts_at

    @property
    def head_starts_at(self) -> int:
        """Step of the schedule after which the head takes part, where no search for a budget decides."""
        start = self.config.head.start_at
        return self.config.pruning.settled_at if start is None else start

    @property
    def backend(self) -> Backend:
        """The rasteriser, chosen when the device is known.

        Raises:
            BackendError: ``gsplat`` was asked for and cannot run here.
        """
        if self._backend is None:
            self._backend = select_backend(self.config.rasterizer, self.device)
        return self._backend

    @property
    def total_points(self) -> int:
        """Primitives of the whole field; ``num_points`` are those that this process holds."""
        return self.num_points if self.shards is None else self.shards.total

    def share(self, shards: Shards, datamanager: SundaeDatamanager) -> None:
        """Be one of the ranks that hold the field together, each its block of primitives, and draw views in their order."""
        self.shards = shards
        cameras = datamanager.train_dataset.cameras
        shards.timetable = Timetable(cameras, datamanager.view_of_step, self.device, NEAR_PLANE)
        self.policy = GlobalPruning(make_policy(self.config.pruning), shards)
        if isinstance(self.strategy, CappedStrategy):
            # Opacities are reset, and then each picture is seen once before anything grows or goes.
            pictures = -(-self.num_train_data // shards.ranks)
            self.strategy.pause_refine_after_reset = pictures + self.config.refine_every

    def arrivals(
        self, params: Mapping[str, Tensor], view: View, *, features: bool = False, course: Course | None = None
    ) -> Arrived:
        """What this process needs to draw its view, from all ranks; each has to ask, see :mod:`sundae_ns.distributed`."""
        assert self.shards is not None
        return self.shards.arrivals(params, view, self._colors, near_plane=NEAR_PLANE, features=features, course=course)

    def get_gaussian_param_groups(self) -> dict[str, list[torch.nn.Parameter]]:
        """One group per parameter of the field, features included."""
        return {name: [value] for name, value in self.gauss_params.items()}

    def get_param_groups(self) -> dict[str, list[torch.nn.Parameter]]:
        """Groups of the field, of the head (``compensation``) and of the cameras."""
        groups = super().get_param_groups()
        if self.head is not None:
            groups["compensation"] = list(self.head.parameters())
        return groups

    # -------------------------------------------------------------------------------------------------- checkpoints

    def get_extra_state(self) -> dict[str, Any]:
        """Step, states of densification and pruning, and the head's scale: what goes on needs beside the tensors."""
        state = checkpoint.extra_state(
            self.step, self.num_features, self.strategy_state, self.pruning_state, self.trained_focal
        )
        state["logits"] = self.config.pruning.logits
        return state if self.budget is None else {**state, "budget": self.budget.state()}

    def set_extra_state(self, state: Mapping[str, Any]) -> None:
        """Counterpart of :meth:`get_extra_state`; tensors move to the device of the field."""
        self.step = int(state["step"])
        focal = state.get("trained_focal")  # older checkpoints do not know it
        self.trained_focal = None if focal is None else (float(focal[0]), float(focal[1]))
        if self.budget is not None:
            self.budget.load_state(state.get("budget"))
        for own, theirs in ((self.strategy_state, state["strategy"]), (self.pruning_state, state["pruning"])):
            own.clear()
            own.update({k: v.to(self.means.device) if isinstance(v, Tensor) else v for k, v in theirs.items()})

    def load_state_dict(self, state_dict: Mapping[str, Any], **kwargs: Any) -> Any:  # type: ignore[override]
        """Load a SUNDAE checkpoint with any number of primitives.

        Parameters are resized in place, so that optimizers that were built before keep moving live tensors.

        Raises:
            CheckpointError: it is another method's checkpoint, or one of another feature width or head.
        """
        expected: Mapping[str, Any] = self.state_dict()
        if self.budget is not None:
            expected = self.budget.shapes(state_dict.get(checkpoint.EXTRA_STATE), expected)
        checkpoint.check_model_state(state_dict, expected, self.num_features, shard=self.shards is not None)
        n = state_dict["gauss_params.means"].shape[0]
        for name, value in self.gauss_params.items():
            value.data = value.data.new_zeros(n, *expected[f"gauss_params.{name}"].shape[1:])
        if self.budget is not None:
            self.head = self.budget.prepare_head(state_dict[checkpoint.EXTRA_STATE], self.head)
        self._start = Start()
        # Past SplatfactoModel's own loader on purpose: it replaces parameters and resets the step.
        return super(SplatfactoModel, self).load_state_dict(state_dict, **kwargs)

    # ---------------------------------------------------------------------------------------------------- rendering

    def view_of(self, camera: Cameras, downscale: int = 1) -> View:
        """The rasteriser's form of a camera of shape ``(1,)``; nothing in ``camera`` is changed.

        Args:
            camera: nerfstudio camera, camera-to-world with OpenGL axes.
            downscale: divide the resolution by this.
        """
        optimizer = self.camera_optimizer
        moved = self.training and optimizer.config.mode != "off"
        pose = optimizer.apply_to_camera(camera) if moved else None
        return view_of(camera, self.device, pose=pose, downscale=downscale)

    @property
    def _style(self) -> Style:
        """How pictures are made at this step."""
        config, shards, densifying = self.config, self.shards, self.training and self.densifying
        absgrad = densifying and config.use_absgrad and config.warmup == "densify"
        return Style(
            backend=self.backend,
            antialiased=config.rasterize_mode == "antialiased",
            logits=config.sh_degree == 0,
            most_bands=self.most_bands,
            training=self.training,
            absgrad=absgrad,
            head=self.head if self.head_active else None,
            trained_focal=self.trained_focal,
            arrivals=None if shards is None else self.arrivals,
            follow=None if shards is None or not densifying else partial(shards.follow, absgrad=absgrad),
        )

    def _set_phases(self, chosen: ViewerDropdown[str]) -> None:
        if self.head is not None:
            self.head.config = replace(self.head.config, phases=int(chosen.value))  # type: ignore[arg-type]

    def _colors(self, params: Mapping[str, Tensor], center: Tensor) -> Tensor:
        return colors_of(params, center, self._style)

    def render(
        self,
        params: Mapping[str, Tensor],
        view: View,
        background: Tensor,
        *,
        depth: bool = True,
        compensate: bool = True,
    ) -> tuple[dict[str, Any], Rasterization]:
        """The pictures of one view: one splatting pass for colours, features and depth, then the head.

        Args:
            params: the field, or a part of it.
            view: the camera.
            background: ``[3]`` colour behind everything.
            depth: whether to render depth.
            compensate: whether the head may take part.

        Returns:
            ``rgb, base_rgb, depth, accumulation, feature_image``, each ``[H, W, C]``, and the rasteriser's result.
        """
        return render(params, view, background, self._style, depth=depth, compensate=compensate)

    @torch.no_grad()
    def get_outputs_for_camera(self, camera: Cameras, obb_box: OrientedBox | None = None) -> _Outputs:  # type: ignore[override]
        """Render a camera, or what of it lies in a box; unlike splatfacto's, this leaves the camera on its device."""
        self.set_crop(obb_box)
        return self.get_outputs(camera)

    @_names_full_memory
    def get_outputs(self, camera: Cameras) -> _Outputs:  # type: ignore[override]
        """Render a camera.

        Args:
            camera: of shape ``(1,)``.

        Returns:
            ``rgb, base_rgb, depth, accumulation, background``, each ``[H, W, C]``; outside training also ``features``
            (principal components as colours) and ``response`` (spectral response of the primitives seen), and those
            beside the first two are made when they are asked for. In training, pictures may be of a ``window`` alone,
            then given beside them.
        """
        background = self._get_background_color()
        if self.training:
            look, shards = self._look(self.step), self.shards
            view = self.view_of(camera, look.downscale) if shards is None else shards.timetable.view(look, camera)
            self._remember_focal(view)
            window = training_window(view.width, view.height, look.window_pixels, seed=look.step)
            view = view if window is None else view.cut(window)
            field: Mapping[str, Tensor] = self.gaussians
            if shards is not None:
                course = shards.course(self.gaussians, look)
                field = self.arrivals(self.gaussians, view, features=self.head_active, course=course)
            outputs, splat = self.render(field, view, background, depth=self.config.output_depth_during_training)
            self.info = splat.info
            if shards is not None:
                # Now, while the GPU is busy with this step.
                shards.plan_ahead(self.gaussians, self._look(self.step + 1), slack_of_step(self.optimizers))
            if self.densifying:
                self.strategy.step_pre_backward(
                    self.gauss_params, self.optimizers, self.strategy_state, self.schedule_step, self.info
                )
            outputs.pop("feature_image")
            return {**outputs, "background": background, "window": window}

        view = self.view_of(camera, self._get_downscale_factor())
        mask = None if self.crop_box is None else self.crop_box.within(self.means).squeeze(-1)
        preview = self.preview.decision(self)
        if preview is not None:
            mask = preview.mask if mask is None else mask & preview.mask
        if mask is not None and not mask.any():
            return self.get_empty_outputs(view.width, view.height, background)
        params = self.gaussians if mask is None else {k: v[mask] for k, v in self.gaussians.items()}
        if preview is not None and mask is not None and preview.values is not None:
            rows = mask[preview.mask]
            params = {**params, **{k: v[rows] for k, v in preview.values.items()}}
        compensate = preview is None and (self.compensate.value if in_viewer() else self.compensated)
        if mask is None and self.shards is None:
            pictures = self._recordings.render(params, view, background, self._style, compensate=compensate)
        else:
            # Nothing is left for later where other ranks have to take part in it.
            pictures, _ = self.render(params, view, background, compensate=compensate, depth=self.shards is not None)
        field = dict(self.gaussians)
        values = partial(self._response.values, field, self._response_key, self.config.pruning)
        outputs = {**pictures, **late_outputs(pictures, dict(params), field, mask, view, self._style, values)}
        background = background.expand(view.height, view.width, 3)
        return LazyOutputs({**{name: outputs[name] for name in OUTPUTS}, "background": background})

    @property
    def _response_key(self) -> FieldKey | None:
        if self.attached and self.densifying:
            return None
        return self.num_points, self.pruning_state["num_prunes"]

    @staticmethod
    def get_empty_outputs(width: int, height: int, background: Tensor) -> dict[str, Any]:
        """What a crop without primitives shows: the same keys and shapes as any other picture."""
        return empty_outputs(width, height, background)

    # ----------------------------------------------------------------------------------------------------- training

    def _get_downscale_factor(self) -> int:
        return self._downscale_at(self.step) if self.training else 1

    def _downscale_at(self, step: int) -> int:
        """Splatfacto's rising resolution; a warm start has risen."""
        if self.config.warm_start is not None:
            return 1
        return int(2 ** max(self.config.num_downscales - step // self.config.resolution_schedule, 0))

    def _remember_focal(self, view: View) -> None:
        if self.head_active and self._get_downscale_factor() == 1:
            low, high = self.trained_focal or (view.focal, view.focal)
            self.trained_focal = (min(low, view.focal), max(high, view.focal))

    def _look(self, step: int) -> Look:
        """How pictures are looked at in a step of training; at a later one, as far as it is known now."""
        # Densification takes its statistics from whole pictures.
        windows = self.head_active and not self.densifying
        return Look(step, self._downscale_at(step), self.config.head.max_train_pixels if windows else 0)

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """Splatfacto's callbacks, then pruning: after densification has had its say on the same step."""
        self._start.announce()
        backend = self.backend  # an unusable rasteriser should be known before the first step
        CONSOLE.log(f"rasteriser: {backend.name} on {self.device}")
        self.attached = True
        if self.budget is not None:
            self.budget.check(cast(Any, training_callback_attributes.pipeline).datamanager)
        trainer = training_callback_attributes.trainer
        if trainer is not None:
            warn_if_too_short(self, cast(Any, trainer).last_step)
        callbacks = super().get_training_callbacks(training_callback_attributes)
        for location, act in (
            (TrainingCallbackLocation.AFTER_TRAIN, finish),
            (TrainingCallbackLocation.AFTER_TRAIN_ITERATION, prune_if_due),
        ):
            callback = partial(act, self, training_callback_attributes)
            callback.__name__ = act.__name__  # type: ignore[attr-defined]
            callbacks.append(TrainingCallback([location], callback))
        return callbacks

    def step_post_backward(self, step: int) -> None:
        """Densify."""
        if self.densifying and self.shards is not None:
            self.shards.densify(self)
        elif self.densifying:
            self.strategy.step_post_backward(
                params=self.gauss_params,
                optimizers=self.optimizers,
                state=self.strategy_state,
                step=self.schedule_step,
                info=self.info,
                packed=False,
            )

    @torch.no_grad()
    def contribution(self, datamanager: SundaeDatamanager, pruning: PruningConfig | None = None) -> Tensor:
        """Blending weight of each primitive, summed over the pixels of all training views ``[N]``, but for masked ones.

        Where the score asks for it, pixels count by the detail of the rendering, for as many cells as primitives seen in it
        are going to be kept.

        Args:
            datamanager: has the training views.
            pruning: options of the prune, if they are not those of the model.
        """
        pruning = pruning or self.config.pruning
        share = pruning.share(self.total_points) if pruning.uses_detail else None
        views = list(datamanager.training_views())
        if self.shards is not None:
            return self.shards.contribution(self, views, share)
        total = torch.zeros(self.num_points, device=self.device)
        for camera, mask in track(views, description="Contribution of primitives", transient=True, console=CONSOLE):
            total += self.weights_of(self.view_of(camera), share, mask=mask)
        return total

    def weights_of(
        self,
        view: View,
        keep_ratio: float | None = None,
        field: Mapping[str, Tensor] | None = None,
        mask: Tensor | None = None,
    ) -> Tensor:
        """Blending weight of each primitive, summed over the pixels of one view ``[N]``.

        Args:
            view: the camera.
            keep_ratio: share of the primitives that will stay; given, pixels count by the detail that so many can show.
            field: the primitives, if not those of this process.
            mask: the pixels that count at all, bool ``[H, W, 1]``; None for all.
        """
        # Not the background of training, which may be random: the choice is to be the same from run to run.
        params = self.gaussians if field is None else field
        return weights_of(params, view, self.background_color, self._style, keep_ratio, mask)

    # --------------------------------------------------------------------------------------------- losses and metrics

    def get_gt_img(self, image: Tensor, downscale: int | None = None) -> Tensor:
        """The truth as floats on the model's device, smaller by a factor; by default the one that pictures have now."""
        image = image.float() / 255 if image.dtype == torch.uint8 else image
        factor = self._get_downscale_factor() if downscale is None else downscale
        smaller: Tensor = image if factor == 1 else resize_image(image, factor)
        return smaller.to(self.device)

    def _target(self, batch: dict[str, Any], outputs: Mapping[str, Any], downscale: int | None = None) -> Tensor:
        if NO_PICTURES in batch:
            raise without_pictures()
        truth = cut(self.get_gt_img(batch["image"], downscale), outputs.get("window"))
        return self.composite_with_background(truth, outputs["background"])

    def get_metrics_dict(  # type: ignore[override]
        self, outputs: dict[str, Any], batch: dict[str, Any]
    ) -> LazyOutputs:
        """PSNR with and without the head, and the number of primitives; computed when looked at, which few steps are."""
        # They may be looked at by the next step, and in the middle of a viewer's frame: what they read is told now, without
        # what the pictures were made from, whose memory the next step wants.
        rgb, base, downscale = outputs["rgb"].detach(), outputs["base_rgb"].detach(), self._get_downscale_factor()
        target = partial(self._target, batch, {name: outputs.get(name) for name in ("window", "background")}, downscale)
        metrics = LazyOutputs(
            {
                "psnr": Later(lambda: psnr(rgb.clamp(0, 1), target())),
                "psnr_base": Later(lambda: psnr(base, target())),
                "gaussian_count": self.total_points,
            }
        )
        self.camera_optimizer.get_metrics_dict(metrics)  # type: ignore[arg-type]
        return metrics

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Any], metrics_dict: dict[str, Any] | None = None
    ) -> dict[str, Tensor]:
        """The picture's loss; beside it, while the head takes part, an L1 loss on the base colours."""
        target, rgb, base = self._target(batch, outputs), outputs["rgb"], outputs["base_rgb"]
        if "mask" in batch:
            mask = cut(self._downscale_if_required(batch["mask"]).to(self.device), outputs.get("window"))
            target, rgb, base = target * mask, rgb * mask, base * mask
        compared = base if self.head_active and self.config.base_loss_weight > 0 else None
        main_loss, base_loss = picture_losses(rgb, compared, target, self.ssim, self.config.ssim_lambda)
        losses = {"main_loss": main_loss}
        if base_loss is not None:
            losses["base_loss"] = self.config.base_loss_weight * base_loss
        if self.training:
            self.camera_optimizer.get_loss_dict(losses)
            if self.config.warmup == "mcmc" and self.densifying:
                losses.update(chain_losses(self.gaussians))
        return losses

    def get_image_metrics_and_images(
        self, outputs: dict[str, Any], batch: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """PSNR, SSIM and, where its weights are at hand, LPIPS; each with the head and without (``_base``)."""
        target = self._target(batch, outputs)
        metrics: dict[str, float] = {"gaussian_count": float(self.total_points)}
        for suffix, picture in (("", outputs["rgb"]), ("_base", outputs["base_rgb"])):
            metrics["psnr" + suffix] = float(psnr(picture, target))
            metrics["ssim" + suffix] = float(ssim(picture, target))
            lpips = self.lpips(picture, target)
            if lpips is not None:
                metrics["lpips" + suffix] = float(lpips)
        images = {"img": torch.cat([target, outputs["rgb"]], dim=1), "base": outputs["base_rgb"]}
        return metrics, images
