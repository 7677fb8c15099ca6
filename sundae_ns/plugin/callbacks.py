"""nerfstudio's training callbacks: they call ours, which know nothing of nerfstudio."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.utils import writer
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from sundae_ns.io.accounting import bytes_of, bytes_of_module
from sundae_ns.io.config_file import find_config
from sundae_ns.io.run_folder import take_records
from sundae_ns.plugin.datamanager import SundaeDatamanager
from sundae_ns.plugin.distributed import Ranks
from sundae_ns.scene.render import GaussianSource, RenderSettings, TrainingCamera
from sundae_ns.train.state import Callback, Photo, TrainingState


class NerfstudioRun:
    """A training by nerfstudio's trainer, as its callbacks see it.

    The model is a ``SundaeModel``, which imports this module. Trainer and pipeline may be missing, as in a test.
    """

    def __init__(self, model: Any, attributes: TrainingCallbackAttributes) -> None:
        self.model = model
        self.state: TrainingState = model.state
        self.background: Tensor = model.background_color.to(model.device)
        self._optimizers, self._pipeline = attributes.optimizers, cast(Any, attributes.pipeline)
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
        return cast(GaussianSource, self.model.source)

    @property
    def settings(self) -> RenderSettings:
        """Settings of images that are not trained on, at this step."""
        return cast(RenderSettings, self.model.render_settings(training=False))

    @property
    def _datamanager(self) -> SundaeDatamanager:
        return cast(SundaeDatamanager, self._pipeline.datamanager)

    def view_indices(self) -> list[int]:
        """Indices of the training views."""
        return self._datamanager.train_indices

    def training_views(self) -> list[TrainingCamera]:
        """All training views."""
        return training_views(self.model, self._datamanager)

    def hold_out(self, indices: Iterable[int]) -> None:
        """Hold out these training views from the next step on, until the next call."""
        self._datamanager.hold_back(indices)

    def heldout_views(self) -> Iterator[Photo]:
        """The held-out training views, loaded one at a time."""
        for camera, batch in self._datamanager.cameras(self._datamanager.holdout_indices):
            yield self._photo(camera, batch)

    def photos(self) -> Iterator[Photo]:
        """All training views in full size; transparent pixels are masked."""
        for camera, batch in self._datamanager.cameras(self.view_indices()):
            photo, image = self._photo(camera, batch), batch["image"]
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

    # -------------------------------------------------------------------------------------------------------- callbacks

    def start(self) -> list[TrainingCallback]:
        """Hand the optimizers to the state, take over records, and let our callbacks check the run.

        nerfstudio's callbacks set the step, call ours after each step, and let them report at the end.
        """
        assert self._optimizers is not None
        self.state.optimizers, self.state.schedulers = self._optimizers.optimizers, self._optimizers.schedulers
        if self.folder is not None:
            resumed = self._trainer.config.load_dir or self._trainer.config.load_checkpoint
            if resumed and (config := find_config(resumed)) and config.parent.resolve() != self.folder.resolve():
                take_records(config.parent, self.folder, self.state.schedule_step)
        for callback in self.model.train_callbacks:
            callback.before_training(self)
        self._hand_over()
        at = TrainingCallbackLocation
        return [
            TrainingCallback([at.BEFORE_TRAIN_ITERATION], self._begin_step),
            TrainingCallback([at.AFTER_TRAIN_ITERATION], lambda step: self.act(self.model.train_callbacks)),
            TrainingCallback([at.AFTER_TRAIN], self._finish),
        ]

    def _begin_step(self, step: int) -> None:
        self.state.step = step

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
        with self._ranks.whole() as first:
            if first:
                for callback in self.model.train_callbacks:
                    callback.finish(self)
            if self.folder is not None:
                head = self.state.head if self.state.head_enabled else None
                size = bytes_of(self.state.gaussians) + (0 if head is None else bytes_of_module(head))
                with_head = f"{'without' if head is None else 'with'} a head"
                lines = [f"{self.source.total:,} Gaussians, {with_head}: {size / 1e6:.2f} MB before packing"]
                lines += [f"next: {shlex.join(['sundae', 'pack', str(self.folder), '-o', 'scene.sundae'])}"]
                if self.model.config.evaluate_prune and (results := self.evaluate()):
                    quality = f"PSNR {results['psnr']:.2f} dB, SSIM {results['ssim']:.4f}"
                    lines.insert(0, f"trained: {quality} on {len(self._datamanager.eval_dataset)} test views")
                CONSOLE.print("\n".join(lines), markup=False, highlight=False, soft_wrap=True)
        writer.write_out_storage()


def training_views(model: Any, datamanager: SundaeDatamanager) -> list[TrainingCamera]:
    """All training views of a datamanager."""
    with torch.no_grad():  # a camera optimizer moves them
        return [TrainingCamera(model.camera_of(camera), mask) for camera, mask in datamanager.training_views()]
