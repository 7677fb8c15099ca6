"""The state of a field in training, and what its callbacks (densification, pruning, trials) may do.

Nothing here knows nerfstudio.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypeAlias

import torch
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from sundae_ns.core.camera import Camera
from sundae_ns.core.gaussians import FEATURES, MAX_SH_DEGREE, Gaussians
from sundae_ns.core.surgery import Snapshot, module_snapshot, restore, restore_module, snapshot
from sundae_ns.head.head import CompensationHead
from sundae_ns.pruning.decision import Pruner
from sundae_ns.rasterize.types import Backend
from sundae_ns.scene.render import RenderSettings

HEAD = "compensation"  # Name of the head's optimizer, and of its group of parameters


@dataclass
class TrainingState:
    """Everything that training changes, and when it changes.

    Surgery (densification, prunes) replaces parameters in ``gaussians`` and ``optimizers``, and slices running states.
    """

    gaussians: Gaussians  # The Gaussians of this process
    networks: torch.nn.ModuleDict  # Holds the head, if there is one; registered by the model, so in checkpoints
    optimizers: Mapping[str, Optimizer] = field(default_factory=dict)
    """By parameter name; the head's is :data:`HEAD`."""
    schedulers: Mapping[str, LRScheduler] = field(default_factory=dict)
    """By the same names, where rates change."""
    densification: dict[str, Any] = field(default_factory=dict)
    """Running state of densification; tensors ``[N, ...]`` and plain numbers."""
    pruning: dict[str, Any] = field(default_factory=dict)  # Running state of pruning: plain integers
    info: dict[str, Any] = field(default_factory=dict)
    """What the rasteriser says of the last training image, with gradients after the backward pass."""
    trained_focal: tuple[float, float] | None = None  # Shortest and longest focal length that the head has seen, pixels

    step: int = 0  # Training step
    offset: int = 0  # Steps of the schedule that a warm start skips
    densify_until: int = 0  # Step of the schedule at which densification ends
    head_starts_at: float = math.inf  # Step of the schedule after which the head is enabled
    averages_from: float = math.inf  # Step at which the mean of the weights begins, with which the training ends
    provisional: bool = False  # Whether a trial is trained whose field may be dropped
    restored: int = 0  # Number of times in this process that other weights took the place of the trained ones
    harmonics_every: int = 1  # Steps from one that trains the harmonics beyond the base colours to the next
    sh_degree_interval: int | None = None  # Steps after which the next SH degree is enabled; None enables all at once

    @property
    def schedule_step(self) -> int:
        """Step of the schedule: a warm start begins where its warm-up would have ended."""
        return self.step + self.offset

    @property
    def device(self) -> torch.device:
        """Device of the field."""
        return self.gaussians["means"].device

    @property
    def pruner(self) -> Pruner:
        """Prunes the field together with its optimizers and the running state of densification."""
        return Pruner(self.gaussians, self.optimizers, [self.densification])

    @property
    def densifying(self) -> bool:
        """Whether the field still grows."""
        return self.schedule_step < self.densify_until

    @property
    def pruned(self) -> bool:
        """Whether Gaussians were pruned and the field has stopped growing."""
        return self.pruning.get("num_prunes", 0) > 0 and not self.densifying

    @property
    def head(self) -> CompensationHead | None:
        """The head; None if the field has none."""
        return self.networks["head"] if "head" in self.networks else None  # type: ignore[return-value]

    @property
    def head_enabled(self) -> bool:
        """Whether images get the head's correction at this step."""
        return self.head is not None and self.schedule_step > self.head_starts_at

    def remove_head(self) -> None:
        """Do without head and features from now on. Parameters stay the same objects, as optimizers need them."""
        if "head" in self.networks:
            del self.networks["head"]
        if FEATURES in self.gaussians:
            features = self.gaussians[FEATURES]
            features.data, features.grad = features.data[:, :0], None
        for name in {HEAD, FEATURES} & self.optimizers.keys():
            self.optimizers[name].state.clear()

    def widen_head(self, num_features: int) -> bool:
        """Give the head this width of features, with fresh weights; returns whether it had another."""
        assert self.head is not None
        if changes := self.head.config.num_features != num_features:
            self.head.resize(replace(self.head.config, num_features=num_features))
        return changes

    def render_settings(
        self, backend: Backend, *, antialiased: bool, training: bool, absgrad: bool = False
    ) -> RenderSettings:
        """Render settings at this step; ``absgrad`` says whether densification reads absolute gradients."""
        interval = self.sh_degree_interval
        return RenderSettings(
            backend=backend,
            active_sh_degree=MAX_SH_DEGREE if interval is None else self.step // max(interval, 1),
            antialiased=antialiased,
            training=training,
            absgrad=absgrad and training and self.densifying,
            fixed_harmonics=training and self.step % self.harmonics_every > 0,
            head=self.head if self.head_enabled else None,
            trained_focal=self.trained_focal,
        )

    def snapshot(self, *, head: bool) -> dict[str, Snapshot]:
        """Copy the field and the poses of cameras, and the head if asked for, with the states of their optimizers."""
        others = self.optimizers.keys() - self.gaussians.keys() - (set() if head else {HEAD})
        copies = {name: module_snapshot(self.optimizers[name]) for name in others}
        return {"field": snapshot(self.gaussians, self.optimizers), **copies}

    def restore(self, saved: Mapping[str, Snapshot]) -> None:
        """Restore a :meth:`snapshot`, with any number of Gaussians, and the width of its head."""
        self.restored += 1
        restore(self.gaussians, self.optimizers, saved["field"])
        if HEAD in saved:
            self.widen_head(self.gaussians[FEATURES].shape[1])
        for name in saved.keys() & self.optimizers.keys():
            restore_module(self.optimizers[name], saved[name])

    def load_running_states(self, saved: Mapping[str, Mapping[str, Any]]) -> None:
        """Load running states of a checkpoint; tensors move to the device of the field."""
        for name, running in (("densification", self.densification), ("pruning", self.pruning)):
            running.clear()
            running |= {k: v.to(self.device) if isinstance(v, Tensor) else v for k, v in saved[name].items()}


