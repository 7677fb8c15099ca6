"""The compiled backend against its oracle, the reference: values, gradients and statistics for densification.

Errors are the norm of the difference over the norm of the oracle. In float64 the two differ by rounding alone, so the
bounds are tight. In float32 each is compared with the oracle in float64, and must not be much farther from it than the
oracle in float32, whose figures are in ``test_steady.py``.
"""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
import torch
from hard_scenes import CASES, NEAR, Scene
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from sundae_ns.errors import BackendError
from sundae_ns.rasterization import Rasterization, blending_weights, rasterize, select_backend

CPU, REFERENCE = select_backend("cpu", "cpu"), select_backend("reference", "cpu")


def make_scene(n: int, channels: int = 3, seed: int = 0) -> Scene:
    """A scene before activation, in float32 numbers, so that both precisions render the same scene."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    return {
        "means": (uniform(n, 3) - 0.5) * 2 + torch.tensor([0.0, 0.0, 3.0]),
        "quats": torch.randn(n, 4, generator=generator),
        "scales": torch.log(0.02 + 0.1 * uniform(n, 3)),
        "opacities": 2 * torch.randn(n, generator=generator),
        "colors": uniform(n, channels),
    }


def make_view(width: int, height: int, dtype: torch.dtype) -> dict[str, Any]:
    """A rotated, off-axis camera, so that no term of a derivative vanishes."""
    focal = 1.2 * max(width, height)
    K = torch.tensor([[focal, 0, 0.45 * width], [0, 1.1 * focal, 0.55 * height], [0, 0, 1]])
    angle = torch.tensor([0.1, -0.2, 0.3])
    skew = torch.tensor([[0, -angle[2], angle[1]], [angle[2], 0, -angle[0]], [-angle[1], angle[0], 0]])
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.linalg.matrix_exp(skew)
    viewmat[:3, 3] = torch.tensor([0.5, 0.3, 0.1])
    return {"viewmat": viewmat.to(dtype), "K": K.to(dtype), "width": width, "height": height}


def render(scene: Scene, view: dict[str, Any], dtype: torch.dtype, backend: Any, **options: Any) -> dict[str, Tensor]:
    """Values, the gradients of a fixed random functional of all of them, and the statistics for densification."""
    leaves = {name: value.to(dtype, copy=True).requires_grad_() for name, value in scene.items()}
    ours = rasterize(
        leaves["means"],
        leaves["quats"],
        leaves["scales"].exp(),
        leaves["opacities"].sigmoid(),
        leaves["colors"],
        **{name: value.to(dtype) if isinstance(value, Tensor) else value for name, value in view.items()},
        **{"absgrad": True, "render_depth": True, "backend": backend, **options},
    )
    ours.info["means2d"].retain_grad()
    outputs = {"image": ours.colors, "alpha": ours.alpha}
    if ours.depth is not None:
        outputs["depth"] = ours.depth
    generator = torch.Generator().manual_seed(9)
    sum(
        (value * torch.randn(value.shape, generator=generator).to(dtype)).sum() for value in outputs.values()
    ).backward()
    found = {name: value.detach() for name, value in outputs.items()}
    found |= {f"d{name}": leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
    found |= {"means2d.grad": ours.info["means2d"].grad, "means2d.absgrad": ours.info["means2d"].absgrad}
    return found | {"radii": ours.radii}


def deviation(found: Tensor, exact: Tensor) -> float:
    assert found.shape == exact.shape
    return float((found.double() - exact.double()).norm()) / max(float(exact.double().norm()), 1e-6)


def compare(found: dict[str, Tensor], exact: dict[str, Tensor], values: float, gradients: float) -> None:
    assert found.keys() == exact.keys()
    errors = {name: deviation(found[name], exact[name]) for name in exact if name != "radii"}
    print({name: f"{error:.1e}" for name, error in errors.items()})
    for name, error in errors.items():
        assert torch.isfinite(found[name]).all(), name
        assert error <= (values if name in ("image", "alpha", "depth") else gradients), (name, error)


@pytest.fixture
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


# ------------------------------------------------------------------------------------------------------------ float64


@pytest.mark.parametrize(
    ("n", "width", "height", "channels", "options"),
    [
        (300, 48, 40, 3, {}),
        (300, 48, 40, 3, {"antialiased": True}),
        (300, 33, 9, 16, {"render_depth": False}),
        (300, 9, 33, 1, {"absgrad": False}),
        (60, 1, 1, 5, {"near_plane": 2.9}),
        (200, 17, 23, 9, {"far_plane": 3.1}),
        (0, 20, 20, 3, {}),
        (1, 20, 20, 4, {}),
    ],
    ids=["plain", "antialiased", "wide", "tall", "one pixel", "far plane", "none", "one"],
)
def test_float64_matches_the_oracle_up_to_rounding(
    n: int, width: int, height: int, channels: int, options: dict[str, Any]
) -> None:
    scene, view = make_scene(n, channels), make_view(width, height, torch.float64)
    if not options.get("absgrad", True):
        with pytest.raises(AttributeError):
            render(scene, view, torch.float64, CPU, **options)
        options = {}
    found, exact = (render(scene, view, torch.float64, backend, **options) for backend in (CPU, REFERENCE))
    assert torch.equal(found["radii"], exact["radii"])
    compare(found, exact, 1e-12, 1e-10)  # measured: 3.0e-15 and 1.6e-13


def test_gradcheck() -> None:
    """Against finite differences; the camera too, which uses the oracle's projection."""
    scene, view = make_scene(40, channels=2, seed=3), make_view(19, 18, torch.float64)
    scene["scales"][0], scene["opacities"][0] = 2.0, 30.0  # so wide and opaque that its alpha is clamped in every pixel
    viewmat = view.pop("viewmat").requires_grad_()
    leaves = [value.double().requires_grad_() for value in scene.values()]

    def outputs(viewmat: Tensor | None, *values: Tensor) -> tuple[Tensor, ...]:
        means, quats, scales, opacities, colors = values
        ours = rasterize(
            means,
            quats,
            scales.exp(),
            opacities.sigmoid(),
            colors,
            viewmat,
            **view,
            antialiased=True,
            render_depth=True,
            backend=CPU,
        )
        assert ours.depth is not None
        return ours.colors, ours.alpha, ours.depth

    check = {"eps": 1e-7, "atol": 1e-5, "rtol": 1e-4, "fast_mode": True}
    assert torch.autograd.gradcheck(outputs, (viewmat, *leaves), **check)
    assert torch.autograd.gradcheck(outputs, (viewmat.detach(), *leaves), **check)


