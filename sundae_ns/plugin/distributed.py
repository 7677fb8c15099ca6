"""Training on several GPUs: each rank holds a shard of the Gaussians and renders another image of each batch.

    step of R ranks      rank 0 | rank 1 | ...       a shard of consecutive rows each
      cull, colours      own shard, for the cameras of all ranks
      all_to_all         each camera's Gaussians go to its rank        <- the gradients go back
      render             own image, by the rasteriser of one GPU

A batch of R images counts as R steps: the first of them trains, the others only move clock and schedules. So options,
checkpoints and records mean the same on any number of GPUs. The first rank alone does everything else (prune,
evaluation, checkpoint), on all Gaussians, by the code of one GPU.

All ranks must call a function marked "Collective" together. ``docs/several_gpus.md`` describes the product.
"""

from __future__ import annotations

import contextlib
import copy
import logging
import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator
from itertools import pairwise
from types import FrameType
from typing import Any

import torch
import torch.distributed as dist
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor
from torch.distributed.nn.functional import all_to_all_single

from sundae_ns.core.camera import Camera
from sundae_ns.core.errors import NOTHING_SAVED, ConfigError, passed_on
from sundae_ns.core.gaussians import FEATURES, Gaussians
from sundae_ns.core.surgery import change_parameter, per_gaussian
from sundae_ns.scene.render import GaussianSource, RenderSettings, colors_from, may_be_seen
from sundae_ns.train.densification import COUNTED, STATISTICS, count_view, start_counting
from sundae_ns.train.state import HEAD, Callback, TrainingState

AGREED_EVERY = 16  # Batches from one question whether to stop to the next, as each waits for the GPU


def check_options(config: Any) -> None:
    """Raise ``ConfigError`` for the first option of a ``SundaeTrainerConfig`` that several ranks cannot use."""
    ranks, device = config.machine.num_devices, config.machine.device_type
    if device != "cuda":
        raise ConfigError(f"--machine.num-devices {ranks} needs GPUs, and --machine.device-type is {device}; give 1")
    if ranks > (gpus := torch.cuda.device_count()):
        raise ConfigError(f"--machine.num-devices is {ranks} and there are {gpus} GPUs; give {max(gpus, 1)}")
    model, pruning = config.pipeline.model, config.pipeline.model.pruning
    counted = pruning.max_gaussians is not None or pruning.target_gaussians is not None
    for name, given in (
        ("continuous pruning to a count or under a cap", pruning.mode == "continuous" and counted),
        ("a camera optimizer", model.camera_optimizer.mode != "off"),
        ("--mixed-precision", config.mixed_precision or config.use_grad_scaler),
    ):
        if given:
            raise ConfigError(f"{name} does not work on several GPUs; leave it out, or use --machine.num-devices 1")


def forward_signals() -> None:
    """Pass SIGINT and SIGTERM on to the ranks, which save and leave together, and wait for them."""

    def forward(number: int, frame: FrameType | None) -> None:
        if not (ranks := multiprocessing.active_children()):
            print(f"\n{NOTHING_SAVED}", file=sys.stderr)
            raise SystemExit(128 + number)
        passed_on.append(number)
        for process in ranks:
            with contextlib.suppress(OSError):
                # A terminal has sent SIGINT to all of them, and the second would make a rank leave at once.
                os.kill(process.pid or 0, signal.SIGTERM)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, forward)


# --------------------------------------------------------------------------------------------------------- the exchange


