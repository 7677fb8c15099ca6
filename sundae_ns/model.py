"""The SUNDAE model: splatfacto's field with spectral pruning and neural compensation. Orchestrates, and holds no maths.

The module path and the class names are written into every run's ``config.yml``: moving them breaks saved runs.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, MutableMapping
from dataclasses import asdict, dataclass, field
from functools import partial, wraps
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizer
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.models.splatfacto import SplatfactoModel, SplatfactoModelConfig
from nerfstudio.utils import writer
from nerfstudio.utils.colors import get_color
from nerfstudio.utils.rich_utils import CONSOLE
from nerfstudio.viewer.viewer_elements import ViewerCheckbox
from pytorch_msssim import SSIM
from rich.progress import track
from torch import Tensor

from sundae_ns import checkpoint
from sundae_ns.budget import Budget
from sundae_ns.compensation import CompensationHead, HeadConfig, Window, plan, resize, training_window
from sundae_ns.datamanager import DATASET_FRAME, NO_PICTURES, SundaeDatamanager
from sundae_ns.densification import CappedStrategy, ChainStrategy, start_of_chain
from sundae_ns.distributed import Arrived, GlobalPruning, Shards
from sundae_ns.errors import CheckpointError, ConfigError, DataError, SundaeError, out_of_memory
from sundae_ns.evaluation import Later, LazyOutputs, Lpips, display, peak_memory, psnr, ssim
from sundae_ns.gaussians import FEATURES, from_points, initial_features, random_points
from sundae_ns.gaussians.parameters import rgb_to_logit, sh_to_rgb
from sundae_ns.preview import Preview, in_viewer
from sundae_ns.pruning import (
    PruneReport,
    PruningConfig,
    PruningPolicy,
    make_policy,
    pixel_detail,
    response,
    select_random,
)
from sundae_ns.rasterization import (
    Backend,
    Rasterization,
    blending_weights,
    rasterize,
    select_backend,
    spherical_harmonics,
)
from sundae_ns.rasterization.sharded import Camera
from sundae_ns.run_folder import prunes_before
from sundae_ns.schedulers import notify_pruned
from sundae_ns.storage.atomic import write_text
from sundae_ns.storage.transform import similarity

NEAR_PLANE = 0.01
SSIM_WINDOW = 11
MCMC_REGULARISER = 0.01
"""Weights of opacities and sizes in the loss while the field grows by MCMC (lambda_o and lambda_Sigma of the paper)."""
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


def _cut(image: Tensor, window: Window | None) -> Tensor:
    """A window of an image ``[H, W, C]``."""
    if window is None:
        return image
    return image[window.top : window.top + window.height, window.left : window.left + window.width]


def _names_full_memory(render: Callable[..., _Outputs]) -> Callable[..., _Outputs]:
    """Let a method of the model that runs out of the GPU's memory say how many primitives there were."""

    @wraps(render)
    def wrapper(model: SundaeModel, *arguments: Any, **options: Any) -> _Outputs:
        try:
            return render(model, *arguments, **options)
        except torch.cuda.OutOfMemoryError as error:
            raise out_of_memory(error, model.num_points) from error

    return wrapper


