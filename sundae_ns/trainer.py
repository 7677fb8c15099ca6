"""nerfstudio's trainer, with saves that are whole, resuming that is exact, and faults that are said in one line.

The module path and the class names are written into every run's ``config.yml``: moving them breaks saved runs.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import torch
import yaml
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils.misc import step_check
from nerfstudio.utils.rich_utils import CONSOLE

from sundae_ns import distributed
from sundae_ns.datamanager import SundaeDatamanager, SundaeDatamanagerConfig
from sundae_ns.errors import CheckpointError, StorageError, SundaeError, out_of_memory
from sundae_ns.storage.atomic import write_text, writing
from sundae_ns.storage.runs import checkpoint


@dataclass
class SundaeTrainerConfig(TrainerConfig):
    """nerfstudio's configuration of a run, for the trainer of this module."""

    _target: type = field(default_factory=lambda: SundaeTrainer)

    def save_config(self) -> None:
        """Write ``config.yml`` into the run's folder, whole or not at all.

        Raises:
            StorageError: there is no room or no right to write.
            ConfigError: there are not so many GPUs, or several ranks cannot train with these options.
        """
        if self.machine.num_devices > 1:
            distributed.check_machine(self.machine.num_devices, self.machine.device_type)
            distributed.check_options(self)
        path = self.get_base_dir() / "config.yml"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StorageError(f"cannot make {path.parent} ({error.strerror}); choose another --output-dir") from error
        CONSOLE.log(f"Saving config to: {path}")
        write_text(path, yaml.dump(self))


