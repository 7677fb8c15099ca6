"""A short fine-tune of a finished run with the packer's rounding in the loop.

Grids, bases and steps are fitted once before the first step, and the file is written with them. The model holds rounded
values, the ones that a reader decodes. Adam moves exact values beside them, by the gradients at the rounded ones (the
straight-through estimator of Bengio, Leonard and Courville, 2013). So losses and rasteriser do not know of rounding.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.optim import Optimizer

from sundae_ns.core.errors import BackendError, CheckpointError, ConfigError
from sundae_ns.cuda.kernels import naming_full_memory
from sundae_ns.io.pack.codecs import Codecs, estimated_bits
from sundae_ns.io.pack.config import PackConfig
from sundae_ns.io.pack.packed_scene import PackedScene, fit_scene
from sundae_ns.plugin.finished_runs import load_model, place
from sundae_ns.plugin.model import SundaeModel
from sundae_ns.rasterize.gsplat_kernels import Capacity
from sundae_ns.scene.optimise import optimise, rate_factor
from sundae_ns.scene.render import RenderSettings
from sundae_ns.train.graphed_step import StepRecordings
from sundae_ns.train.schedules import NETWORK_BETAS
from sundae_ns.train.step import StepInputs, StepResult

_log = logging.getLogger(__name__)

RATES = {
    "features_dc": 5e-4,
    "features_rest": 1e-4,
    "opacities": 1e-2,
    "scales": 1e-3,
    "quats": 2e-4,
    "features": 5e-4,
    "head": 2e-4,
}
"""Peak rates of Adam, about a fifth of the initial rates of a run. Positions are rounded once and fixed: at the end of
training they hardly move."""
RATE = 0.025
"""Loss for each bit per stored number: about what a bit less costs in quality at the steps of ``FINETUNED``."""


def finetune(
    run: Path,
    scene: PackedScene,
    config: PackConfig,
    steps: int,
    *,
    rate: float = RATE,
    data: Path | None = None,
    progress: Callable[[Tensor], object] | None = None,
) -> tuple[PackedScene, Codecs]:
    """Train the field and head of a run with the rounding of its pack in the loop. The run is only read.

    Args:
        run: folder of a run of sundae or splatfacto, or its ``config.yml``.
        scene: the same run, from ``api.packing.contents_of``.
        config: bits of the pack.
        steps: number of steps, at least 1.
        rate: added to the loss for each bit per stored number, of the field and of the head.
        data: the capture, if it has moved.
        progress: called after each step with its loss ``[]``, which the next step overwrites.

    Returns:
        The trained scene, and its codecs for ``storage.pack.write_fitted``.

    Raises:
        ConfigError: an option cannot work.
        CheckpointError: the run still densifies, or cannot be opened.
        DataError: its capture is missing, or cannot be used.
        MemoryExhaustedError: the GPU's memory is full.
    """
    if steps < 1:
        raise ConfigError(f"a fine-tune of {steps} steps changes nothing; give 1 or more")
    scene, codecs = fit_scene(scene, config)
    opened = load_model(run, data, split="val")
    pipeline, model = opened.pipeline, opened.model
    if model.state.densifying:
        raise CheckpointError(
            f"{run} was saved during densification; train it to its end, or pack it without a fine-tune"
        )
    place(model, scene.gaussians)
    # Rounded quaternions have length 1, and gradients refer to them.
    model.gauss_params["quats"].data = torch.nn.functional.normalize(model.gauss_params["quats"].data)
    for name, value in model.gauss_params.items():
        value.requires_grad_(name in codecs.gaussians)
    codecs = codecs.to(model.device)
    pipeline.train()
    weights = dict(model.head.named_parameters()) if model.head is not None and scene.head else {}
    gaussians = Through.of({name: model.gauss_params[name] for name in codecs.gaussians}, codecs.rounded)
    head = Through.of(weights, codecs.rounded_head)
    numbers = sum(value.numel() for value in (*gaussians.exact.values(), *head.exact.values()))
    optimizer = _optimizer(gaussians.exact, head.exact)
    tuned = TunedStep(model, codecs, (gaussians, head), optimizer, rate / numbers)

    def step(i: int) -> None:
        at = opened.steps + i
        if weights:
            model.step = at  # chooses the window of a large image
        camera, batch = pipeline.datamanager.next_train(at)
        result = tuned(model.step_inputs(camera, batch), model.render_settings(training=True))
        if progress is not None:
            progress(result.loss)

    generators = [torch.cuda.current_device()] if model.device.type == "cuda" else []
    with naming_full_memory(lambda: model.num_points), torch.random.fork_rng(generators):
        torch.manual_seed(opened.seed or 0)  # of random backgrounds
        optimise(step, {"pack": optimizer}, steps, lambda _, i: rate_factor(i, steps))
    source = {**scene.meta.get("source", {}), "finetuned": steps}
    trained = replace(
        scene,
        gaussians={name: gaussians.exact.get(name, value).detach().cpu() for name, value in scene.gaussians.items()},
        head={name: value.detach().cpu() for name, value in head.exact.items()},
        meta={**scene.meta, "source": source},
    )
    return trained, codecs.to(torch.device("cpu"))


def _optimizer(gaussians: Mapping[str, Tensor], head: Mapping[str, Tensor]) -> Optimizer:
    groups: list[dict[str, Any]] = [
        {"params": [value], "lr": RATES[name], "eps": 1e-15} for name, value in gaussians.items()
    ]
    if head:
        groups.append({"params": list(head.values()), "lr": RATES["head"], "eps": 1e-8, "betas": NETWORK_BETAS})
    on_cuda = next(iter(gaussians.values())).is_cuda
    if on_cuda:
        for group in groups:
            group["lr"] = torch.tensor(group["lr"], device=group["params"][0].device)
    return torch.optim.Adam(groups, fused=on_cuda, capturable=on_cuda)


class Through(NamedTuple):
    """Parameters of the model, which hold rounded values, and the exact values that are trained."""

    shown: Mapping[str, Tensor]
    exact: dict[str, Tensor]
    rounded: Callable[[Mapping[str, Tensor]], Mapping[str, Tensor]]

    @classmethod
    def of(
        cls, shown: Mapping[str, Tensor], rounded: Callable[[Mapping[str, Tensor]], Mapping[str, Tensor]]
    ) -> Through:
        """Start with the values of the parameters."""
        return cls(shown, {name: value.detach().clone().requires_grad_() for name, value in shown.items()}, rounded)

    @torch.no_grad()
    def show(self) -> None:
        """Round into the parameters in place, because recorded graphs read them there."""
        rounded = self.rounded(self.exact)
        for name, value in self.shown.items():
            value.copy_(rounded[name])

    @torch.no_grad()
    def set_gradients(self, at_rounded: Mapping[str, Tensor | None], of_rate: Mapping[str, Tensor | None]) -> None:
        """Set the gradients of the exact values: those at the rounded ones and those of the rate."""
        for name, value in self.exact.items():
            gradient, second = at_rounded.get(name), of_rate.get(name)
            if gradient is not None and name == "quats":
                # Rounding may have negated a quaternion, which is the same rotation.
                gradient = gradient * (value * self.shown[name]).sum(dim=1, keepdim=True).sign()
            if second is not None:
                gradient = second if gradient is None else gradient + second
            if gradient is not None and name == "features_rest":
                # Keep view-independent colours so: their coefficients cost next to nothing in the pack.
                gradient = gradient.masked_fill((value == 0).flatten(1).all(dim=1)[:, None, None], 0.0)
            value.grad = gradient


class TunedStep:
    """Steps of a fine-tune of the parts of a model, by an optimizer of their exact values; ``rate`` is for each bit."""

    def __init__(
        self, model: SundaeModel, codecs: Codecs, parts: tuple[Through, Through], optimizer: Optimizer, rate: float
    ) -> None:
        self._model, self._codecs, self._parts = model, codecs, parts
        self._optimizer, self._rate = optimizer, rate
        self._can_record = model.device.type == "cuda" and model.backend.name == "gsplat"
        self._recordings = StepRecordings()

    def __call__(self, inputs: StepInputs, settings: RenderSettings) -> StepResult:
        """Train on one image; ``torch.cuda.OutOfMemoryError`` if the GPU's memory is full."""
        if self._can_record:
            kind = (inputs.camera.width, inputs.camera.height, inputs.mask is not None)
            try:
                return self._recordings.run(self._run, inputs, settings, kind=kind)
            except BackendError as error:
                _log.warning("the fine-tune runs kernel by kernel, slower: %s", error)
                self._can_record = False
        return self._run(inputs, settings, None)

    def _run(self, inputs: StepInputs, settings: RenderSettings, capacity: Capacity | None) -> StepResult:
        """One step; all of its work is recorded."""
        for part in self._parts:
            part.show()
        loss, _, result = self._model.training_step(inputs, settings)
        self._set_gradients(loss)
        # torch's Adam reads this name: it changes nothing where it is 1.
        self._optimizer.found_inf = self._recordings.overflow(capacity)  # type: ignore[attr-defined]
        self._optimizer.step()
        return result

    def _set_gradients(self, loss: Tensor) -> None:
        gaussians, head = self._parts
        at_rounded = _gradients(loss, [part.shown for part in self._parts])
        of_rate: list[dict[str, Tensor | None]] = [{}, {}]
        if self._rate > 0:
            with torch.enable_grad():
                bits = estimated_bits(self._codecs, gaussians.exact, head.exact)
                total = self._rate * torch.stack(list(bits.values())).sum()
            of_rate = _gradients(total, [part.exact for part in self._parts])
        for part, gradients, others in zip(self._parts, at_rounded, of_rate, strict=True):
            part.set_gradients(gradients, others)


def _gradients(loss: Tensor, groups: list[Mapping[str, Tensor]]) -> list[dict[str, Tensor | None]]:
    """Gradients of a loss by the values of each group; None where it does not depend on them."""
    found = iter(torch.autograd.grad(loss, [value for group in groups for value in group.values()], allow_unused=True))
    return [{name: next(found) for name in group} for group in groups]