class View(NamedTuple):
    """One camera for the rasteriser."""

    viewmat: Tensor
    """World-to-camera, OpenCV axes ``[4, 4]``."""
    K: Tensor
    """Intrinsics in pixels ``[3, 3]``."""
    width: int
    height: int

    focal: float
    """Focal length in pixels, the mean of both axes; beside K, because reading K back would wait for the GPU."""

    def zoomed(self, factor: float) -> View:
        """The camera that sees the same in a picture whose sides are ``factor`` times as long."""
        width, height = (max(round(side * factor), 1) for side in (self.width, self.height))
        # By what rounding made of the factor, so that the pictures' edges agree.
        scale = self.K.new_tensor([[width / self.width], [height / self.height], [1.0]])
        return View(self.viewmat, self.K * scale, width, height, self.focal * factor)

    def cut(self, window: Window) -> View:
        """The camera that sees this window of the picture alone."""
        K = self.K.clone()
        K[0, 2] -= window.left
        K[1, 2] -= window.top
        return View(self.viewmat, K, window.width, window.height, self.focal)


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
        self._warm_start_error: CheckpointError | None = None
        params = self._initial_field()
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
        self.strategy = self._strategy()
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
        self.compensated = True
        """Whether pictures that nobody looks at in a viewer get the head's correction."""
        self.preview = Preview()
        self._backend: Backend | None = None
        self._response: tuple[Any, Tensor | None] = (None, None)
        self.attached = False
        """Whether a trainer drives this model."""
        self.trained_focal: tuple[float, float] | None = None
        """Shortest and longest focal length, pixels, of the pictures that the head was trained on."""

    # ---------------------------------------------------------------------------------------------------- the field

    def _initial_field(self) -> dict[str, Tensor]:
        if self.config.warm_start is None:
            params = self._sparse_field()
        else:
            try:
                params = self._warm_field(self.config.warm_start)
            except CheckpointError as error:
                # A finished run must open without what it once started from; training without it is refused.
                self._warm_start_error = error
                params = self._sparse_field()
        if self.config.sh_degree == 0:
            # splatfacto's models without harmonics, and nerfstudio's exporter, know colours by their logits.
            params["features_dc"] = rgb_to_logit(sh_to_rgb(params["features_dc"]))
        return params

    def _sparse_field(self) -> dict[str, Tensor]:
        config = self.config
        points = self.seed_points
        if points is not None and len(points[0]) > 0 and not config.random_init:
            xyz, rgb = points[0], points[1].float() / 255 if len(points[1]) else torch.full_like(points[0], 0.5)
        else:
            if not config.random_init:
                CONSOLE.print(
                    f"[yellow]Warning: the capture has no sparse point cloud; starting from {config.num_random} random "
                    "points. Results are better with one (COLMAP, or ply_file_path in transforms.json)."
                )
            xyz, rgb = random_points(config.num_random, config.random_scale)
        cap = getattr(self._strategy(), "cap", None)
        if cap is not None and len(xyz) > cap:
            CONSOLE.print(f"[yellow]Warning: {len(xyz):,} points are more than the cap; starting from {cap:,} of them")
            chosen = select_random(len(xyz), cap, config.pruning.seed, xyz.device)
            xyz, rgb = xyz[chosen], rgb[chosen]
        params = from_points(xyz, rgb, sh_degree=config.sh_degree, num_features=self.num_features)
        return start_of_chain(params) if config.warmup == "mcmc" else params

    def _warm_field(self, source: Path) -> dict[str, Tensor]:
        config = self.config
        params, in_model_frame = checkpoint.read_field(source)
        if config.warm_start_frame != "auto":
            in_model_frame = config.warm_start_frame == "model"
        if not in_model_frame:
            frame = (self.kwargs.get("metadata") or {}).get(DATASET_FRAME)
            if frame is None:
                raise CheckpointError(
                    "the warm start is in the capture's coordinates, and only the sundae datamanager knows the way from "
                    "there; train with its own datamanager, or say --pipeline.model.warm-start-frame model"
                )
            params = similarity(params, *frame)
        wanted, found = (config.sh_degree + 1) ** 2 - 1, params["features_rest"].shape[1]
        rest = params["features_rest"].new_zeros(len(params["means"]), wanted, 3)
        rest[:, : min(wanted, found)] = params["features_rest"][:, : min(wanted, found)]
        params["features_rest"] = rest
        if self.num_features:
            params[FEATURES] = initial_features(params["features_dc"], self.num_features)
        CONSOLE.log(f"warm start: {len(params['means'])} primitives from {source}")
        return params

    def _strategy(self) -> CappedStrategy | ChainStrategy:
        """How the field grows, until the prune that would be undone by it."""
        config, pruning = self.config, self.config.pruning
        continuous = pruning.mode == "continuous"
        stop = min(config.stop_split_at, pruning.stop if continuous else self._prune_at or config.stop_split_at)
        cap = pruning.max_primitives if continuous else None
        if config.warmup == "mcmc":
            return ChainStrategy(
                cap=min(config.mcmc_cap, cap or config.mcmc_cap),
                refine_start_iter=config.warmup_length,
                refine_stop_iter=stop,
                refine_every=config.refine_every,
            )
        return CappedStrategy(
            cap=cap,
            prune_opa=config.cull_alpha_thresh,
            grow_grad2d=config.densify_grad_thresh,
            grow_scale3d=config.densify_size_thresh,
            grow_scale2d=config.split_screen_size,
            prune_scale3d=config.cull_scale_thresh,
            prune_scale2d=config.cull_screen_size,
            refine_scale2d_stop_iter=config.stop_screen_size_at,
            refine_start_iter=config.warmup_length,
            refine_stop_iter=stop,
            reset_every=config.reset_alpha_every * config.refine_every,
            refine_every=config.refine_every,
            pause_refine_after_reset=self.num_train_data + config.refine_every,
            absgrad=config.use_absgrad,
            verbose=False,
        )

    @property
    def gaussians(self) -> MutableMapping[str, torch.nn.Parameter]:
        """The parameters of the field; a ``ParameterDict`` is a mapping in all but its declared type."""
        return cast(MutableMapping[str, torch.nn.Parameter], self.gauss_params)

    @property
    def _prune_at(self) -> int | None:
        """Step of the prune that follows densification; None where there is none."""
        return self.config.pruning.prune_at if self.config.pruning.mode in ("one-shot", "auto") else None

    @property
    def schedule_step(self) -> int:
        """Step of the schedule: a warm start begins where the warm-up would have ended."""
        return self.step + (self.config.pruning.prune_at if self.config.warm_start is not None else 0)

    @property
    def _pruning_end(self) -> int:
        """Step of the schedule after which the field keeps its primitives."""
        pruning = self.config.pruning
        return pruning.stop if pruning.mode == "continuous" else pruning.last_prune

    @property
    def head_active(self) -> bool:
        """Whether the head takes part: it starts when pruning has ended, unless told otherwise, or when auto lets it."""
        if self.budget is not None:
            return self.head is not None and self.budget.search.head
        start = self.config.head.start_at
        return self.head is not None and self.schedule_step > (self._pruning_end if start is None else start)

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

    def share(self, shards: Shards) -> None:
        """Be one of the ranks that hold the field together, each its block of primitives."""
        self.shards = shards
        self.policy = GlobalPruning(make_policy(self.config.pruning), shards)
        if isinstance(self.strategy, CappedStrategy):
            # Opacities are reset, and then each picture is seen once before anything grows or goes.
            pictures = -(-self.num_train_data // shards.ranks)
            self.strategy.pause_refine_after_reset = pictures + self.config.refine_every

    def arrivals(self, params: Mapping[str, Tensor], view: View, *, features: bool = False) -> Arrived:
        """What this process needs to draw its view, from all ranks; each has to ask, see :mod:`sundae_ns.distributed`."""
        assert self.shards is not None
        return self.shards.arrivals(params, view, self._colors, near_plane=NEAR_PLANE, features=features)

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
        checkpoint.check_model_state(state_dict, expected, self.num_features)
        n = state_dict["gauss_params.means"].shape[0]
        for name, value in self.gauss_params.items():
            value.data = value.data.new_zeros(n, *expected[f"gauss_params.{name}"].shape[1:])
        if self.budget is not None:
            self.head = self.budget.prepare_head(state_dict[checkpoint.EXTRA_STATE], self.head)
        self._warm_start_error = None
        # Past SplatfactoModel's own loader on purpose: it replaces parameters and resets the step.
        return super(SplatfactoModel, self).load_state_dict(state_dict, **kwargs)

    # ---------------------------------------------------------------------------------------------------- rendering

    def view_of(self, camera: Cameras, downscale: int = 1) -> View:
        """The rasteriser's form of a camera of shape ``(1,)``; nothing in ``camera`` is changed.

        Args:
            camera: nerfstudio camera, camera-to-world with OpenGL axes.
            downscale: divide the resolution by this.
        """
        if self.training:
            pose = self.camera_optimizer.apply_to_camera(camera)
        else:
            # Small sums on single numbers: on a GPU each would cost a launch, and each number read back a wait.
            camera = camera.to("cpu")
            pose = camera.camera_to_worlds
        pose = pose.reshape(-1, 3, 4)[0]
        rotation = pose[:, :3] * pose.new_tensor([1.0, -1.0, -1.0])
        top = torch.cat([rotation.T, -rotation.T @ pose[:, 3:]], dim=1)
        viewmat = torch.cat([top, pose.new_tensor([[0.0, 0.0, 0.0, 1.0]])])
        K = camera.get_intrinsics_matrices().reshape(-1, 3, 3)[0].clone()
        K[:2] /= downscale
        size = (int(camera.width.item()) // downscale, int(camera.height.item()) // downscale)
        focal = (camera.fx + camera.fy).item() / 2 / downscale
        return View(viewmat.to(self.device), K.to(self.device), *size, focal)

    def _splat(self, params: Mapping[str, Tensor], view: View, channels: Tensor, **kwargs: Any) -> Rasterization:
        return rasterize(
            params["means"],
            params["quats"],
            params["scales"].exp(),
            params["opacities"].sigmoid().squeeze(-1),
            channels,
            view.viewmat,
            view.K,
            view.width,
            view.height,
            near_plane=NEAR_PLANE,
            antialiased=self.config.rasterize_mode == "antialiased",
            backend=self.backend,
            **kwargs,
        )

    def _colors(self, params: Mapping[str, Tensor], view: View | Camera) -> Tensor:
        """Colours ``[N, 3]`` of the primitives as this view sees them."""
        if isinstance(params, Arrived):
            return params["colors"]
        if self.config.sh_degree == 0:
            return params["features_dc"].sigmoid()
        degree = round((params["features_rest"].shape[1] + 1) ** 0.5) - 1
        if self.config.warm_start is None:
            degree = min(self.step // self.config.sh_degree_interval, degree)
        center = -view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
        coeffs = torch.cat([params["features_dc"][:, None], params["features_rest"]], dim=1)
        return (spherical_harmonics(degree, params["means"] - center, coeffs, backend=self.backend) + 0.5).clamp_min(0)

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
        compensate, field = compensate and self.head_active, params
        if self.shards is not None and not isinstance(params, Arrived):
            params = self.arrivals(params, view, features=compensate)
        colors = self._colors(params, view)
        channels = torch.cat([colors, params[FEATURES]], dim=1) if compensate else colors
        absgrad = self.training and self.config.use_absgrad and self._densifying and self.config.warmup == "densify"
        splat = self._splat(params, view, channels, render_depth=depth, absgrad=absgrad)
        blended, features = splat.colors[..., :3], splat.colors[..., 3:]
        base = (blended + (1 - splat.alpha) * background).clamp(0.0, 1.0)
        rgb = base
        if compensate:
            assert self.head is not None
            zoom, weight = (1.0, 1.0) if self.training else plan(view.focal, self.trained_focal)
            if zoom == 1.0:
                rgb = self.head(base, splat.colors, splat.alpha)
            elif weight > 0:
                at_scale, _ = self.render(field, view.zoomed(zoom), background, depth=False)
                correction = at_scale["rgb"] - at_scale["base_rgb"]
                rgb = base + weight * resize(correction, view.height, view.width)
            if not self.training:
                rgb = rgb.clamp(0.0, 1.0)
        pictures = {
            "rgb": rgb,
            "base_rgb": base,
            "depth": splat.depth,
            "accumulation": splat.alpha,
            "feature_image": features,
        }
        if isinstance(params, Arrived):
            splat.info["route"] = params.route
        return pictures, splat

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
        view = self.view_of(camera, self._get_downscale_factor())
        background = self._get_background_color()
        if self.training:
            self._remember_focal(view)
            window = self._training_window(view)
            view = view if window is None else view.cut(window)
            outputs, splat = self.render(
                self.gaussians, view, background, depth=self.config.output_depth_during_training
            )
            self.info = splat.info
            if self._densifying:
                self.strategy.step_pre_backward(
                    self.gauss_params, self.optimizers, self.strategy_state, self.schedule_step, self.info
                )
            outputs.pop("feature_image")
            return {**outputs, "background": background, "window": window}

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
        outputs, splat = self.render(params, view, background, compensate=compensate)
        field, features = dict(self.gaussians), outputs.pop("feature_image")
        later = {
            "depth": partial(display.fill_depth, outputs["depth"], splat.alpha),
            "features": partial(self._feature_colors, field, features, splat.alpha),
            "response": partial(self._response_image, field, mask, self._response_key, view),
        }
        background = background.expand(view.height, view.width, 3)
        return LazyOutputs({**outputs, **{k: Later(make) for k, make in later.items()}, "background": background})

    @staticmethod
    def _feature_colors(field: Mapping[str, Tensor], image: Tensor, alpha: Tensor) -> Tensor:
        if image.shape[-1] == 0:
            return alpha.new_zeros(*alpha.shape[:2], 3)
        return display.feature_colors(image, *display.principal_components(field[FEATURES]), alpha)

    @property
    def _response_key(self) -> tuple[int, int] | None:
        """Which state of the field a response belongs to; None while the field still grows, when it is not shown."""
        if self.attached and self._densifying:
            return None
        return self.num_points, self.pruning_state["num_prunes"]

    def _response_image(
        self, field: Mapping[str, Tensor], mask: Tensor | None, key: tuple[int, int] | None, view: View
    ) -> Tensor:
        shown = None if key is None else self._response_values(field, key)
        if shown is None:
            return field["means"].new_zeros(view.height, view.width, 1)
        if mask is not None:
            field, shown = {name: value[mask] for name, value in field.items()}, shown[mask]
        return self._splat(field, view, shown[:, None]).colors

    def _response_values(self, field: Mapping[str, Tensor], key: tuple[int, int]) -> Tensor | None:
        """Spectral response ``[N]`` for display, kept until the field is pruned again."""
        of, values = self._response
        if of != key:
            try:
                values = display.response_values(response(field, self.config.pruning).magnitude)
            except DataError:  # one primitive has no neighbour: nothing to show
                values = None
            self._response = (key, values)
        return values

    @staticmethod
    def get_empty_outputs(width: int, height: int, background: Tensor) -> dict[str, Any]:
        """What a crop without primitives shows: the same keys and shapes as any other picture."""
        picture = background.expand(height, width, 3)
        zeros = background.new_zeros(height, width, 1)
        return {
            "rgb": picture,
            "base_rgb": picture,
            "depth": zeros + 10,
            "accumulation": zeros,
            "features": background.new_zeros(height, width, 3),
            "response": zeros,
            "background": picture,
        }

    # ----------------------------------------------------------------------------------------------------- training

    def _get_downscale_factor(self) -> int:
        """Splatfacto's rising resolution; a warm start has risen."""
        return 1 if self.config.warm_start is not None else super()._get_downscale_factor()

    def _remember_focal(self, view: View) -> None:
        if self.head_active and self._get_downscale_factor() == 1:
            low, high = self.trained_focal or (view.focal, view.focal)
            self.trained_focal = (min(low, view.focal), max(high, view.focal))

    def _training_window(self, view: View) -> Window | None:
        # Densification takes its statistics from whole pictures.
        if not self.head_active or self._densifying:
            return None
        return training_window(view.width, view.height, self.config.head.max_train_pixels, seed=self.step)

    @property
    def _densifying(self) -> bool:
        return self.schedule_step < self.strategy.refine_stop_iter

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """Splatfacto's callbacks, then pruning: after densification has had its say on the same step."""
        if self._warm_start_error is not None:
            raise self._warm_start_error
        backend = self.backend  # an unusable rasteriser should be known before the first step
        CONSOLE.log(f"rasteriser: {backend.name} on {self.device}")
        self.attached = True
        if self.budget is not None:
            self.budget.check(cast(Any, training_callback_attributes.pipeline).datamanager)
        callbacks = super().get_training_callbacks(training_callback_attributes)
        for location, act in (
            (TrainingCallbackLocation.AFTER_TRAIN, self._finish),
            (TrainingCallbackLocation.AFTER_TRAIN_ITERATION, self._prune_if_due),
        ):
            callback = partial(act, training_callback_attributes)
            callback.__name__ = act.__name__.lstrip("_")  # type: ignore[attr-defined]
            callbacks.append(TrainingCallback([location], callback))
        return callbacks

    def step_post_backward(self, step: int) -> None:
        """Densify."""
        if self._densifying and self.shards is not None:
            self.shards.densify(self)
        elif self._densifying:
            self.strategy.step_post_backward(
                params=self.gauss_params,
                optimizers=self.optimizers,
                state=self.strategy_state,
                step=self.schedule_step,
                info=self.info,
                packed=False,
            )

    def _prune_if_due(self, attributes: TrainingCallbackAttributes, step: int) -> None:
        optimizers, pipeline = attributes.optimizers, attributes.pipeline
        assert optimizers is not None
        assert pipeline is not None
        # Between growing and culling there were more than now.
        peaks = (self.pruning_state["peak"], self.strategy_state.get("peak", 0))
        self.pruning_state["peak"] = max(peaks)
        due = self.policy.due(self.pruning_state, self.schedule_step, self.total_points)
        evaluate = due and self.config.evaluate_prune and self._prune_at is not None
        before = self._evaluate(pipeline, "warm-up", step) if evaluate else {}
        try:
            report = self.policy.step_post_backward(
                self.gaussians,
                optimizers.optimizers,
                self.pruning_state,
                self.schedule_step,
                strategy_state=self.strategy_state,
                contribution=partial(self.contribution, cast(SundaeDatamanager, pipeline.datamanager)),
            )
            if self.budget is not None:
                self.budget.after_step(self, attributes)
        except SundaeError:
            # The warm-up should not be lost to an option that can be mended: resuming prunes at the first step.
            if attributes.trainer is not None:
                attributes.trainer.save_checkpoint(step)
            raise
        self._refresh(optimizers)
        last = self.schedule_step >= self._pruning_end
        pruned = last or (self._prune_at is not None and self.pruning_state["num_prunes"] > 0)
        if self.budget is None and pruned:
            notify_pruned(optimizers.schedulers, step, last=last)
        if report is None:
            return
        CONSOLE.log(report.summary())
        if report.dropped_nonfinite:
            CONSOLE.print(f"[yellow]Warning: dropped {report.dropped_nonfinite} primitives that were not finite")
        after = self._evaluate(pipeline, "pruned", step) if evaluate else {}
        self._record(attributes, report, before, after, step)

    def _finish(self, attributes: TrainingCallbackAttributes, step: int) -> None:
        """Say what training took at its peak, and whether a budget was met."""
        primitives, memory = self.pruning_state["peak"], peak_memory(self.device) / 1e6
        CONSOLE.log(f"peak: {primitives:,} primitives, {memory:,.0f} MB of {self.device.type} memory")
        writer.put_dict(name="Peak", scalar_dict={"primitives": primitives, "memory_mb": memory}, step=step)
        if self.budget is not None:
            self.budget.finish(self, attributes)
        writer.write_out_storage()

    def _refresh(self, optimizers: Optimizers) -> None:
        """Surgery makes new parameters; nerfstudio's own list of them would go stale."""
        for name, value in self.gauss_params.items():
            optimizers.parameters[name] = [value]

    def _evaluate(self, pipeline: Any, label: str, step: int) -> dict[str, float]:
        if not pipeline.datamanager.eval_dataset:
            return {}
        if self.shards is not None:
            self.shards.agree_on_focal(self)
        results = pipeline.get_average_eval_image_metrics(step=step)
        CONSOLE.log(f"{label}: PSNR {results['psnr']:.2f} dB, SSIM {results['ssim']:.4f} on all test views")
        return {name: results[name] for name in ("psnr", "ssim")}

    def _record(
        self,
        attributes: TrainingCallbackAttributes,
        report: PruneReport,
        before: dict[str, float],
        after: dict[str, float],
        step: int,
    ) -> None:
        """Write what the prune did to tensorboard, and to ``prune.json`` in the run's folder."""
        scalars = {"before": report.before, "after": report.after, "seconds": report.seconds, "peak": report.peak}
        writer.put_dict(name="Prune", scalar_dict=scalars, step=step)
        if attributes.trainer is None or (self.shards is not None and self.shards.rank != 0):
            return
        path = attributes.trainer.base_dir / "prune.json"
        # A run that was killed after a prune and before the next save does that prune again.
        reports = prunes_before(path, report.step)
        reports.append({**asdict(report), "warm_up": before, "pruned": after})
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, json.dumps(reports, indent=2))

    @torch.no_grad()
    def contribution(self, datamanager: SundaeDatamanager, pruning: PruningConfig | None = None) -> Tensor:
        """Blending weight of each primitive, summed over the pixels of all training views ``[N]``.

        Where the score asks for it, pixels count by the detail of the rendering, for as many cells as primitives seen in it
        are going to be kept.

        Args:
            datamanager: has the training views.
            pruning: options of the prune, if they are not those of the model.
        """
        pruning = pruning or self.config.pruning
        share = pruning.share(self.total_points) if pruning.uses_detail else None
        cameras = list(datamanager.training_cameras())
        if self.shards is not None:
            return self.shards.contribution(self, cameras, share)
        total = torch.zeros(self.num_points, device=self.device)
        for camera in track(cameras, description="Contribution of primitives", transient=True, console=CONSOLE):
            total += self.weights_of(self.view_of(camera), share)
        return total

    def weights_of(
        self, view: View, keep_ratio: float | None = None, field: Mapping[str, Tensor] | None = None
    ) -> Tensor:
        """Blending weight of each primitive, summed over the pixels of one view ``[N]``.

        Args:
            view: the camera.
            keep_ratio: share of the primitives that will stay; given, pixels count by the detail that so many can show.
            field: the primitives, if not those of this process.
        """
        params, pixels = self.gaussians if field is None else field, None
        if keep_ratio is not None:
            # Not the background of training, which may be random: the choice is to be the same from run to run.
            background = self.background_color.to(self.device)
            pictures, splat = self.render(params, view, background, depth=False, compensate=False)
            pixels = pixel_detail(pictures["base_rgb"], keep_ratio * float((splat.radii > 0).sum()))
        return blending_weights(
            params["means"],
            params["quats"],
            params["scales"].exp(),
            params["opacities"].sigmoid().squeeze(-1),
            view.viewmat,
            view.K,
            view.width,
            view.height,
            pixels=pixels,
            backend=self.backend,
        )

    # --------------------------------------------------------------------------------------------- losses and metrics

    def _target(self, batch: dict[str, Any], outputs: dict[str, Any]) -> Tensor:
        if NO_PICTURES in batch:
            raise DataError(
                "this run was unpacked without its capture: its cameras are there to look through, not to train or evaluate "
                "on; give the capture to sundae unpack with --data"
            )
        truth = _cut(self.get_gt_img(batch["image"]), outputs.get("window"))
        return self.composite_with_background(truth, outputs["background"])

    def get_metrics_dict(self, outputs: dict[str, Any], batch: dict[str, Any]) -> dict[str, Any]:
        """PSNR with and without the head, and the number of primitives."""
        target = self._target(batch, outputs)
        metrics: dict[str, Any] = {
            "psnr": psnr(outputs["rgb"].detach().clamp(0, 1), target),
            "psnr_base": psnr(outputs["base_rgb"].detach(), target),
            "gaussian_count": self.total_points,
        }
        self.camera_optimizer.get_metrics_dict(metrics)
        return metrics

    def _picture_loss(self, picture: Tensor, target: Tensor) -> Tensor:
        """``lambda_1 L1 + lambda_2 (1 - SSIM)`` of the paper, both pictures ``[H, W, 3]``."""
        weight = self.config.ssim_lambda
        l1 = (picture - target).abs().mean()
        if weight == 0 or min(target.shape[:2]) < SSIM_WINDOW:
            return l1
        # Contiguous planes: on the interleaved colours of a large picture the same convolutions take much longer.
        planes = (image.permute(2, 0, 1)[None].contiguous() for image in (target, picture))
        return (1 - weight) * l1 + weight * (1 - self.ssim(*planes))

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Any], metrics_dict: dict[str, Any] | None = None
    ) -> dict[str, Tensor]:
        """The picture's loss; beside it, while the head takes part, an L1 loss on the base colours."""
        target, rgb, base = self._target(batch, outputs), outputs["rgb"], outputs["base_rgb"]
        if "mask" in batch:
            mask = _cut(self._downscale_if_required(batch["mask"]).to(self.device), outputs.get("window"))
            target, rgb, base = target * mask, rgb * mask, base * mask
        losses = {"main_loss": self._picture_loss(rgb, target)}
        if self.head_active and self.config.base_loss_weight > 0:
            losses["base_loss"] = self.config.base_loss_weight * (base - target).abs().mean()
        if self.training:
            self.camera_optimizer.get_loss_dict(losses)
            if self.config.warmup == "mcmc" and self._densifying:
                # What nothing needs becomes transparent and small, and can be moved (equation 10 of 3DGS-MCMC).
                losses["opacity_loss"] = MCMC_REGULARISER * self.gauss_params["opacities"].sigmoid().mean()
                losses["scale_loss"] = MCMC_REGULARISER * self.gauss_params["scales"].exp().mean()
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