class SundaeTrainer(Trainer):
    """Saves atomically, resumes from the newest whole checkpoint, and takes random numbers up where they were left."""

    config: SundaeTrainerConfig
    shards: distributed.Shards | None = None
    """The ranks that train together; None where there is one."""

    def __init__(self, config: SundaeTrainerConfig, local_rank: int = 0, world_size: int = 1) -> None:
        if world_size > 1:
            distributed.check_options(config)
            config = distributed.shorten(config, world_size)
            config.vis = distributed.without_viewer(config.vis)  # type: ignore[assignment]
            # A copy of all pictures on each GPU may take more than its shard.
            cast(SundaeDatamanagerConfig, config.pipeline.datamanager).cache_images = "cpu"
            CONSOLE.quiet = local_rank != 0
            if config.machine.device_type == "cuda":
                torch.cuda.set_device(local_rank)
        # A world of one to nerfstudio, whose pipeline would wrap the model in DDP: that breaks when primitives come and go.
        super().__init__(config, local_rank, world_size=1)
        self.ranks = world_size
        if world_size > 1:
            with writing(f"cannot make the run's folder {self.base_dir}"):
                self.base_dir.mkdir(parents=True, exist_ok=True)  # nerfstudio's own way fails where two make it at once

    @property
    def last_step(self) -> int:
        """The step at which this training ends."""
        return self._start_step + self.config.max_num_iterations - 1

    def setup_optimizers(self) -> Optimizers:
        """Optimizers of what this process holds, for batches of as many pictures as there are ranks."""
        if self.ranks == 1:
            return super().setup_optimizers()
        model, datamanager = self.pipeline.model, cast(SundaeDatamanager, self.pipeline.datamanager)
        self.shards = distributed.take_shard(model, self.config.machine.seed)
        model.share(self.shards, datamanager)
        datamanager.place = (self.shards.rank, self.ranks)
        optimizers = distributed.SharedOptimizers(self.config.optimizers.copy(), self.pipeline.get_param_groups())
        distributed.scale_rates(optimizers, model.gauss_params, self.ranks)
        return optimizers

    def eval_iteration(self, step: int) -> None:
        """nerfstudio's, of which every rank takes its part: the head has to look at the same scale on each."""
        every = ("steps_per_eval_batch", "steps_per_eval_image", "steps_per_eval_all_images")
        if self.shards is not None and any(step_check(step, getattr(self.config, name)) for name in every):
            self.shards.agree_on_focal(self.pipeline.model)
        super().eval_iteration(step)

    def train(self) -> None:
        """Train.

        Raises:
            StorageError: the run's folder cannot be written to any more.
            MemoryExhaustedError: the GPU's memory is full.
        """
        try:
            with writing(f"cannot write to the run's folder {self.base_dir}"):
                super().train()
        except torch.cuda.OutOfMemoryError as error:
            raise out_of_memory(error, getattr(self.pipeline.model, "num_points", 0)) from error

    def save_checkpoint(self, step: int) -> None:
        """Save model, optimizers, schedules and random state; older checkpoints go once the new one is on the disk.

        Where several ranks train, each has to call it; the first gathers, and writes what one process would.

        Raises:
            StorageError: no room or no right to write; what was there before is whole.
        """
        if self.shards is not None:
            self.shards.agree_on_focal(self.pipeline.model)
            self._compare_heads(self.shards)
        own = {
            "step": step,
            "pipeline": self.pipeline.state_dict(),
            "optimizers": {name: value.state_dict() for name, value in self.optimizers.optimizers.items()},
            "schedulers": {name: value.state_dict() for name, value in self.optimizers.schedulers.items()},
            "scalers": self.grad_scaler.state_dict(),
            "random": checkpoint.random_state(),
        }
        state: dict[str, Any] | None = own
        if self.shards is not None:
            state = distributed.whole_state(own, self.shards, list(self.pipeline.model.gauss_params))
        if state is None:
            return
        path = self.checkpoint_dir / f"step-{state['step']:09d}.ckpt"
        checkpoint.save(state, path)
        if self.config.save_only_latest_checkpoint:
            for other in self.checkpoint_dir.glob("*.ckpt"):
                if other != path:
                    other.unlink(missing_ok=True)

    def _compare_heads(self, shards: distributed.Shards) -> None:
        head = self.pipeline.model.head
        apart = 0.0 if head is None else shards.apart(head.parameters())
        if apart != 0 and shards.rank == 0:
            CONSOLE.print(
                f"[yellow]Warning: the heads of the ranks differ by up to {apart:.2g}, which is an error of ours; the first "
                "rank's is saved, and to resume from it makes them alike again"
            )

    def _load_checkpoint(self) -> None:
        path = self._source()
        if path is None:
            CONSOLE.print("No checkpoint to load: training from scratch.")
            return
        loaded = checkpoint.load(path)
        try:
            if self.shards is not None:
                names = list(self.pipeline.model.gauss_params)
                loaded = distributed.state_of_rank(loaded, self.shards.rank, self.ranks, names)
            self._restore(loaded)
        except SundaeError:
            raise
        except Exception as error:  # torch and nerfstudio raise many kinds; each means that the parts do not fit
            reason = " ".join(str(error).split()) or type(error).__name__
            raise CheckpointError(
                f"{path} does not fit this run ({reason}); load it with the options that it was trained with"
            ) from error
        CONSOLE.print(f"Going on after step {loaded['step']}, from {path}")

    def _source(self) -> Path | None:
        """The checkpoint to go on from, if any."""
        folder, step = self.config.load_dir, self.config.load_step
        if folder is None:
            return self.config.load_checkpoint
        if step is not None:
            return folder / f"step-{step:09d}.ckpt"
        path, passed_over = checkpoint.newest_whole(folder)
        for line in passed_over:
            CONSOLE.print(f"[yellow]Warning: passed over a checkpoint: {line}", highlight=False)
        return path

    def _restore(self, loaded: dict[str, Any]) -> None:
        self.step = int(loaded["step"])  # a run of no further step would else be saved as step 0, over this one
        self._start_step = self.step + 1
        self.pipeline.load_pipeline(loaded["pipeline"], loaded["step"])
        self.optimizers.load_optimizers(loaded["optimizers"])
        if "schedulers" in loaded and self.config.load_scheduler:
            self.optimizers.load_schedulers(loaded["schedulers"])
        self.grad_scaler.load_state_dict(loaded["scalers"])
        if "random" in loaded:  # nerfstudio's own trainer saves none
            checkpoint.set_random_state(loaded["random"])
        if self.shards is not None:
            self.shards.recount(self.pipeline.model.gaussians)
            torch.manual_seed(self.config.machine.seed + self._start_step * self.ranks + self.shards.rank)
