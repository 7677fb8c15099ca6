"""nerfstudio's trainer with atomic checkpoints, exact resume, and one-line errors.

Module path and class names are written into every run's ``config.yml``, so moving them breaks saved runs.
"""

from __future__ import annotations

import contextlib
import logging
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, cast

import torch
import yaml
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils import profiler, writer
from nerfstudio.utils.misc import step_check
from nerfstudio.utils.rich_utils import CONSOLE
from rich.table import Table

from sundae_ns.core.errors import NOTHING_SAVED, BackendError, CheckpointError, ConfigError, reading, writing
from sundae_ns.core.files import at_home, write_text
from sundae_ns.core.values import usual_defaults, whole
from sundae_ns.cuda.kernels import naming_full_memory
from sundae_ns.io import checkpoint, run_folder
from sundae_ns.io.config_file import find_capture
from sundae_ns.plugin import distributed
from sundae_ns.plugin.datamanager import SundaeDatamanagerConfig
from sundae_ns.plugin.dataparsers import check_capture, warn_of_other_frame
from sundae_ns.plugin.model import SundaeModel
from sundae_ns.plugin.optimizer_configs import HARMONICS_EVERY, FusedAdamConfig
from sundae_ns.plugin.viewer import stop_rendering
from sundae_ns.pruning.decision import diverged
from sundae_ns.train.build import check
from sundae_ns.train.graphed_step import RecordedStep
from sundae_ns.train.progress import Interruption, loaded_run, long_on_cpu, resume_command
from sundae_ns.train.schedules import schedule_table, set_schedule

_log = logging.getLogger(__name__)
TIMED_STEPS = 10  # After the first two, by which a training on a CPU foretells its length


@dataclass
class SundaeTrainerConfig(TrainerConfig):
    """Configuration of a run."""

    _target: type = field(default_factory=lambda: SundaeTrainer)
    schedule_length: int | None = None
    """Steps over which prune, densification, resolution and learning rates are spread, unless you set their options: by
    default max_num_iterations, and the length of the run that is resumed. A larger number trains the first part."""
    finetune_steps: int | None = None
    """Steps at the end of the schedule, at most a twentieth of it, that are left to sundae pack RUN --finetune."""

    def print_to_terminal(self) -> None:
        """Check the capture, make the schedule and log it; ``ns-train`` calls this first of all."""
        for name, least, most in (("num_devices", 1, 1 << 16), ("num_machines", 1, 1 << 16), ("seed", 0, 2**32 - 1)):
            whole(getattr(self.machine, name), f"--machine.{name.replace('_', '-')}", least, most)
        if self.machine.device_type == "cuda" and not torch.cuda.is_available():
            raise BackendError("--machine.device-type is cuda and torch sees no GPU; give cpu, or run sundae doctor")
        if self.gradient_accumulation_steps:
            raise ConfigError("--gradient-accumulation-steps loses gradients at prunes and at a resume; leave it out")
        if self.machine.num_devices > 1:
            distributed.forward_signals()
        self.make_paths_absolute()
        datamanager = self.pipeline.datamanager
        if isinstance(datamanager, SundaeDatamanagerConfig):
            check_capture(datamanager.dataparser, datamanager.capture, ("train", "val"))
        check(self.pipeline.model)
        from nerfstudio.configs.method_configs import all_methods  # imports the entry points, so not at the top

        set_schedule(self, all_methods.get(str(self.method_name)), sys.argv[1:])
        total = "" if self.schedule_length == self.max_num_iterations else f" of {self.schedule_length:,}"
        table = Table("part of training", f"{self.max_num_iterations:,}{total} steps")
        for row in schedule_table(self):
            table.add_row(*row)
        CONSOLE.print(table)

    def make_paths_absolute(self) -> None:
        """Make the paths of ``config.yml`` absolute, because a run may be opened from another folder."""
        datamanager: Any = self.pipeline.datamanager
        owners: list[Any] = [(self, name) for name in ("data", "output_dir", "load_dir")]
        owners += [(datamanager, "data"), (self.pipeline.model, "warm_start")]
        if datamanager.data is None:  # an unset path is nerfstudio's example
            owners.append((datamanager.dataparser, "data"))
        for owner, name in owners:
            if isinstance(value := getattr(owner, name, None), Path):
                setattr(owner, name, at_home(value).absolute())

    def get_base_dir(self) -> Path:
        """Folder of the run: where a command of nerfstudio has found it, for a run that was copied or moved."""
        if (run := loaded_run(sys.argv)) is None or not (run / self.relative_model_dir).is_dir():
            return cast(Path, super().get_base_dir())
        find_capture(self, run)
        return run

    def set_timestamp(self) -> None:
        """Name the run, unless ``--timestamp`` did; runs that start in the same second get different names."""
        if self.timestamp == "{timestamp}":
            self.timestamp = run_folder.new_name()

    def save_config(self) -> None:
        """Write ``config.yml`` into the run's folder atomically, once several ranks can use these options."""
        if self.machine.num_devices > 1:
            distributed.check_options(self)
        path = self.get_base_dir() / "config.yml"
        run_folder.reserve(path.parent)
        CONSOLE.log(f"Saving config to: {path}")
        write_text(path, yaml.dump(self))


