"""The SUNDAE model for nerfstudio: it connects state, callbacks and rendering to splatfacto's interface.

Module path and class names are written into every run's ``config.yml``, so moving them breaks saved runs.
"""

from __future__ import annotations

import logging
import shlex
from collections.abc import Iterable, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal, cast

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.models.splatfacto import SplatfactoModel, SplatfactoModelConfig, resize_image
from nerfstudio.utils import writer
from nerfstudio.utils.rich_utils import CONSOLE
from pytorch_msssim import SSIM
from torch import Tensor

from sundae_ns.core.camera import Camera, Crop, crop_image
from sundae_ns.core.gaussians import bytes_of
from sundae_ns.core.metrics import Lpips, psnr, quality_of
from sundae_ns.cuda.kernels import naming_full_memory
from sundae_ns.head.head import CompensationHead, HeadConfig, bytes_of_module
from sundae_ns.io import checkpoint
from sundae_ns.io.config_file import find_config
from sundae_ns.io.run_folder import take_records
from sundae_ns.plugin.datamanager import DATASET_FRAME, SundaeDatamanager
from sundae_ns.plugin.dataparsers import camera_of, check_projection
from sundae_ns.plugin.distributed import Ranks
from sundae_ns.plugin.viewer import ViewerControls, in_viewer
from sundae_ns.rasterize.interface import select_backend
from sundae_ns.rasterize.types import Backend
from sundae_ns.scene.frames import FrameReplay, LazyOutputs, ShownResponse, empty_outputs, late_outputs
from sundae_ns.scene.render import SHOWN_BACKGROUNDS, GaussianSource, RenderSettings, contribution, render_view
from sundae_ns.train.build import build
from sundae_ns.train.exposure import ExposureCompensation
from sundae_ns.train.initialize import Start
from sundae_ns.train.pruning import DROPPED, FEW_DROPPED, MANY_VIEWS, PruningConfig
from sundae_ns.train.state import HEAD, Callback, Photo, TrainingState
from sundae_ns.train.step import StepInputs, StepLosses, StepResolution, training_part
from sundae_ns.train.trials import Trials

_log = logging.getLogger(__name__)


@dataclass
class SundaeModelConfig(SplatfactoModelConfig):
    """Splatfacto, pruned and compensated. Options of splatfacto keep their meaning."""

    _target: type = field(default_factory=lambda: SundaeModel)
    pruning: PruningConfig = field(default_factory=PruningConfig)
    """When to prune, how many Gaussians to keep, and which."""
    head: HeadConfig = field(default_factory=HeadConfig)  # The compensation head
    rasterizer: Literal["auto", "gsplat", "cpu", "reference"] = "auto"
    """auto takes gsplat on CUDA and compiled loops on a CPU; reference is slow, in plain PyTorch."""
    base_loss_weight: float = 0.2
    """Weight of the loss on the image without the head, which keeps exported .ply files valid."""
    loss_after_prune: Literal["l1", "rms"] = "rms"
    """Term beside SSIM: l1 is the paper's; rms, the root of the mean squared error, gains 0.1 to 0.3 dB."""
    prior_after_prune: float = 0.3  # Weight of opacities and scales in the loss once pruned, over the number of images
    average_share: float = 0.1  # Last share of the schedule over which weights are averaged; 0.1 gains 0.2 dB
    drop_rate: float | None = None  # Share left out after the prune: 0.2 below 32 photos, 0.1 where counts are tried
    exposure_compensation: Literal["auto", "on", "off"] = "auto"
    """Even out photos of changing exposure or white balance with their neighbours; auto does if half of them differ."""
    dense_start_views: int = 300
    """With at most this many training images, a plane sweep fills a sparse cloud to start from; 0 turns it off."""
    warm_start: Path | None = None  # Finished Gaussians to start from: a .ckpt, its folder, a .sundae or a .ply
    warm_start_frame: Literal["auto", "model", "capture"] = "auto"
    """Coordinates of the warm start: nerfstudio's model, or the capture (COLMAP). auto decides by the kind of file."""
    stop_split_at: int = 12000
    """Step at which densification ends, that of the prune; longer growth gains nothing that the prune keeps."""
    evaluate_prune: bool = True  # Evaluate all test views right before and right after the prune, and at the end

    @property
    def num_features(self) -> int:
        """Length of the feature vectors; 0 without a head."""
        return 0 if self.head.mode == "off" else self.head.num_features


