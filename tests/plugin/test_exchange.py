"""Two processes over gloo render, gather and prune one field as one process does; nothing that is seen stays behind.

``rank.py`` runs the checks of this file on each rank; the tests read their results.
"""

import math
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from fields import normal_field
from hypothesis import given
from hypothesis import strategies as st
from splat_inputs import geometry
from torch.nn import Parameter, ParameterDict

from sundae_ns.core.camera import Camera
from sundae_ns.core.gaussians import Gaussians
from sundae_ns.core.surgery import keep
from sundae_ns.head.head import CompensationHead, HeadConfig
from sundae_ns.plugin.distributed import BatchOptimizers, Ranks, ShardedSource, _summed
from sundae_ns.plugin.optimizer_configs import FusedAdamConfig
from sundae_ns.rasterize.interface import rasterize, select_backend
from sundae_ns.rasterize.reference import project
from sundae_ns.rasterize.types import Inputs
from sundae_ns.scene.render import GaussianSource, RenderSettings, may_be_seen
from sundae_ns.train.exposure import ExposureCompensation
from sundae_ns.train.state import Callback, TrainingState

REFERENCE = select_backend("reference", "cpu")
N, RANKS = 90, 2


def gaussians():
    made = normal_field(N, degree=2, features=5, seed=3, dtype=torch.float64)
    return {**made, "means": 0.6 * made["means"], "scales": 0.4 * made["scales"] - 1.8}


def gaussians_of(values, start=0, end=N):
    return Gaussians(ParameterDict({name: Parameter(value[start:end].clone()) for name, value in values.items()}))


