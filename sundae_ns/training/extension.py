"""The protocol between training and its extensions: densification, pruning, trials."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from torch import Tensor

from sundae_ns.rendering.render import LocalField, RenderSettings, TrainingView
from sundae_ns.rendering.views import View
from sundae_ns.training.field_state import FieldState


class Photo(NamedTuple):
    """A training view with its image."""

    view: View
    target: Tensor
    """The image over the background of :attr:`TrainingRun.background`, in [0, 1] ``[H, W, 3]``."""
    mask: Tensor | None
    """Pixels that count, bool ``[H, W]``; None for all."""


class TrainingRun(Protocol):
    """What an extension may ask of the program that trains. nerfstudio's trainer stands behind it in ``ns-train``."""

    state: FieldState
    """The field in training."""
    source: LocalField
    """Where views get their primitives from."""
    background: Tensor
    """Background of images that are not trained on ``[3]``."""

    @property
    def settings(self) -> RenderSettings:
        """Settings of images that are not trained on, at this step."""

    @property
    def last_step(self) -> int | None:
        """Step at which training ends; None if no trainer says so."""

    @property
    def schedule_length(self) -> int | None:
        """Number of steps for which the schedule is made: at least those of the run; None if no trainer says so."""

    @property
    def images_per_step(self) -> int:
        """Number of images in a batch: the number of ranks. Each counts as a step."""

    @property
    def folder(self) -> Path | None:
        """Folder for records; None without one, and on every rank but the first."""

    @property
    def num_heldout(self) -> int:
        """Number of held-out training views."""

    def training_views(self) -> list[TrainingView]:
        """All training views."""

    def view_indices(self) -> list[int]:
        """Indices of these views."""

    def hold_out(self, indices: Iterable[int]) -> None:
        """Hold out these training views too, from the next step on, until the next call."""

    def heldout_views(self) -> Iterator[Photo]:
        """The held-out training views, loaded one at a time."""

    def photos(self) -> Iterator[Photo]:
        """All training views in full size; transparent pixels are masked."""

    def evaluate(self) -> dict[str, float]:
        """Mean ``psnr`` (dB) and ``ssim`` over all test views; empty without any."""

    def save(self) -> None:
        """Save a checkpoint, if there is a trainer."""

    def log_scalars(self, name: str, values: Mapping[str, float | int]) -> None:
        """Write numbers to the run's event file."""


class Extension:
    """Base of the extensions: every verb does nothing. The model calls each verb on all extensions in their order."""

    name: str
    """Key of its state in checkpoints."""

    def before_training(self, run: TrainingRun) -> None:
        """Check options and warn, before the first step and after a checkpoint has been loaded."""

    def trains(self, state: FieldState) -> bool:
        """Whether this step trains; training is paused if one extension answers no."""
        return True

    def before_backward(self, state: FieldState) -> None:
        """Prepare ``state.info`` of a training image for the backward pass."""

    def needs_all(self, run: TrainingRun) -> bool:
        """Whether :meth:`after_step` must see the primitives of all ranks at this step; the same on all of them."""
        return False

    def after_step(self, run: TrainingRun) -> None:
        """Act after the optimizers' step. May replace parameters of the field."""

    def finish(self, run: TrainingRun) -> None:
        """Report after the last step."""

    def state_dict(self) -> dict[str, Any]:
        """Own state for a checkpoint, beside the running states of :class:`FieldState`; plain values and tensors."""
        return {}

    def prepare_loading(self, state: FieldState, saved: Mapping[str, Any]) -> None:
        """Give field and head the shapes that they have in a checkpoint with this state of the extension."""

    def load_state_dict(self, state: FieldState, saved: Mapping[str, Any]) -> None:
        """Take over the state of a checkpoint, after field and head were loaded."""