def test_camera_that_is_optimised() -> None:
    scene, view = make_scene(100), make_view(24, 20, torch.float64)
    grads = []
    for backend in (CPU, REFERENCE):
        view["viewmat"] = view["viewmat"].detach().requires_grad_()
        leaves = {name: value.double() for name, value in scene.items()}
        ours = rasterize(
            leaves["means"],
            leaves["quats"],
            leaves["scales"].exp(),
            leaves["opacities"].sigmoid(),
            leaves["colors"],
            **view,
            backend=backend,
        )
        ours.colors.square().sum().backward()
        grads.append(view["viewmat"].grad)
    assert deviation(*grads) < 1e-10  # measured: 2.0e-15


@pytest.mark.parametrize("wanted", [("colors",), ("opacities",), ("means", "scales"), ("colors", "quats")])
def test_gradients_of_some_inputs_only(wanted: tuple[str, ...]) -> None:
    scene, view = make_scene(100), make_view(24, 20, torch.float64)
    grads = []
    for backend in (CPU, REFERENCE):
        leaves = {name: value.double() for name, value in scene.items()}
        leaves["scales"], leaves["opacities"] = leaves["scales"].exp(), leaves["opacities"].sigmoid()
        for name in wanted:
            leaves[name].requires_grad_()
        ours = rasterize(**leaves, **view, backend=backend)
        grads.append(torch.autograd.grad(ours.colors.square().sum(), [leaves[name] for name in wanted]))
    for found, exact in zip(*grads):
        assert deviation(found, exact) < 1e-10  # measured: 1.5e-14


