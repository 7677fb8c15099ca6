"""Packs of finished runs: a fine-tune with the packer's rounding in the loop, and packs of a given size or quality.

Grids, bases and steps are fitted once before the first step, and the file is written with them. The model holds rounded
values, the ones that a reader decodes. Adam moves exact values beside them, by the gradients at the rounded ones (the
straight-through estimator of Bengio, Leonard and Courville, 2013). So losses and rasteriser do not know of rounding.

For a target one factor makes all steps coarser or finer, and a bisection finds it. The ratios between the steps come
from renderings: at the defaults, one bit less of any attribute costs about the same.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from sundae_ns.core.errors import CheckpointError, ConfigError
from sundae_ns.core.metrics import Quality, evaluate
from sundae_ns.core.values import usual_defaults
from sundae_ns.cuda.kernels import naming_full_memory
from sundae_ns.io.pack.codecs import Codecs, estimated_bits
from sundae_ns.io.pack.config import COARSEST, FINEST, FINETUNED, PackConfig, scaled
from sundae_ns.io.pack.packed_scene import PackedScene, fit_scene, pack_bytes
from sundae_ns.plugin.finished_runs import load_model, put_gaussians
from sundae_ns.plugin.model import SundaeModel
from sundae_ns.plugin.optimizer_configs import optimise, rate_factor
from sundae_ns.rasterize.gsplat_kernels import Capacity
from sundae_ns.scene.cameras import spread
from sundae_ns.scene.prune_scene import LEAST, largest
from sundae_ns.scene.render import RenderSettings
from sundae_ns.train.choice import GAIN_PER_DOUBLING
from sundae_ns.train.graphed_step import StepRecordings
from sundae_ns.train.schedules import NETWORK_BETAS
from sundae_ns.train.step import StepInputs, StepResult, training_step

RATES = {"features_dc": 5e-4, "features_rest": 1e-4, "opacities": 1e-2, "scales": 1e-3}
RATES |= {"quats": 2e-4, "features": 5e-4, "head": 2e-4}
"""Peak rates of Adam, about a fifth of the initial rates of a run. Positions are rounded once and fixed: at the end of
training they hardly move."""
Tuned = tuple[PackedScene, Codecs]
JUDGED, BISECTIONS = 8, 7  # Most test views on which a pack is measured, and packs between the limits of a search
LOSS_PER_BIT = 0.025  # Per stored number: about what a bit less costs in quality at the steps of FINETUNED


@usual_defaults()
def finetune(
    run: Path,
    scene: PackedScene,
    config: PackConfig,
    steps: int,
    *,
    data: Path | None = None,
    progress: Callable[[Tensor], object] = lambda _: None,
) -> Tuned:
    """Train the Gaussians and head of a run with the rounding of its pack in the loop. The run is only read.

    ``scene`` is the same run, from ``scene.packing.contents_of``; the trained one and its codecs are returned.
    ``config`` has the bits of the pack. ``progress`` gets the loss ``[]`` of each step, which the next one overwrites.
    Errors are those of :func:`load_model`, and a ``CheckpointError`` if the run still densifies, a ``ConfigError`` for
    fewer steps than 1.
    """
    if steps < 1:
        raise ConfigError(f"a fine-tune of {steps} steps changes nothing; give 1 or more")
    scene, codecs = fit_scene(scene, config)
    opened = load_model(run, data, split="val")
    pipeline, model = opened.pipeline, opened.model
    if model.state.densifying:
        raise CheckpointError(f"{run} was saved during densification; train it to its end, or leave out the fine-tune")
    put_gaussians(model, scene.gaussians)
    # Rounded quaternions have length 1, and gradients refer to them.
    model.gauss_params["quats"].data = torch.nn.functional.normalize(model.gauss_params["quats"].data)
    for name, value in model.gauss_params.items():
        value.requires_grad_(name in codecs.gaussians)
    codecs = codecs.to(model.device)
    pipeline.train()
    training = RoundedTraining(model, codecs, head=bool(scene.head))
    generators = [torch.cuda.current_device()] if model.device.type == "cuda" else []
    with naming_full_memory(lambda: model.num_points), torch.random.fork_rng(generators):
        torch.manual_seed(opened.seed or 0)  # of random backgrounds
        for i in optimise({"pack": training.optimizer}, steps, lambda _, i: rate_factor(i, steps)):
            at = opened.steps + i
            if training.head:
                model.step = at  # chooses the crop of a large image
            camera, batch = pipeline.datamanager.next_train(at)
            settings = replace(model.render_settings(training=True), drop_rate=0.0)
            progress(training.step(model.step_inputs(camera, batch), settings).loss)
    exact = {name: value.detach().cpu() for name, value in training.exact.items()}
    trained = replace(
        scene,
        gaussians={name: exact.get(name, value.detach().cpu()) for name, value in scene.gaussians.items()},
        head={name: exact[name] for name in training.head},
        meta={**scene.meta, "source": {**scene.meta.get("source", {}), "finetuned": steps}},
    )
    return trained, codecs.to(torch.device("cpu"))


def finetune_within(run: Path, scene: PackedScene, steps: int, most: int | None, **options: Any) -> Tuned:
    """As :func:`finetune` with the usual bits; again with others if those take more than ``most`` bytes, or fewer."""
    first = finetune(run, scene, FINETUNED, steps, **options)
    if most is None or LEAST * most <= len(pack_bytes(*first)[0]) <= most:
        return first
    power = largest(float, lambda power: pack_at(first[0], FINETUNED, power).bytes, most)
    again = finetune(run, scene, scaled(FINETUNED, power), steps, **options)
    pack = largest(partial(pack_at, *again), lambda pack: pack.bytes, most)
    return pack.scene, pack.codecs


class RoundedTraining:
    """Adam on exact values, by gradients at the rounded values that the parameters of a model hold.

    The codecs are those of the model's scene, on its device; ``head`` says whether the pack has a head.
    """

    def __init__(self, model: SundaeModel, codecs: Codecs, *, head: bool) -> None:
        self._model, self._codecs = model, codecs
        # Weights of the head, parameters of the model, and the values that are trained, by the same names
        self.head = dict(model.head.named_parameters()) if head and model.head is not None else {}
        self.rounded = {name: model.gauss_params[name] for name in codecs.gaussians} | self.head
        self.exact = {name: value.detach().clone().requires_grad_() for name, value in self.rounded.items()}
        self._loss_per_bit = LOSS_PER_BIT / sum(value.numel() for value in self.exact.values())
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
        gaussians = {name: self.exact[name] for name in self._codecs.gaussians}
        head = {name: self.exact[name] for name in self.head}
        with torch.no_grad():  # rounded in place, because recorded graphs read the parameters there
            for name, value in (self._codecs.rounded(gaussians) | self._codecs.rounded_head(head)).items():
                self.rounded[name].copy_(value)
        model = self._model
        loss, _, result = training_step(model.source, model.state, model.losses, inputs, settings)
        gradients = torch.autograd.grad(loss, list(self.rounded.values()), allow_unused=True)
        with torch.enable_grad():
            total = self._loss_per_bit * torch.stack(list(estimated_bits(self._codecs, gaussians, head).values())).sum()
        of_rate = torch.autograd.grad(total, list(self.exact.values()), allow_unused=True)
        for name, gradient, second in zip(self.exact, gradients, of_rate, strict=True):
            self.set_gradient(name, gradient, second)
        # torch's Adam reads this name: it changes nothing where it is 1.
        self.optimizer.found_inf = self._recordings.overflow(capacity)
        self.optimizer.step()
        return result

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


# --------------------------------------------------------------------------------------------------------- targets


class Judge:
    """Measures a run, and packs of it, on some of its test views; arguments and errors as :func:`load_model`."""

    def __init__(self, run: Path, data: Path | None) -> None:
        opened = load_model(run, data)
        chosen = spread(len(opened.cameras), JUDGED)
        self._model = opened.model
        self.cameras, self.all_cameras = len(chosen), len(opened.cameras)  # Numbers of views: measured, and all
        self._cameras, self._truths = [opened.cameras[i] for i in chosen], [opened.truths[i] for i in chosen]
        self.before = self._quality()  # Of the run itself

    def quality(self, scene: PackedScene, codecs: Codecs) -> Quality:
        """Quality of a pack."""
        put_gaussians(self._model, codecs.rounded(scene.gaussians))
        if self._model.head is not None and scene.head:
            self._model.head.load_state_dict(codecs.rounded_head(scene.head))
        return self._quality()

    def _quality(self) -> Quality:
        return evaluate(lambda camera: self._model.get_outputs_for_camera(camera)["rgb"], self._cameras, self._truths)


def is_worth(psnr: float, size: int, other_psnr: float, other_size: int) -> bool:
    """Whether a pack of ``size`` bytes is worth more than another, by the PSNR that trials ask for a doubling."""
    return psnr >= other_psnr + GAIN_PER_DOUBLING * math.log2(size / other_size)


class Candidate(NamedTuple):
    """One pack of the search."""

    scene: PackedScene
    codecs: Codecs
    bytes: int


def pack_at(scene: PackedScene, fit: PackConfig | Codecs, power: float) -> Candidate:
    """The pack of a scene at a factor of 2^power, with ``fit`` as of :class:`Search`."""
    if isinstance(fit, PackConfig):
        scene, codecs = fit_scene(scene, scaled(fit, power))
    else:
        config = scaled(fit.config, power, with_positions=False)
        codecs = fit.with_steps(config, scene.gaussians, scene.head) if power else fit
    return Candidate(scene, codecs, len(pack_bytes(scene, codecs)[0]))


class Search:
    """Packs of one scene at several factors, judged by the run's test views; ``ConfigError`` if none meets a limit.

    ``fit`` has the options at the factor 1, or the codecs of a fine-tune, whose grids and bases no factor changes.
    """

    def __init__(self, scene: PackedScene, fit: PackConfig | Codecs, judge: Callable[[], Judge]) -> None:
        self._at, self._judge = partial(pack_at, scene, fit), judge
        self.default = self._at(0.0)  # The pack at the factor 1; of a fine-tuned scene, the one that was trained

    def drop(self, candidate: Candidate) -> float:
        """PSNR of a pack below the run's on some test views, dB; infinite for images that are not finite."""
        judge = self._judge()
        drop = judge.before.psnr - judge.quality(candidate.scene, candidate.codecs).psnr
        return drop if math.isfinite(drop) else math.inf

    def better_than(self, limit: float) -> Candidate:
        """The coarsest pack that loses at most ``limit`` dB, no larger than that at the factor 1 if this one fits."""
        first, last, best = 0.0, COARSEST, self.default
        if self.drop(best) > limit:
            first, last, best = FINEST, 0.0, self._at(FINEST)
            if (drop := self.drop(best)) > limit:
                loss = f"the finest pack loses {drop:.3f} dB at {best.bytes:,} bytes"
                raise ConfigError(f"{loss}; give a larger --target-drop")
        for _ in range(BISECTIONS):
            middle = (first + last) / 2
            candidate = self._at(middle)
            if self.drop(candidate) <= limit:
                first, best = middle, candidate
            else:
                last = middle
        return self.default if first >= 0 and self.default.bytes <= best.bytes else best


def best_pack(searches: Sequence[Search], most_drop: float) -> Candidate:
    """The smallest pack that loses at most ``most_drop`` dB, of searches of one run; ``ConfigError`` if none does."""
    packs, failures = list[Candidate](), list[ConfigError]()
    for search in reversed(searches):
        try:
            packs.append(search.better_than(most_drop))
        except ConfigError as error:
            failures.append(error)
    if not packs:
        raise failures[-1]
    return min(packs, key=lambda pack: pack.bytes)
