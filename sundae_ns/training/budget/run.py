"""The field under search: what held-back and training views say of it, and how it is cut and brought back."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import torch
from nerfstudio.engine.callbacks import TrainingCallbackAttributes
from nerfstudio.engine.optimizers import Optimizers
from torch import Tensor

from sundae_ns.datamanager import SundaeDatamanager
from sundae_ns.errors import DataError
from sundae_ns.evaluation import psnr
from sundae_ns.gaussians import FEATURES
from sundae_ns.gaussians.parameters import sh_degree
from sundae_ns.gaussians.snapshot import Snapshot, module_snapshot, restore, restore_module, snapshot
from sundae_ns.pruning import PruningConfig
from sundae_ns.pruning.bands import mean_basis
from sundae_ns.pruning.cutting import cut, drop_nonfinite
from sundae_ns.rasterization.harmonics import harmonic_basis
from sundae_ns.rendering.views import View
from sundae_ns.training.budget.search import NO_PICTURE
from sundae_ns.training.budget.sizes import bytes_of
from sundae_ns.training.schedulers import notify_pruned

if TYPE_CHECKING:
    from sundae_ns.model import SundaeModel
    from sundae_ns.trainer import SundaeTrainer

EXACT = 100.0
"""PSNR of a picture that is right to the last digit, dB; no camera's 8 bits tell more."""
MAX_VIEWS = 64
"""Training views, evenly chosen, that each scoring looks at: it is repeated at each cut."""


class Run(NamedTuple):
    """What a step of the search works on."""

    model: SundaeModel
    attributes: TrainingCallbackAttributes
    datamanager: SundaeDatamanager

    @classmethod
    def of(cls, model: SundaeModel, attributes: TrainingCallbackAttributes) -> Run:
        """The run of a callback."""
        assert attributes.pipeline is not None
        return cls(model, attributes, cast(SundaeDatamanager, attributes.pipeline.datamanager))

    @property
    def optimizers(self) -> Optimizers:
        """All of them."""
        assert self.attributes.optimizers is not None
        return self.attributes.optimizers

    @property
    def params(self) -> Any:
        """The field."""
        return self.model.gaussians

    @property
    def degree(self) -> int:
        """Of the field's harmonics."""
        return sh_degree(self.params["features_rest"])

    @property
    def bare(self) -> dict[str, Tensor]:
        """The field without features."""
        return {name: value for name, value in self.params.items() if name != FEATURES}

    @property
    def row(self) -> int:
        """Bytes of a primitive without features."""
        return bytes_of({name: value[:1] for name, value in self.bare.items()}, None)

    @property
    def steps_left(self) -> int:
        """Steps of training to come; where no trainer says so, those until the search has to end."""
        model, trainer = self.model, self.attributes.trainer
        if trainer is None:
            return model.config.pruning.stop - model.schedule_step
        return cast("SundaeTrainer", trainer).last_step - model.step

    # ------------------------------------------------------------------------------------------------------- views

    def weights(self, keep_ratio: float | None = None) -> Iterator[tuple[View, Tensor]]:
        """Some training views, evenly chosen, and the primitives' blending weights in each, but for masked pixels ``[N]``."""
        views = list(self.datamanager.training_views())
        stride = -(-len(views) // MAX_VIEWS)
        for camera, mask in views[::stride]:
            view = self.model.view_of(camera)
            yield view, self.model.weights_of(view, keep_ratio, mask=mask)

    @torch.no_grad()
    def contribution(self, keep_ratio: float | None = None) -> Tensor:
        """The sum of these weights ``[N]``."""
        total = torch.zeros(self.model.num_points, device=self.model.device)
        for _, weight in self.weights(keep_ratio):
            total += weight
        return total

    @torch.no_grad()
    def view_basis(self, degree: int) -> tuple[Tensor, Tensor]:
        """What the harmonics up to ``degree`` are on average over the views that see a primitive, and their products."""

        def weighted() -> Iterator[tuple[Tensor, Tensor]]:
            means = self.params["means"].data
            for view, weight in self.weights():
                directions = torch.nn.functional.normalize(means - view.center, dim=-1)
                yield weight, harmonic_basis(degree, directions)

        return mean_basis(weighted())

    @torch.no_grad()
    def measure(self) -> float:
        """Mean PSNR over the held-back views, dB, the head included where it takes part; always finite.

        Where a picture is not all numbers it is ``NO_PICTURE``, and of a view it is at most ``EXACT``. What a mask leaves
        out of training does not count.

        Raises:
            DataError: masks leave nothing.
        """
        model = self.model
        training = model.training
        model.eval()
        background = model._get_background_color()
        values = []
        for camera, batch in self.datamanager.holdout_views():
            pictures, _ = model.render(self.params, model.view_of(camera), background, depth=False)
            target = model.composite_with_background(model.get_gt_img(batch["image"]), background)
            picture = pictures["rgb"]
            if "mask" in batch:
                mask = batch["mask"].to(picture.device).squeeze(-1) > 0
                if not mask.any():
                    continue
                picture, target = picture[mask][None], target[mask][None]
            values.append(psnr(picture, target).clamp_max(EXACT))
        model.train(training)
        if not values:
            raise DataError(
                "masks leave nothing of the held-back views that judge; mend them, or hold back others with "
                "--pipeline.datamanager.holdout-every"
            )
        value = float(torch.stack(values).mean())
        return value if math.isfinite(value) else NO_PICTURE

    # ------------------------------------------------------------------------------------------------------- fields

    def drop_nonfinite(self) -> int:
        """Remove primitives with a NaN or infinite parameter; how many these were."""
        return drop_nonfinite(self.params, self.optimizers.optimizers, self.model.pruning_state)

    def cut_to(self, count: int, config: PruningConfig) -> int:
        """Keep ``count`` primitives, chosen as ``config`` says, or all that are finite if there are not so many.

        Returns:
            How many primitives have gone because they were not finite.

        Raises:
            DataError: the field cannot be scored.
        """
        step = self.model.schedule_step
        options = replace(config, seed=config.seed + step)

        def contribution() -> Tensor:
            return self.contribution(count / self.model.num_points if options.uses_detail else None)

        state, optimizers = self.model.pruning_state, self.optimizers.optimizers
        decision = cut(self.params, optimizers, state, options, contribution, step=step, count=lambda _: count)
        return decision.dropped_nonfinite

    def snapshot(self, *, head: bool) -> dict[str, Snapshot]:
        """Copies of the field, and of the head where it takes part, with what the optimizers know of them."""
        optimizers = self.optimizers.optimizers
        saved = {"field": snapshot(self.params, optimizers)}
        if head:
            assert self.model.head is not None
            saved["head"] = module_snapshot(self.model.head.parameters(), optimizers["compensation"])
        return saved

    def restore(self, saved: dict[str, Snapshot] | None) -> None:
        """Go back to a snapshot."""
        assert saved is not None
        optimizers = self.optimizers.optimizers
        restore(self.params, optimizers, saved["field"])
        if "head" in saved:
            assert self.model.head is not None
            restore_module(self.model.head.parameters(), optimizers["compensation"], saved["head"])
        # Whatever is kept per count of primitives is stale.
        self.model.pruning_state["num_prunes"] += 1

    def restart_rates(self, *, head: bool) -> None:
        """Restart the rates of the field, or those of the head."""
        schedulers = self.optimizers.schedulers
        restarted = {name: value for name, value in schedulers.items() if (name == "compensation") == head}
        notify_pruned(restarted, self.model.step)