def test_absgrad_of_repeated_backward_passes() -> None:
    scene, view = make_scene(50), make_view(20, 20, torch.float64)
    leaves = {name: value.double().requires_grad_() for name, value in scene.items()}
    leaves |= {"scales": leaves["scales"].exp(), "opacities": leaves["opacities"].sigmoid()}
    ours = rasterize(**leaves, **view, absgrad=True, backend=CPU)
    first = torch.autograd.grad(ours.colors.sum(), leaves["means"], retain_graph=True)[0]
    absolute = ours.info["means2d"].absgrad.clone()
    again = torch.autograd.grad(ours.colors.sum(), leaves["means"], retain_graph=True)[0]
    assert torch.equal(first, again)
    assert torch.equal(ours.info["means2d"].absgrad, absolute)


# ------------------------------------------------------------------------------------------------------------ float32


@pytest.mark.parametrize("antialiased", [False, True], ids=["plain", "antialiased"])
@pytest.mark.parametrize("name", CASES)
def test_hard_scenes(name: str, antialiased: bool) -> None:
    make, size, *bounds = CASES[name]
    scene = make()
    view = make_view(size, size, torch.float64)
    view["viewmat"] = torch.eye(4)  # so that primitives lie on the near plane in both precisions
    options = {"antialiased": antialiased, "near_plane": NEAR}
    exact = render(scene, view, torch.float64, REFERENCE, **options)
    double = render(scene, view, torch.float64, CPU, **options)
    assert torch.equal(double["radii"], exact["radii"])
    compare(double, exact, 1e-9, 1e-7)  # measured: 2.2e-12 and 1.9e-10, of needles; else 3.3e-15 and 2.9e-13
    compare(render(scene, view, torch.float32, CPU, **options), exact, *bounds)


def test_scales_that_vanish_and_centres_far_away_are_finite() -> None:
    scene, view = make_scene(40), make_view(20, 20, torch.float32)
    scene["scales"][:10] = math.log(1e-30)
    scene["means"][10:20] *= 1e6
    scene["means"][20:25] = 0.0
    for antialiased in (False, True):
        for name, value in render(scene, view, torch.float32, CPU, antialiased=antialiased).items():
            assert torch.isfinite(value).all(), name


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("scale", [1e9, 1e18, 1e30, math.inf, math.nan], ids=str)
def test_footprints_that_overflow_integers(dtype: torch.dtype, scale: float) -> None:
    """Wide primitives are rendered while their size is finite, and broken ones do not harm the others."""
    scene, view = make_scene(40), make_view(20, 20, dtype)
    scene["opacities"][:] = 0.0
    scene["scales"][:10] = math.log(scale) if scale > 0 else math.nan
    found = render(scene, view, dtype, CPU)
    for name, value in found.items():
        # The gradient behind the activation is NaN: zero times infinity.
        assert torch.isfinite(value[10:] if name == "dscales" else value).all(), name
    if scale <= 1e18:
        assert (found["radii"][:10] > 10**9 - 100).all()
        assert (found["alpha"] > 0.99).all()
    others = {name: value[10:] for name, value in scene.items()}
    if math.isnan(scale):
        assert torch.equal(found["alpha"], render(others, view, dtype, CPU)["alpha"])


