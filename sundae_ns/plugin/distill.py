"""A small scene trained on the images of a full one: a prune, then steps on fresh virtual views. No photo is needed.

The full scene is the teacher: it renders the truth for any camera. So each step has a camera of its own, a given one
moved and turned a little, and the images of no camera are overfitted.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, cast
from zlib import crc32

import torch
from pytorch_msssim import SSIM
from torch.nn import Parameter

from sundae_ns.core.camera import Camera
from sundae_ns.core.errors import CheckpointError, reading
from sundae_ns.core.files import replacing
from sundae_ns.core.gaussians import FEATURES, Gaussians, sanitise
from sundae_ns.core.values import usual_defaults, whole
from sundae_ns.cuda.kernels import naming_full_memory
from sundae_ns.head.head import CompensationHead, HeadConfig, stored_bytes
from sundae_ns.plugin.model import SundaeModelConfig
from sundae_ns.plugin.optimizer_configs import RATES, optimise, rate_factor
from sundae_ns.scene.prune_scene import prune_with_mask
from sundae_ns.scene.render import GaussianSource
from sundae_ns.scene.scene import Scene, initial_features, measure, render, usable_cameras
from sundae_ns.scene.virtual_cameras import VIEWS, by_device, of_unit_size, resized, split, virtual_cameras
from sundae_ns.train.averaging import AVERAGED_EVERY, RunningMean, weights_of
from sundae_ns.train.choice import least_gain
from sundae_ns.train.graphed_step import RecordedStep
from sundae_ns.train.schedules import NETWORK_BETAS, fused_adam, network_groups, sparse_factor
from sundae_ns.train.state import HEAD, TrainingState
from sundae_ns.train.step import StepInputs, StepLosses, training_step

STEPS = {"cpu": 3000, "cuda": 8000}  # Steps by the device
SIDES = {"cpu": 128, "cuda": 512}  # Sides of the images by the device, pixels
LEVELS = (0.5, 0.25, 0.1)  # Shares of the levels of detail below the full one
LEVEL_STEPS = {"cpu": 300, "cuda": 4000}  # Steps of each by the device
CAMERAS, HELD_OUT = 256, 16  # Virtual cameras that the steps begin from, and most held-out cameras


class Distillation:
    """The training of a pruned scene on the images of a full one; arguments and errors as :func:`distill`.

    ``progress`` says whether the prune shows a progress bar.
    """

    @usual_defaults()
    @torch.no_grad()
    def __init__(
        self,
        scene: Scene,
        *,
        keep: float | None = None,
        count: int | None = None,
        cameras: Sequence[Camera] | None = None,
        steps: int | None = None,
        seed: int = 0,
        head: bool = True,
        size: int | None = None,
        progress: bool = False,
    ) -> None:
        steps = whole(by_device(STEPS, scene.device) if steps is None else steps, "steps")
        size = whole(by_device(SIDES, scene.device) if size is None else size, "size", most=1 << 14)
        seed = whole(seed, "seed", 0, 1 << 42)
        keep = 0.1 if keep is None and count is None else keep
        # Its own head, if it has one, corrects its images.
        teacher = dataclasses.replace(scene, gaussians=sanitise(scene.gaussians).gaussians)
        given = () if cameras is None else usable_cameras(cameras)
        trained, held_out = split(given)
        trained = trained or held_out or virtual_cameras(teacher, CAMERAS, seed=seed, size=size)
        held_out = held_out or virtual_cameras(teacher, HELD_OUT, seed=seed + 1, size=size)
        self._teacher, scaled, self._size = of_unit_size(teacher, [*trained, *held_out])
        self.cameras, self.held_out = scaled[: len(trained)], scaled[len(trained) :][:HELD_OUT]
        self.steps, self._seed = steps, seed  # Number of steps to train
        scored_by = self.cameras[: by_device(VIEWS, teacher.device)]
        cut = prune_with_mask(self._teacher, keep, count, scored_by, None, progress=progress, fit=False)
        tiny = {"size": "tiny", "pixel_unshuffle": 1, "num_features": 5} if teacher.device.type == "cpu" else {}
        self.state = self._start(cut.scene.gaussians, HeadConfig(mode="residual", **cast(Any, tiny)) if head else None)
        counts = [self._teacher.num_gaussians, self.state.gaussians.num_gaussians, len(self.cameras)]
        seen = [scene.means, *(matrix for camera in given for matrix in camera[:2])]
        checksum = crc32(b"".join(matrix.detach().cpu().numpy().tobytes() for matrix in seen))
        self._options = {"steps": steps, "seed": seed, "head": head, "counts": counts, "scene": checksum}
        self.step = 0  # Number of steps that were trained
        self.gain: float | None = None  # PSNR that the head gained in its trial, dB; None before it, and without one
        self._mean = RunningMean()
        self._losses = StepLosses(SundaeModelConfig(prior_after_prune=0.0), SSIM(data_range=1.0, channel=3), 0)
        self._settings = self._teacher.settings(head=False)
        self._recorded = RecordedStep(self._losses) if self._settings.backend.name == "gsplat" else None

    def _start(self, gaussians: Gaussians, head: HeadConfig | None) -> TrainingState:
        params = {name: value.detach().clone() for name, value in gaussians.items() if name != FEATURES}
        networks = torch.nn.ModuleDict()
        if head is not None:
            generator = torch.Generator().manual_seed(self._seed)
            params[FEATURES] = initial_features(params["features_dc"], head.num_features, generator)
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(self._seed)
                networks["head"] = CompensationHead(head).to(params["means"].device)
        trained = torch.nn.ParameterDict({name: Parameter(value) for name, value in params.items()})
        self._modules = torch.nn.ModuleDict({"gaussians": trained, "networks": networks})
        optimizers: dict[str, torch.optim.Optimizer] = {
            name: fused_adam([{"params": [value], "lr": RATES[name]}], eps=1e-15) for name, value in trained.items()
        }
        if head is not None:
            groups = network_groups(networks["head"].parameters(), 1e-3, weight_decay=0.15)
            optimizers[HEAD] = fused_adam(groups, eps=1e-8, betas=NETWORK_BETAS, decoupled_weight_decay=True)
        focals = [camera.focal for camera in self.cameras]
        return TrainingState(
            Gaussians(cast(Any, trained), gaussians.encoding),
            networks,
            optimizers,
            pruning={"num_prunes": 1},
            trained_focal=(min(focals), max(focals)),
        )

    @usual_defaults()
    def train(self, after_step: Callable[[int, int], object]) -> bool:
        """Decide on the head, if that is due, and train the steps that are left, until ``after_step`` returns False.

        It gets the number of steps so far and of all. Returns whether all steps were trained.
        """
        # Each of both trials, without and with a head, takes a tenth of the steps.
        trial = max(round(0.1 * self.steps), 1) if self.state.head is not None and self.gain is None else 0
        total = self.steps + 2 * trial

        def on_step(done: int) -> bool:
            self.step = done
            if self.steps - done < 0.1 * self.steps and done % AVERAGED_EVERY == 0:
                self._mean.count_in(weights_of(self.state))
            return after_step(2 * trial + done, total) is not False or done == self.steps

        with naming_full_memory(lambda: self.state.gaussians.num_gaussians):
            if trial and not self._try_head(trial, lambda done: after_step(done, total)):
                return False
            if not self._optimise(self.steps, self.step, on_step):
                return False
        self._mean.replace(weights_of(self.state))
        return True

    def _optimise(self, steps: int, first: int, on_step: Callable[[int], object]) -> bool:
        """Train; step ``i`` of ``steps`` is a function of both, so that a resumed training repeats it."""
        sparse = sparse_factor(self.state.gaussians.num_gaussians)

        def factor(name: str, i: int) -> float:
            if name == "means":
                return sparse * 0.01 ** (i / steps)
            return rate_factor(i, steps) if name == HEAD else 1.0

        for i in optimise(self.state.optimizers, steps, factor, first):
            self._train_step(i)
            if on_step(i + 1) is False:
                return False
        return True

    def _try_head(self, steps: int, on_step: Callable[[int], object]) -> bool:
        """Train without and with the head from the same start, and keep the head if it pays; False if interrupted."""
        state = self.state
        quality = list[float]()
        assert state.head is not None
        start = state.snapshot(head=True)
        for before, starts_at in ((0, math.inf), (steps, -math.inf)):
            state.head_starts_at = starts_at
            if not self._optimise(steps, 0, lambda done, before=before: on_step(before + done)):  # type: ignore[misc]
                return False
            quality.append(self.quality())
            state.restore(start)
        self.gain = quality[1] - quality[0]
        plain = {name: value for name, value in state.gaussians.items() if name != FEATURES}
        ratio = stored_bytes(state.gaussians, state.head.config) / stored_bytes(plain, None)
        if not self.gain >= least_gain(math.log2(ratio)):
            state.remove_head()
        return True

    def _train_step(self, i: int) -> None:
        state = self.state
        camera = self._camera(i)
        # A teacher of nerfstudio's model may have been trained over random backgrounds; the student sees the shown one.
        target = torch.no_grad()(render)(self._teacher, camera).rgb
        state.step = i + 1  # a head is enabled in the steps after its start
        inputs = StepInputs(camera, target, None, self._teacher.background)
        settings = state.render_settings(self._settings.backend, antialiased=self._teacher.antialiased, training=True)
        if self._recorded is not None and self._recorded(state, inputs, settings) is not None:
            return
        training_step(GaussianSource(state.gaussians), state, self._losses, inputs, settings)[0].backward()
        for optimizer in state.optimizers.values():
            optimizer.step()
            optimizer.zero_grad()

    def _camera(self, i: int) -> Camera:
        """A camera near a given one: 5% of its distance from the middle away, and turned by 0.06 radians (RMS)."""
        generator = torch.Generator().manual_seed((self._seed + 1) * 1_000_003 + i)
        camera = self.cameras[int(torch.randint(len(self.cameras), (1,), generator=generator))]
        shift = 0.05 * torch.randn(3, generator=generator) * float(camera.viewmat[:3, 3].norm())
        x, y, z = (0.1 * torch.randn(3, generator=generator) / 3).tolist()
        turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]))
        viewmat = camera.viewmat.clone()
        viewmat[:3] = turn.to(viewmat) @ viewmat[:3]
        viewmat[:3, 3] += shift.to(viewmat) / math.sqrt(3)
        return camera._replace(viewmat=viewmat, K=camera.K.detach())  # it may be a caller's parameter

    def scene(self) -> Scene:
        """The scene as it is now, at unit size if its source is no nerfstudio model."""
        state = self.state
        head = state.head if state.head_enabled else None
        names = [name for name in state.gaussians if name != FEATURES or head is not None]
        return dataclasses.replace(
            self._teacher,
            gaussians=Gaussians({name: state.gaussians[name].detach() for name in names}, state.gaussians.encoding),
            head=head,
            trained_focal=None if head is None else state.trained_focal,
        )

    def quality(self) -> float:
        """PSNR of the held-out views against the full scene's images, dB."""
        return measure(self.scene(), self._teacher, self.held_out).psnr

    def result(self) -> Scene:
        """The scene as it is now, in the coordinates of the full one."""
        scene = self.scene()
        return dataclasses.replace(scene, gaussians=resized(scene.gaussians, self._size))

    def save(self, path: Path) -> None:
        """Write what a resumed training needs, atomically."""
        content = {
            "options": self._options,
            "step": self.step,
            "gain": self.gain,
            "model": self._modules.state_dict(),
            "optimizers": {name: optimizer.state_dict() for name, optimizer in self.state.optimizers.items()},
            "mean": self._mean.state_dict(),
        }
        with replacing(path) as partial:
            torch.save(content, partial)

    def load(self, path: Path) -> None:
        """Continue from a file of :meth:`save`; ``CheckpointError`` if it is damaged, or of other options or scene."""
        state = self.state
        with reading(path, "a checkpoint of this scene and options", CheckpointError, remedy="remove it to start anew"):
            saved = torch.load(path, map_location=state.device, weights_only=True)
            if saved["options"] != self._options:
                raise ValueError("other cameras, options or another scene")
            self.step = int(saved["step"])
            self.gain = saved["gain"]
            if not any(name.startswith("networks.") for name in saved["model"]):
                state.remove_head()
            self._modules.load_state_dict(saved["model"])
            for name, optimizer in state.optimizers.items():
                optimizer.load_state_dict(saved["optimizers"][name])
            self._mean = RunningMean.of(saved["mean"], state.device)
        state.head_starts_at = -math.inf