def camera(rank, *, behind=False):
    """Cameras that differ in all: position, size and intrinsics."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([0.4 * rank, -0.1, 2.5])
    if behind:
        pose = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]).double()) @ pose
    width, height, focal = (40, 32, 35.0) if rank == 0 else (24, 48, 28.0)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(pose, K, width, height, focal)


def draw(source, camera):
    params = source.primitives(camera, RenderSettings(REFERENCE), features=True)
    shapes = params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid().squeeze(-1)
    colors = torch.cat([params["colors"], params["features"]], dim=1)
    shown = rasterize(Inputs(*shapes, colors, camera, absgrad=True, render_depth=True), backend=REFERENCE)
    if shown.info["means2d"].requires_grad:
        shown.info["means2d"].retain_grad()
    return shown


def loss_of(shown, rank):
    weights = torch.randn(shown.colors.shape, generator=torch.Generator().manual_seed(rank), dtype=torch.float64)
    return (shown.colors * weights).mean() + shown.depth.mean() + shown.alpha.square().mean()


def state_of(gaussians, **running):
    """A field in training whose moments say to which row they belong."""
    state = TrainingState(gaussians, torch.nn.ModuleDict(), densification=running, densify_until=10)
    state.pruning = {"pruned_at": -1, "num_prunes": 0, "peak": 0}
    state.optimizers = {}
    for name, value in gaussians.items():
        rows = torch.arange(len(value)).double().reshape(-1, *[1] * (value.ndim - 1)).expand_as(value).clone()
        state.optimizers[name] = torch.optim.Adam([value])
        state.optimizers[name].state[value] = {"step": torch.tensor(7.0), "exp_avg": rows, "exp_avg_sq": rows + 0.5}
    return state


def check_drawing(rank):
    """Images, gradients and statistics of two ranks are those of one process for both images."""
    for behind in (False, True):  # then rank 1 sees nothing, and takes part
        start, end = ((0, 60), (60, N))[rank]
        source = ShardedSource(gaussians_of(gaussians(), start, end))
        cameras = [camera(0), camera(1, behind=behind)]
        shown = draw(source, cameras[rank])
        assert (source.sizes, source.total) == ([60, 30], N)
        loss_of(shown, rank).backward()
        state = state_of(source.gaussians, grad2d=None, count=None, radii=None)
        state.info = {**shown.info, "radii": shown.radii[None]}
        source.count_views(state, absgrad=True)

        whole = GaussianSource(gaussians_of(gaussians()))
        both = [draw(whole, cam) for cam in cameras]
        (sum(loss_of(image, index) for index, image in enumerate(both)) / RANKS).backward()
        for image in ("colors", "depth", "alpha"):
            torch.testing.assert_close(getattr(shown, image), getattr(both[rank], image), rtol=0, atol=1e-14)
        for name, value in whole.gaussians.items():
            torch.testing.assert_close(source.gaussians[name].grad, value.grad[start:end], rtol=1e-10, atol=1e-14)
        norms, counts, radii = torch.zeros(3, N, dtype=torch.float64)
        for image, cam in zip(both, cameras):
            halves = torch.tensor([cam.width / 2, cam.height / 2]).double()
            # The mean of two losses has half the gradient of each, and statistics are of each.
            norms += (image.info["means2d"].absgrad[0] * halves * RANKS).norm(dim=-1) * (image.radii > 0)
            counts += image.radii > 0
            radii = radii.maximum(image.radii.double() / max(cam.width, cam.height))
        for name, expected in (("grad2d", norms), ("count", counts), ("radii", radii)):
            torch.testing.assert_close(state.densification[name], expected[start:end], rtol=1e-6, atol=1e-8)


class Halving(Callback):
    """Keeps every second Gaussian once."""

    name = "halving"
    done = False
    calls = 0

    def needs_all(self, run):
        return not self.done

    def after_step(self, run):
        self.calls += 1
        if not self.done:
            state, mask = run.state, torch.arange(N) % 2 == 0
            keep(state.gaussians.data, state.optimizers, [state.densification], mask)
            state.pruning["num_prunes"] = 1
        self.done = True

    def state_dict(self):
        return {"done": self.done}

    def load_state_dict(self, state, saved):
        self.done = saved["done"]


def shared(rank, state):
    ranks, optimizers = Ranks(rank, RANKS), SimpleNamespace(parameters={})
    model = SimpleNamespace(state=state, source=GaussianSource(state.gaussians), device="cpu")
    model.exposure_compensation = ExposureCompensation(3, "on")
    ranks.share(model, SimpleNamespace(rank=0), optimizers)
    assert model.exposure_compensation.total is _summed
    assert all(held[0] is state.gaussians[name] for name, held in optimizers.parameters.items())
    return ranks, model


def check_gathering(rank):
    """A prune by the first rank: rows move with their moments and statistics, in order; notes are shared."""
    values = gaussians() if rank == 0 else {name: value + 1 for name, value in gaussians().items()}
    state = state_of(gaussians_of(values), grad2d=torch.arange(N), radii=None, peak=40 + rank)
    ranks, model = shared(rank, state)
    assert model.source.sizes == [45, 45]
    state.trained_focal = (None, (30.0, 50.0))[rank]
    halving = Halving()
    ranks.after_step(halving, SimpleNamespace(state=state))
    assert (halving.done, halving.calls) == (True, 1)
    own = torch.arange(0, N, 2)[:22] if rank == 0 else torch.arange(0, N, 2)[22:]
    assert torch.equal(state.densification["grad2d"], own)
    for name, value in state.gaussians.items():
        assert torch.equal(value, gaussians()[name][own]), name
        moments = state.optimizers[name].state[value]
        assert torch.equal(moments["exp_avg"].flatten(1)[:, 0].long(), own)
        assert torch.equal(moments["exp_avg_sq"].flatten(1)[:, 0], own + 0.5)
        assert (float(moments["step"]), len(state.optimizers[name].state)) == (7, 1)
    assert (state.pruning["peak"], state.pruning["num_prunes"], state.trained_focal) == (81, 1, (30.0, 50.0))
    assert (model.source.total, model.source.sizes) == (45, [22, 23])
    with ranks.gathered() as first, ranks.gathered() as again:  # a save during a prune
        assert first == again == (rank == 0)
        assert model.source.total == (45 if first else 23)
        if first:
            assert torch.equal(state.gaussians["means"], gaussians()["means"][::2])


def check_an_empty_shard(rank):
    """Fewer Gaussians than ranks: a rank without any renders those of the other, and takes a step."""
    seen = int(draw(GaussianSource(gaussians_of(gaussians())), camera(0)).radii.argmax())
    state = state_of(gaussians_of(gaussians(), seen, seen + 1))
    _, model = shared(rank, state)
    assert model.source.sizes == [0, 1]
    shown, expected = draw(model.source, camera(0)), GaussianSource(gaussians_of(gaussians(), seen, seen + 1))
    loss_of(shown, 0).backward()
    loss_of(draw(expected, camera(0)), 0).backward()
    for name, value in state.gaussians.items():
        if rank == 1:  # both ranks have the same image, so the mean is that of one
            torch.testing.assert_close(value.grad, expected.gaussians[name].grad, rtol=1e-10, atol=1e-14)
        state.optimizers[name].step()


def check_optimizers(rank):
    """The head's gradients are averaged, Gaussians step by the scaled rate, and the groups keep their numbers."""
    torch.manual_seed(0)
    head = CompensationHead(HeadConfig(mode="residual", size="tiny")).to(memory_format=torch.channels_last)
    means = Parameter(torch.zeros(4, 3))
    config = {name: {"optimizer": FusedAdamConfig(lr=0.01), "scheduler": None} for name in ("compensation", "means")}
    optimizers = BatchOptimizers(config, {"compensation": list(head.parameters()), "means": [means]})
    gradients = []
    for value in head.parameters():
        gradients.append(torch.randn_like(value))
        value.grad = gradients[-1] * (0.5 if rank == 0 else 1.5)
    means.grad = torch.ones_like(means)
    optimizers.optimizer_scaler_step_some(torch.amp.GradScaler(enabled=False), list(config))
    for value, gradient in zip(head.parameters(), gradients):
        torch.testing.assert_close(value.grad, gradient)
    torch.testing.assert_close(means.detach(), torch.full_like(means, -0.01 * math.sqrt(RANKS)))
    (group,) = optimizers.optimizers["means"].param_groups
    assert (group["lr"], group["betas"]) == (0.01, (0.9, 0.999))