class ShardedSource(GaussianSource):
    """The shard of this rank. A render, of a training step only, is collective."""

    def __init__(self, gaussians: Gaussians) -> None:
        super().__init__(gaussians, replayable=False)
        self.sizes: list[int] = []  # Gaussians of each rank
        self._rows = torch.empty(0)  # Rows of the shard in the order in which they were sent [S]
        self._sent: list[int] = []  # Number of rows sent to each rank in the last step; the sum is S
        self._received: list[int] = []

    @property
    def total(self) -> int:
        """Number of Gaussians of all ranks, as of the last step."""
        return sum(self.sizes)

    def primitives(self, camera: Camera, settings: RenderSettings, *, features: bool) -> dict[str, Tensor]:
        """The Gaussians of all ranks that the camera of this rank may see; differentiable. Collective."""
        gaussians, names = self.gaussians, ["means", "quats", "scales", "opacities", *([FEATURES] if features else [])]
        centers, ranks = self._route(camera)
        # For all cameras at once: the backward pass fills one gradient for each parameter, not for each camera.
        going = {name: gaussians[name].index_select(0, self._rows) for name in [*names, "features_dc", "features_rest"]}
        seen_from = centers.index_select(0, ranks)
        rows = torch.cat([*(going[name] for name in names), colors_from(going, gaussians, seen_from, settings)], dim=1)
        arrived = rows.new_empty(sum(self._received), rows.shape[1])
        arrived = all_to_all_single(arrived, rows, self._received, self._sent)
        if arrived.requires_grad:  # the gradient of the mean loss of all images
            arrived.register_hook(lambda gradient: gradient / len(self._sent))
        return dict(zip([*names, "colors"], arrived.split([*(gaussians[name].shape[1] for name in names), 3], dim=1)))

    @torch.no_grad()
    def _route(self, camera: Camera) -> tuple[Tensor, Tensor]:
        """Find the rows to send; centres of all cameras ``[R, 3]``, and the camera of each row ``[S]``."""
        means, ranks = self.gaussians["means"], dist.get_world_size()
        size = means.new_tensor([camera.width, camera.height, len(means)])
        packed = torch.cat([camera.viewmat.flatten(), camera.K.flatten(), size])
        cameras = packed.new_empty(ranks * len(packed))
        dist.all_gather_into_tensor(cameras, packed)
        viewmats, Ks, sizes = cameras.view(ranks, -1).split([16, 9, 3], dim=1)
        viewmats, Ks = viewmats.reshape(-1, 4, 4), Ks.reshape(-1, 3, 3)
        visible = may_be_seen(means, self.gaussians["scales"].amax(dim=1).exp(), viewmats, Ks, sizes[:, :2])
        sent = visible.sum(dim=1)
        received = torch.empty_like(sent)
        dist.all_to_all_single(received, sent)
        numbers = torch.stack([sent, received, sizes[:, 2].long()])
        self._sent, self._received, self.sizes = numbers.tolist()  # waits for the GPU, once a step
        receiver, self._rows = torch.nonzero_static(visible, size=sum(self._sent)).unbind(dim=1)
        return torch.stack([camera._replace(viewmat=viewmat).center for viewmat in viewmats]), receiver

    @torch.no_grad()
    def count_views(self, state: TrainingState, *, absgrad: bool) -> None:
        """Return the statistics of a batch to the owners of the Gaussians, for densification. Collective."""
        info, running = state.info, state.densification
        if not state.densifying or info.get(COUNTED):
            return
        centres = info["means2d"]
        gradients = (centres.absgrad if absgrad else centres.grad)[0]
        view = {name: gradients.new_zeros(len(gradients)) for name in STATISTICS}
        count_view(view, gradients, info["radii"][0], info["width"], info["height"])
        returned = gradients.new_empty(sum(self._sent), 2)
        dist.all_to_all_single(returned, torch.stack([view["grad2d"], view["radii"]], 1), self._sent, self._received)
        start_counting(running, self.gaussians["means"])
        norms, shares = returned.to(running["grad2d"]).unbind(dim=1)
        running["grad2d"].index_add_(0, self._rows, norms)
        running["count"].index_add_(0, self._rows, (shares > 0).to(norms))
        if running.get("radii") is not None:
            running["radii"].scatter_reduce_(0, self._rows, shares, "amax")
        info[COUNTED] = True


# ------------------------------------------------------------------------------------------------------------- training


class BatchOptimizers(Optimizers):
    """nerfstudio's optimizers for batches of one image a rank.

    Adam of the Gaussians takes the learning rate times the root of the number of images, and its betas to that power
    (Zhao et al., "On Scaling Up 3D Gaussian Splatting Training", 2024); the numbers in the groups, which checkpoints
    hold, stay those of one image. The head, whose weights every image uses, keeps its own.
    """

    def optimizer_scaler_step_some(self, grad_scaler: Any, param_groups: list[str]) -> None:
        """Average the gradients of the head over the ranks, and step. Collective."""
        ranks = dist.get_world_size()
        if HEAD in param_groups:
            if gradients := [value.grad for value in self.parameters[HEAD] if value.grad is not None]:
                mean = _summed(torch.cat([gradient.flatten() for gradient in gradients])) / ranks
                for gradient, values in zip(gradients, mean.split([gradient.numel() for gradient in gradients])):
                    gradient.copy_(values.view_as(gradient))
        groups = [group for name in param_groups if name != HEAD for group in self.optimizers[name].param_groups]
        before = [{"lr": group["lr"], "betas": group["betas"]} for group in groups]
        for group in groups:
            group.update(lr=group["lr"] * ranks**0.5, betas=tuple(beta**ranks for beta in group["betas"]))
        super().optimizer_scaler_step_some(grad_scaler, param_groups)
        for group, numbers in zip(groups, before):
            group.update(numbers)