@given(
    seed=st.integers(0, 2**32),
    n=st.integers(0, 60),
    width=st.integers(1, 40),
    height=st.integers(1, 40),
    channels=st.integers(1, 9),
    log_scale=st.floats(-9.0, 3.0),
    logit=st.floats(-8.0, 8.0),
    antialiased=st.booleans(),
)
def test_any_scene(
    seed: int, n: int, width: int, height: int, channels: int, log_scale: float, logit: float, antialiased: bool
) -> None:
    scene, view = make_scene(n, channels, seed), make_view(width, height, torch.float64)
    scene["scales"] += log_scale + 2.5
    scene["opacities"] += logit
    scene["means"][: n // 3, 2] -= 2.5  # near the camera, and behind it
    found, exact = (render(scene, view, torch.float64, b, antialiased=antialiased) for b in (CPU, REFERENCE))
    assert torch.equal(found["radii"], exact["radii"])
    compare(found, exact, 1e-9, 1e-7)
    geometry = {name: value.double() for name, value in scene.items() if name != "colors"}
    geometry |= {"scales": geometry["scales"].exp(), "opacities": geometry["opacities"].sigmoid()}
    weights = [blending_weights(**geometry, **view, antialiased=antialiased, backend=b) for b in (CPU, REFERENCE)]
    assert deviation(*weights) < 1e-9


# ---------------------------------------------------------------------------------------------------------- promises


def test_results_do_not_depend_on_the_number_of_threads(threads: None, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("backend._MIN_PER_THREAD", "tiles._MIN_PER_THREAD", "compositing._MIN_PER_THREAD_TO_SUM"):
        monkeypatch.setattr(f"sundae_ns.rasterization.cpu.{name}", 100)
    scene, view = make_scene(3000, channels=8), make_view(130, 70, torch.float32)
    results = []
    for count in (1, 2, 3, 7, 1):
        torch.set_num_threads(count)
        results.append(render(scene, view, torch.float32, CPU))
    for other in results[1:]:
        for name, value in results[0].items():
            assert torch.equal(value, other[name]), name


def test_threads_that_rasterise_at_once(threads: None) -> None:
    """A viewer renders beside a training run."""
    torch.set_num_threads(2)
    scene, view = make_scene(800), make_view(60, 50, torch.float32)
    alone = render(scene, view, torch.float32, CPU)
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda _: render(scene, view, torch.float32, CPU), range(12)))
    for other in together:
        for name, value in alone.items():
            assert torch.equal(value, other[name]), name


def test_ties_in_depth_are_broken_by_index() -> None:
    scene, view = make_scene(2000), make_view(40, 40, torch.float64)
    view["viewmat"] = torch.eye(4)
    scene["means"][:, 2] = torch.randint(2, 5, (2000,), generator=torch.Generator().manual_seed(0)).float()
    compare(
        *(render(scene, view, torch.float64, backend) for backend in (CPU, REFERENCE)), 1e-12, 1e-10
    )  # 3e-15, 1e-12


def test_layouts_that_are_not_contiguous() -> None:
    scene, view = make_scene(100, channels=4), make_view(24, 20, torch.float32)
    plain = {name: value.exp() if name == "scales" else value for name, value in scene.items()}
    plain["opacities"] = plain["opacities"].sigmoid()
    odd = {name: torch.stack([value, value], dim=-1)[..., 0] for name, value in plain.items()}
    odd["scales"] = plain["scales"].T.contiguous().T
    assert not odd["means"].is_contiguous()
    images: list[Rasterization] = [rasterize(**each, **view, backend=CPU) for each in (plain, odd)]
    assert torch.equal(images[0].colors, images[1].colors)


def test_unsupported_dtypes_are_refused() -> None:
    scene, view = make_scene(5), make_view(8, 8, torch.bfloat16)
    with pytest.raises(BackendError, match="float32 or float64 on a CPU, not torch.bfloat16") as caught:
        render(scene, view, torch.bfloat16, CPU)
    assert "\n" not in str(caught.value)


def test_a_forked_process_rasterises(threads: None) -> None:
    """Data loaders fork; numba's own thread pools would end such a process."""
    code = """
import os, sys, torch
from sundae_ns.rasterization import blending_weights, select_backend
torch.set_num_threads(2)
scene = torch.rand(2000, 3) + torch.tensor([-0.5, -0.5, 2]), torch.ones(2000, 4), 0.02 * torch.ones(2000, 3)
camera = torch.eye(4), torch.tensor([[90.0, 0, 40], [0, 90, 40], [0, 0, 1]]), 80, 80
def work():
    return blending_weights(*scene, torch.full((2000,), 0.5), *camera, backend=select_backend("auto", "cpu")).sum()
before = work()
child = os.fork()
if child == 0:
    torch.set_num_threads(2)
    from sundae_ns.rasterization.cpu import parallel
    parallel.torch.get_num_threads = lambda: 2  # torch's own pool does not survive a fork
    from sundae_ns.rasterization.cpu.tiles import _sort_by_tile
    import numpy as np
    done = np.zeros(1 << 16)
    parallel.parallel_for(lambda begin, end: done[begin:end].fill(1), 1 << 16)
    os._exit(0 if done.all() else 3)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=120).returncode == 0