def checks(_):
    """The checks of each rank, in this order."""
    return {check.__name__: check for check in (check_drawing, check_gathering, check_an_empty_shard, check_optimizers)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory, run_ranks):
    """Results of two ranks that ran all checks, once for all tests."""
    folder = tmp_path_factory.mktemp("ranks")
    run_ranks(__file__, folder)
    return folder


@pytest.mark.parametrize("name", checks(Path()))
def test_two_ranks(folder, name, passed):
    passed(folder, name)


@given(seed=st.integers(0, 10**6), shape=st.sampled_from([(64, 48, 50.0, 32.0, 2.0), (300, 20, 20.0, -40.0, 6.0)]))
def test_all_rendered_gaussians_may_be_seen(seed, shape):
    """Centres all around a camera, some of them very near; sizes over four decades."""
    width, height, focal, cx, most = shape
    generator = torch.Generator().manual_seed(seed)
    means = torch.randn(4000, 3, generator=generator) * torch.rand(4000, 1, generator=generator).exp2().pow(3)
    means[:500, 2] *= 0.01
    quats, scales = torch.randn(4000, 4, generator=generator), torch.randn(4000, 3, generator=generator) * 1.5 - 3
    K = torch.tensor([[focal, 0.0, cx], [0.0, 1.5 * focal, height / 2], [0.0, 0.0, 1.0]])
    drawn = project(geometry(means, quats, scales.exp(), torch.eye(4), K, width, height)).radii > 0
    poses = torch.stack([torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])), torch.eye(4)])  # one looks away
    sizes = torch.tensor([[width, height]] * 2).float()
    unseen, seen = may_be_seen(means, scales.amax(dim=1).exp(), poses, K.expand(2, 3, 3), sizes)
    assert not (drawn & unseen).any()  # one camera does not affect the other
    assert not (drawn & ~seen).any()
    # Looser bounds would send the whole field; these Gaussians are far larger and nearer than those of a scene.
    assert 0 < seen.sum() < most * drawn.sum()


def test_nan_depth_is_not_seen():
    means = torch.tensor([[0.0, 0.0, 2.0], [torch.nan, 0.0, 2.0], [0.0, 0.0, torch.nan], [0.0, 0.0, 0.0]])
    pose, K, size = torch.eye(4)[None], torch.eye(3)[None], torch.full((1, 2), 10.0)
    (seen,) = may_be_seen(means, torch.full((4,), 0.1), pose, K, size)
    assert seen[0]
    assert not seen[2:].any()