def distill(
    scene: Scene,
    *,
    keep: float | None = None,
    count: int | None = None,
    cameras: Sequence[Camera] | None = None,
    steps: int | None = None,
    seed: int = 0,
    head: bool = True,
    size: int | None = None,
) -> Scene:
    """Prune a scene, and train what is left on the images of the full one. Needs no photos, but nerfstudio.

    Args:
        scene: of any program; it does not change.
        keep: share of the finite Gaussians to keep, in (0, 1]; by default 0.1.
        count: number of Gaussians to keep, in place of a share.
        cameras: cameras that the steps begin from. Every eighth is held out. By default they are virtual ones.
        steps: number of training steps, by default 8,000 on a GPU, 3,000 on a CPU; the trials of the head come before
            them.
        seed: of all random draws.
        head: whether to add a compensation head if the held-out views show that it pays.
        size: sides of the images of virtual cameras, pixels; by default 512 on a GPU, 128 on a CPU.

    Returns:
        The small scene, on the same device.

    Raises:
        ConfigError: an option is out of range.
        DataError: the scene cannot be seen.
        MemoryExhaustedError: the GPU's memory is full.

    >>> import torch, sundae_ns as sn
    >>> scene = sn.Scene.from_points(torch.rand(200, 3), torch.rand(200, 3))
    >>> sn.distill(scene, keep=0.5, cameras=sn.virtual_cameras(scene, 4, size=32), steps=4, head=False).num_gaussians
    100
    """
    made = Distillation(scene, keep=keep, count=count, cameras=cameras, steps=steps, seed=seed, head=head, size=size)
    made.train(lambda *_: True)
    return made.result()


def levels_of(
    scene: Scene, cameras: Sequence[Camera] = (), after_step: Callable[[int, int], object] = lambda *_: None
) -> Iterator[tuple[Scene, float]]:
    """The levels of detail below a scene, :data:`LEVELS`, and the PSNR of each on held-out cameras, dB.

    Each is pruned from the scene, and trained on the images of its base colours from ``cameras``, by default virtual
    ones; ``after_step`` as for :meth:`Distillation.train`.
    """
    side, plain = by_device(SIDES, scene.device), dataclasses.replace(scene, head=None)
    cameras = [camera.zoomed(min(1.0, side / max(camera.width, camera.height))) for camera in cameras]
    cameras = cameras or virtual_cameras(plain, CAMERAS, size=side)
    for share in LEVELS:
        made = Distillation(plain, keep=share, cameras=cameras, steps=by_device(LEVEL_STEPS, scene.device), head=False)
        made.train(after_step)
        yield made.result(), made.quality()
