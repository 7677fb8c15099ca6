"""A model on the CPU, of a field made in memory, and what trains and shows it without nerfstudio's trainer."""

from types import SimpleNamespace

import pytest
import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.engine.callbacks import TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.utils import writer
from nerfstudio.viewer.render_state_machine import RenderStateMachine

from sundae_ns.head.head import HeadConfig
from sundae_ns.plugin.model import SundaeModelConfig
from sundae_ns.plugin.optimizer_configs import FusedAdamConfig
from sundae_ns.train.pruning import PruningConfig


def _points(n=60):
    """The sparse cloud that models start from: places ``[n, 3]`` and colours in 0 to 255 ``[n, 3]``."""
    generator = torch.Generator().manual_seed(1)
    xyz = torch.randn(n, 3, generator=generator) * 0.5
    return xyz, torch.randint(0, 256, (n, 3), generator=generator, dtype=torch.uint8)


def _build(*, n=60, seed_points="some", head=None, pruning=None, metadata=None, **options):
    """Make a model of 60 Gaussians, or ``n``, that prunes half of them after step 3, with a tiny head."""
    small = {"mode": "residual", "size": "tiny", "num_features": 5, "pixel_unshuffle": 1}
    usual = {"sh_degree": 1, "sh_degree_interval": 1, "num_downscales": 0, "background_color": "random"}
    config = SundaeModelConfig(
        pruning=PruningConfig(**{"prune_at": 3, "keep_ratio": 0.5, **(pruning or {})}),
        head=HeadConfig(**{**small, **(head or {})}),
        camera_optimizer=CameraOptimizerConfig(mode="off"),
        **{**usual, "dense_start_views": 0, **options},
    )
    box = SceneBox(aabb=torch.tensor([[-1.0] * 3, [1.0] * 3]))
    seeds = _points(n) if isinstance(seed_points, str) else seed_points
    return config.setup(scene_box=box, num_train_data=4, metadata=metadata or {}, seed_points=seeds)


def _perturb(model):
    """Give the head an output, and move on to where it is enabled."""
    if model.head is not None:
        with torch.no_grad():
            for value in model.head.parameters():
                value += 0.05 * torch.randn(value.shape, generator=torch.Generator().manual_seed(value.numel()))
    model.step = 10
    return model


def _camera(width=40, height=32, shift=0.0):
    """Make a camera at a distance of 3 that looks at the Gaussians."""
    pose = torch.eye(4)[None, :3].clone()
    pose[0, :, 3] = torch.tensor([shift, 0.1, 3.0])
    return Cameras(pose, fx=30.0, fy=30.0, cx=width / 2, cy=height / 2, width=width, height=height)


class FakeDatamanager:
    """Three training cameras; no test views."""

    eval_dataset = None
    place = (0, 1)
    held_out_indices = ()
    train_indices = (0, 1, 2)
    mask = None  # Of each view
    hold_out = list  # Called with indices

    def cameras(self, indices):
        yield from ((_camera(shift=(-0.5, 0.0, 0.5)[index]), _batch()) for index in indices)

    def training_views(self):
        yield from ((_camera(shift=shift), self.mask) for shift in (-0.5, 0.0, 0.5))


def _batch(width=40, height=32, channels=3):
    """Make what the data manager gives for that camera: an image of noise ``[height, width, channels]``, uint8."""
    generator = torch.Generator().manual_seed(2)
    return {"image": torch.randint(0, 256, (height, width, channels), generator=generator, dtype=torch.uint8)}


class Training:
    """Steps a model as nerfstudio's trainer does, without one."""

    def __init__(self, model, trainer=None):
        self.model = model
        groups = model.get_param_groups()
        of_head = FusedAdamConfig(lr=5e-3, weight_decay=1.0, decoupled=True)
        kinds = dict.fromkeys(groups, FusedAdamConfig(lr=5e-3)) | {"compensation": of_head}
        self.optimizers = Optimizers({name: {"optimizer": kinds[name], "scheduler": None} for name in groups}, groups)
        pipeline = SimpleNamespace(datamanager=FakeDatamanager(), model=model)
        attributes = TrainingCallbackAttributes(self.optimizers, None, pipeline, trainer)
        self.callbacks = model.get_training_callbacks(attributes)

    @property
    def train_callbacks(self):
        """The extensions by name."""
        return {callback.name: callback for callback in self.model.train_callbacks}

    @property
    def run(self):
        """The run that nerfstudio's callbacks belong to."""
        return self.callbacks[-1].func.__self__

    def act(self, name, step):
        """Let one extension act after a step, and no other."""
        self.run_callbacks(TrainingCallbackLocation.BEFORE_TRAIN_ITERATION, step)
        self.run.act([self.train_callbacks[name]])

    def run_callbacks(self, location, step):
        for callback in self.callbacks:
            callback.run_callback_at_location(step, location=location)

    def step(self, step):
        self.model.train()
        self.run_callbacks(TrainingCallbackLocation.BEFORE_TRAIN_ITERATION, step)
        self.optimizers.zero_grad_all()
        outputs = self.model(_camera())
        losses = self.model.get_loss_dict(outputs, _batch(), self.model.get_metrics_dict(outputs, _batch()))
        torch.stack(list(losses.values())).sum().backward()
        self.optimizers.optimizer_step_all()
        self.run_callbacks(TrainingCallbackLocation.AFTER_TRAIN_ITERATION, step)
        return losses

    def live(self):
        """Whether model, optimizers and nerfstudio's own list hold the same tensors, with moments of their shape."""
        for name, value in self.model.gauss_params.items():
            (held,) = self.optimizers.optimizers[name].param_groups[0]["params"]
            moments = self.optimizers.optimizers[name].state[value]
            if held is not value or self.optimizers.parameters[name] != [value]:
                return False
            if moments and moments["exp_avg"].shape != value.shape:
                return False
        return True


def _fixture_of(function):
    """A fixture of the function's name that gives the function."""
    return pytest.fixture(name=function.__name__.removeprefix("_"))(lambda: function)


points, build, perturb, camera, batch = map(_fixture_of, (_points, _build, _perturb, _camera, _batch))


@pytest.fixture
def model():
    """A model whose head is enabled, for evaluation."""
    return _perturb(_build()).eval()


@pytest.fixture
def datamanager():
    return FakeDatamanager()


@pytest.fixture
def training_of():
    """Set up the training of a model, and of what stands for a trainer if need be, which then goes step by step."""
    return Training


@pytest.fixture(autouse=True)
def no_leftovers():
    yield
    writer.EVENT_STORAGE.clear()


def as_the_viewer(call):
    """What a function returns to a thread of the viewer."""
    found = []

    class Renderer(RenderStateMachine):
        def run(self):
            with torch.no_grad():
                found.append(call())

    thread = Renderer(None, 1.0, None)
    thread.start()
    thread.join()
    return found[0]