class Photo(NamedTuple):
    """A training view with its image."""

    camera: Camera
    target: Tensor  # The image over the background of the run, in [0, 1] [H, W, 3]
    mask: Tensor | None  # Pixels that count, bool [H, W]; None for all


TrainingRun: TypeAlias = Any  # A plugin.model.NerfstudioRun, which this floor cannot import; callbacks act on it


class Callback:
    """Base of the callbacks: every method does nothing. The model calls each on all callbacks in their order."""

    name: str  # Key of its state in checkpoints

    def before_training(self, run: TrainingRun) -> None:
        """Check options and warn, before the first step and after a checkpoint has been loaded."""

    def trains(self, state: TrainingState) -> bool:
        """Whether this step trains; training is paused if one callback answers no."""
        return True

    def before_backward(self, state: TrainingState) -> None:
        """Prepare ``state.info`` of a training image for the backward pass."""

    def needs_all(self, run: TrainingRun) -> bool:
        """Whether :meth:`after_step` must see the Gaussians of all ranks at this step; the same on all of them."""
        return False

    def after_step(self, run: TrainingRun) -> None:
        """Act after the optimizers' step. May replace parameters of the field."""

    def finish(self, run: TrainingRun) -> None:
        """Report after the last step."""

    def state_dict(self) -> dict[str, Any]:
        """Own state for a checkpoint, beside the running states of :class:`TrainingState`; plain values and tensors."""
        return {}

    def prepare_loading(self, state: TrainingState, saved: Mapping[str, Any]) -> None:
        """Give field and head the shapes that they have in a checkpoint with this state of the callback."""

    def load_state_dict(self, state: TrainingState, saved: Mapping[str, Any]) -> None:
        """Load the state of a checkpoint, after Gaussians and head were loaded."""