class SundaeModel(SplatfactoModel):
    """Trains Gaussians, prunes them, and compensates for the loss.

    A subclass of ``SplatfactoModel``, because nerfstudio's exporter and viewer test for it. Everything that ties the
    original to CUDA or to downloads is replaced: initialisation, view matrix, outputs, LPIPS.
    """

    config: SundaeModelConfig
    state: TrainingState  # Gaussians, head, optimizers, running states, and the clock
    source: GaussianSource  # Where views get their Gaussians from
    train_callbacks: list[Callback]  # Parts of training beside the step, in the order in which they act

    def populate_modules(self) -> None:
        """Build Gaussians, head and callbacks. The device of the model is not known yet."""
        config = self.config
        frame = (self.kwargs.get("metadata") or {}).get(DATASET_FRAME)
        self.state, self.train_callbacks, self._start = build(config, self.num_train_data, self.seed_points, frame)
        self.gauss_params, self.networks = cast(Any, self.state.gaussians.data), self.state.networks
        self.source = GaussianSource(self.state.gaussians)
        self.exposure_compensation = next(cb for cb in self.train_callbacks if isinstance(cb, ExposureCompensation))
        self.camera_optimizer = config.camera_optimizer.setup(num_cameras=self.num_train_data, device="cpu")
        self.ssim = SSIM(data_range=1.0, size_average=True, channel=3)
        self.losses = StepLosses(config, self.ssim, self.num_train_data)
        self.lpips = Lpips()  # type: ignore[assignment]
        self.crop_box: OrientedBox | None = None
        self.background_color = torch.tensor(SHOWN_BACKGROUNDS[config.background_color])
        curve = next((callback.curve for callback in self.train_callbacks if isinstance(callback, Trials)), list)
        self.viewer_controls = ViewerControls(self.state, config.pruning, self.contribution, curve)
        self.compensated = True  # Whether images outside of a viewer get the head's correction
        self._response, self._replay = ShownResponse(), FrameReplay()
        # Views of training cameras that do not move, by index and divisor of their sides
        self._cameras: dict[tuple[int | None, int], Camera] = {}

    # ------------------------------------------------------------------------------------------------ the Gaussians

    def train(self, mode: bool = True) -> SundaeModel:
        """Switch between training and evaluation; a walk over all modules at each step would take time."""
        return self if self.training == mode else super().train(mode)

    @property
    def step(self) -> int:
        """Training step."""
        return self.state.step

    @step.setter
    def step(self, value: int) -> None:
        self.state.step = value

    @property
    def head(self) -> CompensationHead | None:
        """The head; None without one."""
        return self.state.head

    @cached_property
    def backend(self) -> Backend:
        """The rasteriser, chosen once the device is known; ``BackendError`` if it was asked for and cannot run here."""
        return select_backend(self.config.rasterizer, self.device)

    def get_gaussian_param_groups(self) -> dict[str, list[torch.nn.Parameter]]:
        """One group for each parameter of the Gaussians, features included."""
        return {name: [value] for name, value in self.gauss_params.items()}

    def get_param_groups(self) -> dict[str, list[torch.nn.Parameter]]:
        """Groups of the Gaussians, of the head (``compensation``) and of the cameras."""
        groups = super().get_param_groups()
        if self.head is not None:
            groups[HEAD] = list(self.head.parameters())
        return groups

    # -------------------------------------------------------------------------------------------------- checkpoints

    def get_extra_state(self) -> dict[str, Any]:
        """Everything beside tensors that a resumed run needs, see :func:`.check_extra_state`."""
        state = self.state
        return {
            **checkpoint.OURS,
            "step": state.step,
            "num_features": self.config.num_features,
            "encoding": state.gaussians.encoding,
            "running": {"densification": dict(state.densification), "pruning": dict(state.pruning)},
            "extensions": {callback.name: dict(callback.state_dict()) for callback in self.train_callbacks},
            "trained_focal": state.trained_focal and list(state.trained_focal),
            "head_enabled": state.head_enabled,
        }

    def set_extra_state(self, state: Mapping[str, Any]) -> None:
        """Counterpart of :meth:`get_extra_state`; tensors move to the device of the Gaussians."""
        self.state.step = int(state["step"])
        focal = state["trained_focal"]
        self.state.trained_focal = None if focal is None else (float(focal[0]), float(focal[1]))
        self.state.load_running_states(state["running"])
        for callback in self.train_callbacks:
            callback.load_state_dict(self.state, state["extensions"].get(callback.name, {}))

    def load_state_dict(self, state_dict: Mapping[str, Any], **kwargs: Any) -> Any:  # type: ignore[override]
        """Load a SUNDAE checkpoint with any number of Gaussians; ``CheckpointError`` for another kind or head.

        Parameters are resized in place, because optimizers may hold them already.
        """
        extra = checkpoint.check_extra_state(state_dict, self.config.num_features, self.state.gaussians.encoding)
        for callback in self.train_callbacks:
            callback.prepare_loading(self.state, extra["extensions"].get(callback.name, {}))
        checkpoint.check_model_state(state_dict, self.state_dict())
        for value in self.gauss_params.values():
            value.data = value.data.new_zeros(len(state_dict["gauss_params.means"]), *value.shape[1:])
        self._start = Start()
        # Not SplatfactoModel's own loader, which replaces parameters and resets the step.
        return super(SplatfactoModel, self).load_state_dict(state_dict, **kwargs)

    # ---------------------------------------------------------------------------------------------------- rendering

    def camera_of(self, camera: Cameras, downscale: int = 1) -> Camera:
        """The rasteriser's form of a camera of shape ``(1,)``, moved by the camera optimizer while it trains."""
        optimizer = self.camera_optimizer
        pose = optimizer.apply_to_camera(camera) if self.training and optimizer.config.mode != "off" else None
        return camera_of(camera, self.device, pose=pose, downscale=downscale)

    def render_settings(self, *, training: bool) -> RenderSettings:
        """Settings of images at this step."""
        antialiased, absgrad = self.config.rasterize_mode == "antialiased", self.config.use_absgrad
        settings = self.state.render_settings(self.backend, antialiased=antialiased, training=training, absgrad=absgrad)
        few = 0 < self.num_train_data < MANY_VIEWS
        usual = FEW_DROPPED if few else DROPPED * self.config.pruning.decides
        rate = usual if self.config.drop_rate is None else self.config.drop_rate
        leaves_out = training and self.state.pruned and (few or self.state.step < self.state.averages_from)
        return replace(settings, drop_rate=rate if leaves_out else 0.0)

    @torch.no_grad()
    def get_outputs_for_camera(self, camera: Cameras, obb_box: OrientedBox | None = None) -> MutableMapping[str, Any]:  # type: ignore[override]
        """Render a camera, or the Gaussians in a box; unlike splatfacto's, this leaves the camera on its device."""
        self.set_crop(obb_box)
        return self.get_outputs(camera)

    def get_outputs(self, camera: Cameras) -> MutableMapping[str, Any]:  # type: ignore[override]
        """Render a camera of shape ``(1,)``: ``rgb, base_rgb, depth, accumulation, background``, each ``[H, W, C]``.

        In training also ``window``, the crop that the images show, or None; else see ``scene.frames.late_outputs``.
        """
        with naming_full_memory(lambda: self.num_points):
            return self._training_outputs(camera) if self.training else self._shown_outputs(camera)

    def _training_outputs(self, ns_camera: Cameras) -> MutableMapping[str, Any]:
        background = self._get_background_color()
        camera, crop = self._training_camera(ns_camera)
        settings = self.render_settings(training=True)
        depth = self.config.output_depth_during_training
        images, splatted = render_view(self.source, camera, background, settings, depth=depth)
        self.state.info = splatted.info
        for callback in self.train_callbacks:
            callback.before_backward(self.state)
        return {**images, "background": background, "window": crop}

    def _shown_outputs(self, ns_camera: Cameras) -> MutableMapping[str, Any]:
        if not in_viewer():  # an error would end the viewer
            check_projection(ns_camera)
        background, camera = self._get_background_color(), self.camera_of(ns_camera)
        crop = None if self.crop_box is None else self.crop_box.within(self.means).squeeze(-1)
        visible = self.viewer_controls.visible(self.source, crop, compensate=self.compensated)
        if visible is None:
            return empty_outputs(camera.width, camera.height, background)
        settings = self.render_settings(training=False)
        compensated = settings if visible.compensate else replace(settings, head=None)
        images = self._replay.render(visible.source, camera, background, compensated)
        gaussians = self.state.gaussians.replaced({})
        drawn = gaussians if visible.mask is None else visible.source.gaussians
        values = partial(self._response.values, gaussians, self.viewer_controls.gaussians_key, self.config.pruning)
        late = late_outputs(images, drawn, gaussians, visible.mask, camera, settings, values)
        late["background"] = background.expand(camera.height, camera.width, 3)
        return late

    @torch.no_grad()  # a camera optimizer moves views
    def training_views(self, datamanager: SundaeDatamanager) -> list[tuple[Camera, Tensor | None]]:
        """All training views of a datamanager, and the pixels of each that count; None for all."""
        return [(self.camera_of(camera), mask) for camera, mask in datamanager.training_views()]

    def contribution(self, datamanager: SundaeDatamanager, count: int | None = None, most: int | None = None) -> Tensor:
        """Blending weights ``[N]`` by all or ``most`` views, see :func:`sundae_ns.scene.render.contribution`."""
        views, settings = self.training_views(datamanager), self.render_settings(training=False)
        every = -(-len(views) // (most or len(views)))
        return contribution(self.source, views[::every], self.background_color, settings, count, console=CONSOLE)

    # ----------------------------------------------------------------------------------------------------- training

    def _training_camera(self, ns_camera: Cameras) -> tuple[Camera, Crop | None]:
        """The part of a training camera that a step shows. Views are kept: copying one to a GPU waits for it."""
        at = self.resolution(self.step)
        index = (ns_camera.metadata or {}).get("cam_idx")  # the datamanager's, of a training view
        key = index, at.downscale
        camera = self._cameras.get(key) or self.camera_of(ns_camera, at.downscale)
        if index is not None and self.camera_optimizer.config.mode == "off":
            self._cameras[key] = camera
        return training_part(self.state, camera, at)

    def step_inputs(self, ns_camera: Cameras, batch: dict[str, Any]) -> StepInputs:
        """What a step outside of nerfstudio's loop trains on, from a camera of shape ``(1,)`` and its batch."""
        background = self._get_background_color()
        camera, crop = self._training_camera(ns_camera)
        target = self.target(batch, {"background": background, "window": crop})
        return StepInputs(camera, target, self.mask(batch, crop), background, crop)

    def _get_downscale_factor(self) -> int:
        return self.resolution(self.step).downscale if self.training else 1

    def resolution(self, step: int) -> StepResolution:
        """Form of the training images at a step."""
        config, state = self.config, self.state
        rising = config.num_downscales - step // config.resolution_schedule if config.warm_start is None else 0
        cropped = state.head_enabled and not state.densifying  # densification takes its statistics from whole images
        mirror = cropped and not state.provisional and config.head.mode != "features"  # helps in the long run only
        return StepResolution(step, int(2 ** max(rising, 0)), config.head.max_train_pixels if cropped else 0, mirror)

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """Callbacks that call ours."""
        self._start.announce()
        _log.info(f"rasteriser: {self.backend.name} on {self.device}")  # or an error, before the first step
        self.viewer_controls.training_gaussians = True
        return NerfstudioRun(self, training_callback_attributes).start()

    # --------------------------------------------------------------------------------------------- losses and metrics

    def truth(self, batch: dict[str, Any], outputs: Mapping[str, Any], downscale: int | None = None) -> Tensor:
        """The true image of outputs, over their background ``[H, W, 3]``; by default at the resolution of this step."""
        factor = self._get_downscale_factor() if downscale is None else downscale
        image = batch["image"].float() / 255 if batch["image"].dtype == torch.uint8 else batch["image"]
        image = image if factor == 1 else resize_image(image, factor)
        image = crop_image(image.to(self.device), outputs.get("window"))
        return self.composite_with_background(image, outputs["background"])

    def target(self, batch: dict[str, Any], outputs: Mapping[str, Any]) -> Tensor:
        """What outputs are compared with: the truth, in training divided by the gain of its photo ``[H, W, 3]``."""
        truth = self.truth(batch, outputs)
        return self.exposure_compensation.balanced(truth, batch) if self.training else truth

    def mask(self, batch: dict[str, Any], crop: Crop | None) -> Tensor | None:
        """Pixels of a batch that count, at the resolution of this step ``[H, W, 1]``; None for all."""
        mask = None if "mask" not in batch else self._downscale_if_required(batch["mask"]).to(self.device)
        return None if mask is None else crop_image(mask, crop).float()

    def get_metrics_dict(self, outputs: dict[str, Any], batch: dict[str, Any]) -> LazyOutputs:  # type: ignore[override]
        """PSNR with and without the head, and the number of Gaussians; computed on access, which few steps need."""
        # They may be read during the next step. Bind the resolution now, and do not keep the autograd graph alive.
        rgb, base, downscale = outputs["rgb"].detach(), outputs["base_rgb"].detach(), self._get_downscale_factor()
        target = partial(self.truth, batch, {name: outputs.get(name) for name in ("window", "background")}, downscale)
        metrics = LazyOutputs({"gaussian_count": self.source.total})
        metrics["psnr"] = lambda: psnr(rgb.clamp(0, 1), target())
        metrics["psnr_base"] = lambda: psnr(base, target())
        self.camera_optimizer.get_metrics_dict(metrics)  # type: ignore[arg-type]
        return metrics

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Any], metrics_dict: dict[str, Any] | None = None
    ) -> dict[str, Tensor]:
        """Terms of the loss by name, each ``[]``: see :class:`.StepLosses`; in training also the camera optimizer's."""
        target, mask = self.target(batch, outputs), self.mask(batch, outputs.get("window"))
        losses = self.losses(self.state, self.source, outputs["rgb"], outputs["base_rgb"], target, mask)
        if self.training:
            self.camera_optimizer.get_loss_dict(losses)
            self.exposure_compensation.observe(outputs["rgb"], target, mask, batch)
        return losses

    def get_image_metrics_and_images(
        self, outputs: dict[str, Any], batch: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """PSNR, also with fitted colours, SSIM and, with its weights, LPIPS; each also without the head (``_base``)."""
        target = self.truth(batch, outputs)
        metrics = {"gaussian_count": float(self.source.total)}
        for suffix, image in (("", outputs["rgb"]), ("_base", outputs["base_rgb"])):
            figures = asdict(quality_of(image, target, self.lpips))
            metrics |= {name + suffix: value for name, value in figures.items() if value is not None}
        return metrics, {"img": torch.cat([target, outputs["rgb"]], dim=1), "base": outputs["base_rgb"]}


class NerfstudioRun:
    """A training by nerfstudio's trainer, as our callbacks see it; a test has neither trainer nor pipeline."""

    def __init__(self, model: SundaeModel, attributes: TrainingCallbackAttributes) -> None:
        self.model = model
        self.state: TrainingState = model.state
        self.background: Tensor = model.background_color.to(model.device)
        self._optimizers, self._pipeline = attributes.optimizers, cast(Any, attributes.pipeline)
        self._datamanager: SundaeDatamanager = cast(Any, getattr(self._pipeline, "datamanager", None))
        self._trainer = cast(Any, attributes.trainer)
        self._ranks: Ranks = getattr(self._trainer, "ranks", None) or Ranks()
        self.images_per_step = self._ranks.count  # Each image of a batch counts as a step
        self.last_step: int | None = None  # None without a trainer, as the next two
        self.schedule_length: int | None = None  # Number of steps for which the schedule is made
        self.folder: Path | None = None  # Folder for records; None on every rank but the first
        if self._trainer is not None:
            self.last_step = self._trainer.last_step
            self.schedule_length = self._trainer.config.schedule_length or self._trainer.last_step + 1
            self.folder = self._trainer.base_dir if self._ranks.rank == 0 else None

    @property
    def source(self) -> GaussianSource:
        """Where views get their Gaussians from."""
        return self.model.source

    @property
    def settings(self) -> RenderSettings:
        """Settings of images that are not trained on, at this step."""
        return self.model.render_settings(training=False)

    def view_indices(self) -> list[int]:
        """Indices of the training views."""
        return self._datamanager.train_indices

    def training_views(self) -> list[tuple[Camera, Tensor | None]]:
        """All training views."""
        return self.model.training_views(self._datamanager)

    def contribution(self, count: int | None, most: int | None = None) -> Tensor:
        """As :meth:`SundaeModel.contribution`, by the views of this run."""
        return self.model.contribution(self._datamanager, count, most)

    def hold_out(self, indices: Iterable[int]) -> None:
        """Hold out these training views from the next step on, until the next call."""
        self._datamanager.hold_out(indices)

    def held_out_views(self) -> Iterator[Photo]:
        """The held-out training views, loaded one at a time."""
        for camera, batch in self._datamanager.cameras(self._datamanager.held_out_indices):
            yield self._photo(camera, batch)

    def photos(self) -> Iterator[Photo]:
        """All training views in full size; transparent pixels are masked."""
        for camera, batch in self._datamanager.cameras(self.view_indices()):
            photo = self._photo(camera, batch)
            image = batch["image"]
            if image.shape[-1] == 4:
                opaque = (image[..., 3] > (127 if image.dtype == torch.uint8 else 0.5)).to(photo.target.device)
                photo = photo._replace(mask=opaque if photo.mask is None else photo.mask & opaque)
            yield photo

    @torch.no_grad()  # a camera optimizer moves views
    def _photo(self, camera: Cameras, batch: dict[str, Any]) -> Photo:
        target = self.model.truth(batch, {"background": self.background}, downscale=1)
        mask = batch["mask"].to(target.device).squeeze(-1) > 0 if "mask" in batch else None
        return Photo(self.model.camera_of(camera), target, mask)

    def evaluate(self) -> dict[str, float]:
        """Mean ``psnr`` (dB) and ``ssim`` over all test views; empty without any."""
        if not self._datamanager.eval_dataset:
            return {}
        results = self._pipeline.get_average_eval_image_metrics(step=self.state.step)
        return {name: results[name] for name in ("psnr", "ssim")}

    def save(self) -> None:
        """Save a checkpoint."""
        if self._trainer is not None:
            self._trainer.save_checkpoint(self.state.step)

    def log_scalars(self, name: str, values: Mapping[str, float | int]) -> None:
        """Write numbers to the run's event file."""
        writer.put_dict(name=name, scalar_dict=dict(values), step=self.state.step)

    def start(self) -> list[TrainingCallback]:
        """nerfstudio's callbacks, after ours have checked the run with the optimizers and records that they need."""
        assert self._optimizers is not None
        self.state.optimizers, self.state.schedulers = self._optimizers.optimizers, self._optimizers.schedulers
        if self.folder is not None:
            resumed = self._trainer.config.load_dir or self._trainer.config.load_checkpoint
            config = find_config(resumed) if resumed else None
            if config is not None and config.parent.resolve() != self.folder.resolve():
                take_records(config.parent, self.folder, self.state.schedule_step)
        for callback in self.model.train_callbacks:
            callback.before_training(self)
        self._hand_over()
        at = TrainingCallbackLocation
        return [
            TrainingCallback([at.BEFORE_TRAIN_ITERATION], lambda step: setattr(self.state, "step", step)),
            TrainingCallback([at.AFTER_TRAIN_ITERATION], lambda step: self.act(self.model.train_callbacks)),
            TrainingCallback([at.AFTER_TRAIN], self._finish),
        ]

    def act(self, train_callbacks: Sequence[Callback]) -> None:
        """Let callbacks act after a step, in their order."""
        for callback in train_callbacks:
            self._ranks.after_step(callback, self)
        self._hand_over()

    def _hand_over(self) -> None:
        """Give nerfstudio's own list the parameters of the Gaussians: surgery makes new ones."""
        assert self._optimizers is not None
        for name, value in self.state.gaussians.items():
            self._optimizers.parameters[name] = [value]

    def _finish(self, step: int) -> None:
        """Let callbacks report, then print quality, size and the next command."""
        with self._ranks.gathered() as first:
            if first:
                for callback in self.model.train_callbacks:
                    callback.finish(self)
            if self.folder is not None:
                head = self.state.head if self.state.head_enabled else None
                size = bytes_of(self.state.gaussians) + bytes_of_module(head)
                with_head = f"{'without' if head is None else 'with'} a head"
                lines = [f"{self.source.total:,} Gaussians, {with_head}: {size / 1e6:.2f} MB before packing"]
                lines += [f"next: {shlex.join(['sundae', 'pack', str(self.folder), '-o', 'scene.sundae'])}"]
                if self.model.config.evaluate_prune and (results := self.evaluate()):
                    quality = f"PSNR {results['psnr']:.2f} dB, SSIM {results['ssim']:.4f}"
                    lines.insert(0, f"trained: {quality} on {len(self._datamanager.eval_dataset)} test views")
                CONSOLE.print("\n".join(lines), markup=False, highlight=False, soft_wrap=True)
        writer.write_out_storage()