class Ranks:
    """The processes, of the default group, that train one scene. For a single one, all methods leave things alone."""

    def __init__(self, rank: int = 0, count: int = 1) -> None:
        self.rank, self.count = rank, count
        self._is_gathered = count == 1  # Whether the Gaussians are gathered now

    def configured(self, config: Any) -> Any:
        """A copy of a trainer's configuration without the viewer, which could show one shard only."""
        if self.count == 1:
            return config
        config = copy.deepcopy(config)
        config.vis = "tensorboard" if config.vis in ("viewer", "viewer_legacy") else config.vis.removeprefix("viewer+")
        CONSOLE.quiet = self.rank != 0
        if self.rank > 0:  # the first rank logs the same
            logging.getLogger("sundae_ns").setLevel(logging.ERROR)
        if config.machine.device_type == "cuda":
            torch.cuda.set_device(self.rank)
        return config

    def share(self, model: Any, datamanager: Any, optimizers: Optimizers) -> None:
        """Keep the shard of this rank of the model that the first rank has built or loaded. Collective."""
        if self.count == 1:
            return
        self._model, self._optimizers, self.sharded = model, optimizers, ShardedSource(model.state.gaussians)
        datamanager.rank = self.rank
        model.exposure_compensation.total = _summed
        self._scatter()

    def agreed(self, number: int, batch: int) -> int:
        """The signal after which all ranks stop with this batch; 0 for none. Collective where ranks ask."""
        if self.count == 1:
            return number
        if batch % AGREED_EVERY:
            return 0
        return int(_summed(torch.tensor(number, device=self._model.device), dist.ReduceOp.MAX))

    def after_step(self, callback: Callback, run: Any) -> None:
        """Let a callback act after a step, on the first rank alone if it needs all Gaussians. Collective."""
        if self._is_gathered or not callback.needs_all(run):
            callback.after_step(run)
            return
        with self.gathered() as first:
            if first:
                callback.after_step(run)
        saved = _announced(callback.state_dict())
        if not first:
            callback.load_state_dict(run.state, saved)
            callback.after_step(run)  # it is done; the rest, such as learning rates, follows on all ranks

    @contextlib.contextmanager
    def gathered(self) -> Iterator[bool]:
        """Gather the Gaussians on the first rank, and afterwards share what they have become. Collective.

        Yields:
            Whether this is the first rank, which acts; the others wait. An error of it ends the run.
        """
        if self._is_gathered:
            yield self.rank == 0
            return
        self._gather()
        self._is_gathered = True
        yield self.rank == 0
        self._is_gathered = False
        self._scatter()

    def _gather(self) -> None:
        state: TrainingState = self._model.state
        notes: list[Any] = [None] * self.count
        note = (state.gaussians.num_gaussians, state.densification.get("peak", 0), state.trained_focal)
        dist.all_gather_object(notes, note)
        self.sharded.sizes, peaks, spans = map(list, zip(*notes))
        state.pruning["peak"] = max(state.pruning["peak"], sum(peaks))
        if lows := [span for span in spans if span is not None]:
            state.trained_focal = min(low for low, _ in lows), max(high for _, high in lows)
        nothing = [0] * self.count
        received = self.sharded.sizes if self.rank == 0 else nothing
        self._change_rows([note[0], *nothing[1:]], received, waits=self.rank > 0)
        self._model.source = GaussianSource(state.gaussians)

    def _scatter(self) -> None:
        """Give each rank its rows of the first rank's Gaussians, and that rank's head and notes."""
        state: TrainingState = self._model.state
        total, pruning = _announced((state.gaussians.num_gaussians, dict(state.pruning)))
        state.pruning.update(pruning)
        bounds = [total * rank // self.count for rank in range(self.count + 1)]
        self.sharded.sizes, nothing = [end - start for start, end in pairwise(bounds)], [0] * self.count
        sent = self.sharded.sizes if self.rank == 0 else nothing
        self._change_rows(sent, [self.sharded.sizes[self.rank], *nothing[1:]])
        for value in [] if state.head is None else [*state.head.parameters(), *state.head.buffers()]:
            dist.broadcast(value.data, 0)
        self._model.source = self.sharded

    def _change_rows(self, sent: list[int], received: list[int], *, waits: bool = False) -> None:
        """Send rows of the tensors with one a Gaussian (parameters, moments, statistics), in an order that ranks share.

        This rank keeps the rows that it ``received`` from each rank; all of its own if it ``waits``.
        """
        state: TrainingState = self._model.state

        def change(rows: Tensor) -> Tensor:
            arrived = rows.new_empty(sum(received), *rows.shape[1:])
            dist.all_to_all_single(arrived, rows[: sum(sent)].contiguous(), received, sent)
            return rows if waits else arrived

        n, running = state.gaussians.num_gaussians, state.densification
        for name in list(state.gaussians):
            change_parameter(state.gaussians.data, state.optimizers, name, change)
            self._optimizers.parameters[name] = [state.gaussians[name]]
        running.update({key: change(value) for key, value in running.items() if per_gaussian(value, n)})


def _announced(value: Any) -> Any:
    """A plain value of the first rank, on every rank."""
    box = [value]
    dist.broadcast_object_list(box, src=0)
    return box[0]


def _summed(values: Tensor, how: Any = dist.ReduceOp.SUM) -> Tensor:
    """The sum, or another reduction, of the tensors of all ranks; in place. Collective."""
    dist.all_reduce(values, how)
    return values
