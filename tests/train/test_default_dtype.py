"""Training, pruning, graph and head give the same bits whatever torch's default dtype is."""

from types import SimpleNamespace

import photographed
import prunes
import pytest
import torch
from torch import Tensor

from sundae_ns.core.camera import Camera
from sundae_ns.graph.filters import high_pass
from sundae_ns.graph.graph import build_graph
from sundae_ns.head.head import CompensationHead, HeadConfig, training_crop
from sundae_ns.pruning.decision import prune_gaussians
from sundae_ns.pruning.rule import PruneRule, band_rule
from sundae_ns.train.densification import CappedStrategy, Densification
from sundae_ns.train.exposure import ExposureCompensation
from sundae_ns.train.graphed_step import RecordedStep
from sundae_ns.train.plane_sweep import Sweep
from sundae_ns.train.state import Photo
from sundae_ns.train.step import StepInputs

FIELD, IMAGE = prunes.gaussians(300), torch.rand(33, 40, 9, generator=torch.Generator().manual_seed(0))
POINTS, RUN = FIELD["means"], photographed.run_of(photographed.ring())
PHOTOS = [photographed.image_of(index) for index in range(photographed.COUNT)]
EYES = [torch.tensor([x, 0.2 * x, 4.0]) for x in (0.0, 0.3, 0.6)]
CAMERAS = [Camera.look_at(eye, torch.zeros(3), width=40, height=33) for eye in EYES]


def head():
    torch.manual_seed(0)
    net = CompensationHead(HeadConfig(size="tiny", num_features=5))
    crops = [torch.tensor(training_crop(700, 500, 9000, seed, mirror=True)) for seed in range(9)]
    return *net.parameters(), net(IMAGE[..., :3], IMAGE[..., :8], IMAGE[..., 8:]), *crops


def decisions():
    rules = (PruneRule(), PruneRule(selection="pairs"), band_rule(PruneRule(), 0.5))
    weights = torch.linspace(0, 1, 300, dtype=torch.float32)
    found = [prune_gaussians(FIELD, rule, 40, weights) for rule in rules]
    return [value for pruned in found for value in (pruned.decision.mask, *pruned.gaussians.values())]


def sweep():
    found = Sweep([Photo(camera, IMAGE[..., :3], None) for camera in CAMERAS], POINTS, 32)
    return [found.add(index) for index in range(3)] + list(found.points(1000))


def exposure():
    gains = ExposureCompensation(len(PHOTOS), "on")
    gains.before_training(RUN)
    for index, photo in enumerate(PHOTOS):
        gains.observe(photo, photo * (1 + index % 2), None, photographed.batch_of(index))
    photographed.update(gains, RUN)
    return [value for value in gains.state_dict().values() if isinstance(value, Tensor)]


def growth(model):
    """A step that splits Gaussians, and steps on buffers before and after it."""
    state, step = model.state, RecordedStep(model.losses, record=False)
    state.optimizers = {name: torch.optim.Adam([value]) for name, value in state.gaussians.items()}
    state.optimizers["compensation"] = torch.optim.Adam(model.head.parameters())
    strategy = CappedStrategy(grow_grad2d=1e-9, refine_start_iter=0, refine_every=2, grow_scale3d=1e-9)
    strategy.pause_refine_after_reset, state.densify_until = 0, 99
    inputs = StepInputs(CAMERAS[0], IMAGE[..., 3:6], None, IMAGE[0, 0, :3])
    settings = model.render_settings(training=True)
    densification = Densification(strategy)
    densification.initialize(state)
    for state.step in range(1, 4):
        torch.manual_seed(state.step)
        assert step(state, inputs, settings) is not None
        densification.after_step(SimpleNamespace(state=state))
    assert state.gaussians.num_gaussians > 60
    return state.gaussians.values()


MADE = {
    **{one.__name__: one for one in (head, decisions, sweep, exposure)},
    "graph": lambda: (build_graph(POINTS).weights, high_pass(build_graph(POINTS), POINTS)),
}


@pytest.mark.parametrize("name", [*MADE, "growth"])
def test_the_default_dtype_changes_nothing(name, build):
    results = []
    for dtype in (torch.float32, torch.float64):
        torch.manual_seed(0)
        model = build(background_color="black") if name == "growth" else None
        torch.set_default_dtype(dtype)
        results.append([*(MADE[name]() if model is None else growth(model))])
        torch.set_default_dtype(torch.float32)
    for value, other in zip(*results, strict=True):
        assert value.dtype == other.dtype
        assert torch.equal(value.nan_to_num(), other.nan_to_num())