class SundaeTrainer(Trainer):
    """Saves atomically, resumes from the newest whole checkpoint, and restores the random generators."""

    config: SundaeTrainerConfig
    pipeline: Any  # nerfstudio's, of our model and our datamanager

    def __init__(self, config: SundaeTrainerConfig, local_rank: int = 0, world_size: int = 1) -> None:
        self.ranks = distributed.Ranks(local_rank, world_size)
        # nerfstudio sees one process. For more it would use DDP, which breaks when the number of Gaussians changes.
        super().__init__(self.ranks.configured(config), local_rank, world_size=1)
        with writing(f"cannot make the run's folder {self.base_dir}"):
            self.base_dir.mkdir(parents=True, exist_ok=True)  # nerfstudio's own way fails if two ranks do so at once
        self._recorded: RecordedStep | None = None  # runs whole steps; None where they run kernel by kernel
        self._result: Any = None  # loss, its terms and metrics of the last step that was trained
        self._batch_ends = 0  # step after the last image of the present batch
        self._trained: int | None = None  # the last step
        self._stopped_by = 0  # the signal that ends this training after the step; 0 for none
        self._interruption = Interruption(self._stop, quiet=local_rank != 0)

    @usual_defaults()
    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """Load the capture and, if a run is resumed, its checkpoint."""
        try:
            super().setup(test_mode)
        except KeyboardInterrupt:
            CONSOLE.print(NOTHING_SAVED)
            raise SystemExit(130) from None
        self.ranks.share(self.model, self.pipeline.datamanager, self.optimizers)
        self.model.state.harmonics_every = HARMONICS_EVERY * self.ranks.count  # an image of each rank counts as a step
        self._recorded = RecordedStep(self.model.losses) if self._recordable() else None
        writer.GLOBAL_BUFFER["max_iter"] = self.last_step + 1  # nerfstudio forgets the steps before a resume

    @property
    def model(self) -> SundaeModel:
        """The model in training."""
        return cast(SundaeModel, self.pipeline.model)

    @property
    def last_step(self) -> int:
        """Step at which this training ends."""
        return self._start_step + self.config.max_num_iterations - 1

    def setup_optimizers(self) -> Optimizers:
        """Optimizers for batches of one image a rank."""
        kind = Optimizers if self.ranks.count == 1 else distributed.BatchOptimizers
        return kind(self.config.optimizers.copy(), self.pipeline.get_param_groups())

    def eval_iteration(self, step: int) -> None:
        """Evaluate on the first rank if it is due."""
        every = ("steps_per_eval_batch", "steps_per_eval_image", "steps_per_eval_all_images")
        if any(step_check(step, getattr(self.config, name)) for name in every):
            with self.ranks.gathered() as first:
                if first:
                    super().eval_iteration(step)

    @usual_defaults()
    def train(self) -> None:
        """Train; errors of a full disk or a full GPU say so in one line."""
        with (
            naming_full_memory(lambda: self.model.num_points),
            writing(f"cannot write to the run's folder {self.base_dir}"),
            self._interruption,
        ):
            try:
                super().train()
            finally:
                stop_rendering(self.viewer_state)

    def train_iteration(self, step: int) -> Any:
        """Train one step. Several ranks train a batch at the first of its steps, and may stop after the last."""
        model = self.model
        if step < self._batch_ends:
            self._step_schedulers()
        else:
            # After a resume the first batch may be a part: harmonics and gains of photos are due at multiples.
            self._batch_ends = step - step % self.ranks.count + self.ranks.count
            if all(callback.trains(model.state) for callback in model.train_callbacks):
                self._result = self._recorded_iteration(step)
                if self._result is None:
                    loss, terms, metrics = super().train_iteration(step)
                    # Without a graph, because nerfstudio holds them for a step.
                    self._result = loss.detach(), {name: term.detach() for name, term in terms.items()}, metrics
                if self.ranks.count > 1:
                    self.ranks.sharded.count_views(model.state, absgrad=model.config.use_absgrad)
            elif self._result is None:  # the run was resumed while training is paused: measure one image
                with torch.no_grad(), torch.random.fork_rng([model.device] if model.device.type == "cuda" else []):
                    _, terms, metrics = self.pipeline.get_train_loss_dict(step)
                self._result = torch.stack([*terms.values()]).sum(), terms, metrics
        self._trained = step
        self._warn_if_long(step - self._start_step)
        if step + 1 == self._batch_ends:
            self._stopped_by = self.ranks.agreed(self._interruption.number, step // self.ranks.count)
            self.stop_training = self.stop_training or bool(self._stopped_by)
        return self._result

    def _recordable(self) -> bool:
        """Whether a CUDA graph can hold a training step under these options."""
        model, config = self.model, self.config
        adams = [config.optimizers[name]["optimizer"] for name in self.optimizers.optimizers]
        return (
            model.device.type == "cuda"
            and model.backend.name == "gsplat"
            and model.source.replayable
            and all(isinstance(adam, FusedAdamConfig) and adam.max_norm is None for adam in adams)
            and model.camera_optimizer.config.mode == "off"
            and not model.config.output_depth_during_training
            and not self.mixed_precision
            and not config.log_gradients
        )

    def _recorded_iteration(self, step: int) -> Any:
        """Train one step by a CUDA graph: loss, its terms, and metrics; None if it has to run kernel by kernel."""
        if self._recorded is None:
            return None
        model = self.model
        camera, batch = self.pipeline.datamanager.next_train(step)
        inputs = model.step_inputs(camera, batch)
        if (result := self._recorded(model.state, inputs, model.render_settings(training=True))) is None:
            self._recorded = None
            return None
        model.exposure_compensation.observe(result.images["rgb"], inputs.target, inputs.mask, batch)
        self._step_schedulers()
        if step_check(step, self.config.logging.steps_per_log, run_at_zero=True):
            for name, scheduler in self.optimizers.schedulers.items():
                writer.put_scalar(f"learning_rate/{name}", scheduler.get_last_lr()[0], step)
        outputs = {**result.images, "background": inputs.background, "window": inputs.crop}
        return result.loss, result.losses, model.get_metrics_dict(outputs, batch)

    def _step_schedulers(self) -> None:
        # nerfstudio's method also writes every learning rate at every step, which takes longer than a captured step.
        for scheduler in self.optimizers.schedulers.values():
            scheduler.step()

    def _warn_if_long(self, number: int) -> None:
        """On a CPU, warn of a training of hours, by some steps; the first compiles, and the second warms up."""
        if number == 1:
            self._measured_from = time.perf_counter()
        elif number == 1 + TIMED_STEPS and self.config.machine.device_type == "cpu":
            seconds = (time.perf_counter() - self._measured_from) / TIMED_STEPS
            if (warning := long_on_cpu(seconds, self.last_step - self._start_step - number)) is not None:
                _log.warning(warning)

    def _stop(self) -> None:
        if self.ranks.count == 1:  # several stop together
            self._stopped_by = self._interruption.number
            self.stop_training = True

    def _after_train(self) -> None:
        """Save and report; a run that was stopped says how to resume, and exits with 130 (SIGINT) or 143 (SIGTERM)."""
        if self._trained is not None:
            self.step = self._trained  # nerfstudio has counted a step that it does not train
        if not self._stopped_by or self._trained == self.last_step:
            super()._after_train()
            return
        if self._trained is None:
            CONSOLE.print(NOTHING_SAVED)
        else:
            self.save_checkpoint(self.step)  # ranks leave after it, because one that leaves ends the others
            data, left = self.config.pipeline.datamanager.data, self.last_step - self.step
            command = resume_command(sys.argv, self.checkpoint_dir, str(self.config.method_name), data, left)
            CONSOLE.print("Stopped and saved. To train the remaining steps:")
            CONSOLE.print(f"    {command}", markup=False, highlight=False, soft_wrap=True)
        profiler.PROFILER.clear()  # else nerfstudio's table would hide the command
        raise SystemExit(128 + self._stopped_by)

    def _train_complete_viewer(self) -> None:
        """Show the finished scene until Ctrl-C."""
        if self._interruption.number:
            return
        self._interruption.restore()
        with contextlib.suppress(KeyboardInterrupt):
            super()._train_complete_viewer()

    def save_checkpoint(self, step: int) -> None:
        """Save model, optimizers, schedules and random state; only then remove older checkpoints."""
        with self.ranks.gathered() as first:
            if not first:
                return
            sums = [value.detach().flatten(1).sum(dim=1) for value in self.model.gauss_params.values()]
            if not bool(torch.stack(sums).isfinite().all(dim=0).any()):  # a save would replace a good checkpoint
                raise diverged(self.model.num_points)
            state = {
                "step": step,
                "pipeline": self.pipeline.state_dict(),
                "optimizers": {name: value.state_dict() for name, value in self.optimizers.optimizers.items()},
                "schedulers": {name: value.state_dict() for name, value in self.optimizers.schedulers.items()},
                "scalers": self.grad_scaler.state_dict(),
                "random": checkpoint.random_state(),
            }
            path = self.checkpoint_dir / f"step-{step:09d}.ckpt"
            checkpoint.write(state, path)
        if self.config.save_only_latest_checkpoint:
            for other in self.checkpoint_dir.glob("*.ckpt"):
                if other != path:
                    other.unlink(missing_ok=True)

    def _load_checkpoint(self) -> None:
        if (path := self._source()) is None:
            return
        loaded = checkpoint.read(path)
        remedy = "load it with the options that it was trained with"
        with reading(path, "a checkpoint that fits this run", CheckpointError, remedy=remedy):
            self.step = int(loaded["step"])  # else a run of no further step would be saved as step 0
            self._start_step = self.step + 1
            self.pipeline.load_pipeline(loaded["pipeline"], loaded["step"])
            self.optimizers.load_optimizers(loaded["optimizers"])
            if "schedulers" in loaded and self.config.load_scheduler:
                self.optimizers.load_schedulers(loaded["schedulers"])
            self.grad_scaler.load_state_dict(loaded["scalers"])
            if "random" in loaded:  # nerfstudio's own trainer saves none
                checkpoint.set_random_state(loaded["random"])
        _log.info(f"Resuming after step {loaded['step']} from {path}")
        outputs = self.pipeline.datamanager.train_dataparser_outputs
        warn_of_other_frame(path.parent.parent, outputs.dataparser_transform, outputs.dataparser_scale)

    def _source(self) -> Path | None:
        """The checkpoint to resume from; None for a new run."""
        saved, step = self.config.load_dir, self.config.load_step
        if saved is None:
            return self.config.load_checkpoint
        if step is not None:
            return checkpoint.folder_of(saved) / f"step-{step:09d}.ckpt"
        path, passed_over = checkpoint.newest_whole(saved)
        for line in passed_over:
            _log.warning(f"skipped a damaged checkpoint: {line}")
        return path
