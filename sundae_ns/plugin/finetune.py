"""A short fine-tune of a finished run with the packer's rounding in the loop.

Grids, bases and steps are fitted once before the first step, and the file is written with them. The model holds rounded
values, the ones that a reader decodes. Adam moves exact values beside them, by the gradients at the rounded ones (the
straight-through estimator of Bengio, Leonard and Courville, 2013). So losses and rasteriser do not know of rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sundae_ns.core.errors import CheckpointError, ConfigError
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
from sundae_ns.train.step import StepInputs, StepResult, training_step

RATES = {"features_dc": 5e-4, "features_rest": 1e-4, "opacities": 1e-2, "scales": 1e-3}
RATES |= {"quats": 2e-4, "features": 5e-4, "head": 2e-4}
"""Peak rates of Adam, about a fifth of the initial rates of a run. Positions are rounded once and fixed: at the end of
training they hardly move."""
RATE = 0.025  # Loss for each bit per stored number: about what a bit less costs in quality at the steps of FINETUNED


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
    """Train the Gaussians and head of a run with the rounding of its pack in the loop. The run is only read.

    Args:
        run, data: as in :func:`load_model`, with its errors.
        scene: the same run, from ``scene.packing.contents_of``.
        config: bits of the pack.
        steps: number of steps, at least 1.
        rate: added to the loss for each bit per stored number.
        progress: called after each step with its loss ``[]``, which the next step overwrites.

    Returns:
        The trained scene, and its codecs for ``write_fitted``.

    Raises:
        CheckpointError: the run still densifies.
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
    training = RoundedTraining(model, codecs, rate, head=bool(scene.head))

    def step(i: int) -> None:
        at = opened.steps + i
        if training.head:
            model.step = at  # chooses the crop of a large image
        camera, batch = pipeline.datamanager.next_train(at)
        result = training.step(model.step_inputs(camera, batch), model.render_settings(training=True))
        if progress is not None:
            progress(result.loss)

    generators = [torch.cuda.current_device()] if model.device.type == "cuda" else []
    with naming_full_memory(lambda: model.num_points), torch.random.fork_rng(generators):
        torch.manual_seed(opened.seed or 0)  # of random backgrounds
        optimise(step, {"pack": training.optimizer}, steps, lambda _, i: rate_factor(i, steps))
    source = {**scene.meta.get("source", {}), "finetuned": steps}
    exact = {name: value.detach().cpu() for name, value in training.exact.items()}
    trained = replace(
        scene,
        gaussians={name: exact.get(name, value.detach().cpu()) for name, value in scene.gaussians.items()},
        head={name: exact[name] for name in training.head},
        meta={**scene.meta, "source": source},
    )
    return trained, codecs.to(torch.device("cpu"))


class RoundedTraining:
    """Adam on exact values, by gradients at the rounded values that the parameters of a model hold.

    The codecs are those of the model's scene, on its device; ``head`` says whether the pack has a head.
    """

    def __init__(self, model: SundaeModel, codecs: Codecs, rate: float, *, head: bool) -> None:
        self._model, self._codecs = model, codecs
        self.head = dict(model.head.named_parameters()) if head and model.head is not None else {}
        """Weights of the head by name; empty without one."""
        self.rounded = {name: model.gauss_params[name] for name in codecs.gaussians} | self.head
        """Parameters of the model by name."""
        self.exact = {name: value.detach().clone().requires_grad_() for name, value in self.rounded.items()}
        """The values that are trained, by the same names."""
        self._rate = rate / sum(value.numel() for value in self.exact.values())
        groups: list[dict[str, Any]] = [
            {"params": [self.exact[name]], "lr": RATES[name], "eps": 1e-15} for name in codecs.gaussians
        ]
        if self.head:
            weights = [self.exact[name] for name in self.head]
            groups.append({"params": weights, "lr": RATES["head"], "eps": 1e-8, "betas": NETWORK_BETAS})
        on_cuda = model.device.type == "cuda"
        if on_cuda:
            for group in groups:
                group["lr"] = torch.tensor(group["lr"], device=model.device)
        self.optimizer: Any = torch.optim.Adam(groups, fused=on_cuda, capturable=on_cuda)
        self._can_record = on_cuda and model.backend.name == "gsplat"
        self._recordings = StepRecordings()

    def step(self, inputs: StepInputs, settings: RenderSettings) -> StepResult:
        """Train on one image; ``torch.cuda.OutOfMemoryError`` if the GPU's memory is full."""
        kind = (inputs.camera.width, inputs.camera.height, inputs.mask is not None)
        result = self._recordings.run(self._run, inputs, settings, kind=kind) if self._can_record else None
        return self._run(inputs, settings, None) if result is None else result

    def _run(self, inputs: StepInputs, settings: RenderSettings, capacity: Capacity | None) -> StepResult:
        """One step; all of its work is recorded."""
        self._round()
        model = self._model
        loss, _, result = training_step(model.source, model.state, model.losses, inputs, settings)
        gradients = torch.autograd.grad(loss, list(self.rounded.values()), allow_unused=True)
        of_rate: tuple[Tensor | None, ...] = (None,) * len(self.exact)
        if self._rate > 0:
            with torch.enable_grad():
                gaussians, head = (
                    {name: self.exact[name] for name in names} for names in (self._codecs.gaussians, self.head)
                )
                bits = estimated_bits(self._codecs, gaussians, head)
                total = self._rate * torch.stack(list(bits.values())).sum()
            of_rate = torch.autograd.grad(total, list(self.exact.values()), allow_unused=True)
        for name, gradient, second in zip(self.exact, gradients, of_rate, strict=True):
            self.set_gradient(name, gradient, second)
        # torch's Adam reads this name: it changes nothing where it is 1.
        self.optimizer.found_inf = self._recordings.overflow(capacity)
        self.optimizer.step()
        return result

    @torch.no_grad()
    def _round(self) -> None:
        """Round into the parameters in place, because recorded graphs read them there."""
        gaussians = self._codecs.rounded({name: self.exact[name] for name in self._codecs.gaussians})
        head = self._codecs.rounded_head({name: self.exact[name] for name in self.head})
        for name, value in {**gaussians, **head}.items():
            self.rounded[name].copy_(value)

    @torch.no_grad()
    def set_gradient(self, name: str, gradient: Tensor | None, of_rate: Tensor | None) -> None:
        """Set the gradient of an exact value: that at the rounded one and that of the rate."""
        value = self.exact[name]
        if gradient is not None and name == "quats":
            # Rounding may have negated a quaternion, which is the same rotation.
            gradient = gradient * (value * self.rounded[name]).sum(dim=1, keepdim=True).sign()
        if of_rate is not None:
            gradient = of_rate if gradient is None else gradient + of_rate
        if gradient is not None and name == "features_rest":
            # Keep view-independent colours so: their coefficients cost next to nothing in the pack.
            gradient = gradient.masked_fill((value == 0).flatten(1).all(dim=1)[:, None, None], 0.0)
        value.grad = gradient
