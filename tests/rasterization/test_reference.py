"""The reference rasteriser against a per-pixel loop, finite differences and invariants; and extreme scenes."""

from __future__ import annotations

import math

import pytest
import torch
from splat_inputs import geometry
from torch import Tensor

from sundae_ns.rasterization import Rasterization, blending_weights, rasterize, select_backend, spherical_harmonics
from sundae_ns.rasterization.reference import project

REFERENCE = select_backend("reference", "cpu")
NAMES = ("means", "quats", "scales", "opacities", "colors")


def _scene(n: int, channels: int = 3, dtype: torch.dtype = torch.float64, seed: int = 0) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    scene = {
        "means": (uniform(n, 3) - 0.5) * 2 + torch.tensor([0.0, 0.0, 3.0]),
        "quats": torch.randn(n, 4, generator=generator, dtype=torch.float64),
        "scales": 0.02 + 0.15 * uniform(n, 3),
        "opacities": uniform(n) ** 0.5,  # many near one, so that clamping and stopping both happen
        "colors": uniform(n, channels),
    }
    return {name: value.to(dtype) for name, value in scene.items()}


def _view(width: int, height: int, dtype: torch.dtype = torch.float64) -> dict:
    focal = 1.2 * max(width, height)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=dtype)
    return {"viewmat": torch.eye(4, dtype=dtype), "K": K, "width": width, "height": height, "backend": REFERENCE}


def _add_wall(scene: dict[str, Tensor]) -> None:
    """Make the first primitive so wide and opaque that its alpha is clamped in every pixel."""
    scene["scales"][0] = 50.0
    scene["opacities"][0] = 1.0


def _leaves(scene: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.clone().requires_grad_() for name, value in scene.items()}


def _oracle(
    scene: dict[str, Tensor], view: dict, *, antialiased: bool = False
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Blend pixel by pixel in a Python loop; also the weights, and z blended like a colour."""
    width, height = view["width"], view["height"]
    splats = project(
        geometry(scene["means"], scene["quats"], scene["scales"], view["viewmat"], view["K"], width, height)
    )
    opacities = scene["opacities"] * (splats.compensations if antialiased else 1.0)
    order = sorted(range(len(opacities)), key=lambda i: (splats.depths[i].item(), i))
    mean, conic, radius = splats.means2d.tolist(), splats.conics.tolist(), splats.radii.tolist()
    image = torch.zeros(height, width, scene["colors"].shape[1], dtype=torch.float64)
    alpha_image = torch.zeros(height, width, 1, dtype=torch.float64)
    depth = torch.zeros(height, width, 1, dtype=torch.float64)
    weights = torch.zeros(len(opacities), dtype=torch.float64)
    for row in range(height):
        for column in range(width):
            through = 1.0
            for i in order:
                bins = [
                    math.floor((m - radius[i]) / 16) <= p // 16 < math.ceil((m + radius[i]) / 16)
                    for m, p in zip(mean[i], (column, row), strict=True)
                ]
                if radius[i] == 0 or not all(bins):
                    continue
                dx, dy = column + 0.5 - mean[i][0], row + 0.5 - mean[i][1]
                a, b, c = conic[i]
                alpha = min(0.999, opacities[i].item() * math.exp(-(0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy)))
                if alpha < 1 / 255:
                    continue
                if through * (1 - alpha) <= 1e-4:
                    break
                weight = alpha * through
                image[row, column] += weight * scene["colors"][i]
                alpha_image[row, column] += weight
                depth[row, column] += weight * splats.depths[i]
                weights[i] += weight
                through *= 1 - alpha
    return image, alpha_image, torch.where(alpha_image > 0, depth / alpha_image, 0.0), weights


@pytest.mark.parametrize(("width", "height", "antialiased"), [(21, 19, False), (33, 8, True), (1, 1, False)])
def test_matches_per_pixel_loop(width: int, height: int, antialiased: bool) -> None:
    scene, view = _scene(120), _view(width, height)
    if not antialiased:
        _add_wall(scene)
    image, alpha, depth, weights = _oracle(scene, view, antialiased=antialiased)
    ours = rasterize(**scene, **view, antialiased=antialiased, render_depth=True)
    assert ours.depth is not None
    assert ours.colors.shape == (height, width, 3)
    assert ours.alpha.shape == ours.depth.shape == (height, width, 1)
    # measured: 3.2e-15; weights, which sum over pixels, 1.5e-14 (float64)
    torch.testing.assert_close(ours.colors, image, rtol=0, atol=1e-12)
    torch.testing.assert_close(ours.alpha, alpha, rtol=0, atol=1e-12)
    torch.testing.assert_close(ours.depth, depth, rtol=0, atol=1e-12)
    geometry = {name: value for name, value in scene.items() if name != "colors"}
    ours_weights = blending_weights(**geometry, **view, antialiased=antialiased)
    torch.testing.assert_close(ours_weights, weights, rtol=0, atol=1e-12)


def test_stops_early_like_the_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    """Short segments and small batches change the path through the code, not the image or the gradients."""
    scene, view = _scene(300), _view(24, 17)
    scene["opacities"] = scene["opacities"].clamp(min=0.9)  # opaque after a few
    image, alpha, _, _ = _oracle(scene, view)
    results = []
    for segment in (4096, 3):
        monkeypatch.setattr("sundae_ns.rasterization.reference._SEGMENT", segment)
        leaves = _leaves(scene)
        ours = rasterize(**leaves, **view, absgrad=True)
        torch.testing.assert_close(ours.colors, image, rtol=0, atol=1e-12)
        torch.testing.assert_close(ours.alpha, alpha, rtol=0, atol=1e-12)
        ((ours.colors * image).sum() + ours.alpha.square().sum()).backward()
        results.append([leaf.grad for leaf in leaves.values()] + [ours.info["means2d"].absgrad])
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-11, atol=1e-11)  # measured: 9e-14


@pytest.mark.parametrize(
    ("count", "width", "height", "antialiased", "fast"),
    [(4, 3, 3, False, False), (60, 19, 18, False, True), (60, 19, 18, True, True)],
)
def test_gradcheck(count: int, width: int, height: int, antialiased: bool, fast: bool) -> None:
    """All inputs; fast mode compares random projections of the Jacobian, which allows a crowded scene."""
    scene, view = _scene(count, channels=2, seed=3), _view(width, height)
    _add_wall(scene)
    viewmat = view.pop("viewmat").requires_grad_()

    def outputs(viewmat: Tensor, *values: Tensor) -> tuple[Tensor, ...]:
        ours = rasterize(
            **dict(zip(NAMES, values, strict=True)), viewmat=viewmat, **view, antialiased=antialiased, render_depth=True
        )
        assert ours.depth is not None
        return ours.colors, ours.alpha, ours.depth

    inputs = (viewmat, *_leaves(scene).values())
    assert torch.autograd.gradcheck(outputs, inputs, eps=1e-7, atol=1e-5, rtol=1e-4, fast_mode=fast)


def test_absgrad_is_the_sum_of_absolute_pixel_gradients() -> None:
    scene, view = _scene(9), _view(10, 7)
    target = torch.rand(7, 10, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(5))

    def render(absgrad: bool) -> Rasterization:
        return rasterize(**_leaves(scene), **view, absgrad=absgrad)

    expected = torch.zeros(1, 9, 2, dtype=torch.float64)
    signed = torch.zeros(1, 9, 2, dtype=torch.float64)
    ours = render(False)
    for row in range(7):
        for column in range(10):
            loss = (ours.colors - target)[row, column].square().sum() + ours.alpha[row, column].sum()
            (gradient,) = torch.autograd.grad(loss, ours.info["means2d"], retain_graph=True)
            expected += gradient.abs()
            signed += gradient

    ours = render(True)
    ours.info["means2d"].retain_grad()
    ((ours.colors - target).square().sum() + ours.alpha.sum()).backward()
    # measured: 1.6e-15
    torch.testing.assert_close(ours.info["means2d"].absgrad, expected, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(ours.info["means2d"].grad, signed, rtol=1e-10, atol=1e-12)
    assert (expected > signed.abs() + 1e-6).any()


def test_float32_follows_float64() -> None:
    errors = []
    for dtype in (torch.float32, torch.float64):
        leaves = _leaves(_scene(500, dtype=dtype))
        ours = rasterize(**leaves, **_view(48, 40, dtype))
        (ours.colors.square().mean() + ours.alpha.mean()).backward()
        assert ours.colors.dtype == dtype
        errors.append([ours.colors.double(), ours.alpha.double()] + [leaf.grad.double() for leaf in leaves.values()])
    for a, b in zip(*errors, strict=True):
        # measured: 9.6e-7; the margin is for a pixel that rounding moves across 1/255 or the stopping threshold
        assert (a - b).norm() / b.norm() < 1e-3


def test_order_of_primitives_does_not_matter() -> None:
    scene, view = _scene(200), _view(32, 24)
    shuffle = torch.randperm(200, generator=torch.Generator().manual_seed(1))
    shuffled = {name: value[shuffle] for name, value in scene.items()}
    ours, other = rasterize(**scene, **view), rasterize(**shuffled, **view)
    torch.testing.assert_close(ours.colors, other.colors, rtol=0, atol=1e-13)
    assert torch.equal(ours.radii[shuffle], other.radii)


def test_ties_in_depth_are_broken_by_index() -> None:
    scene, view = _scene(2), _view(9, 9)
    scene["means"][:] = torch.tensor([0.0, 0.0, 2.0])
    scene["opacities"][:] = 0.8
    scene["colors"] = torch.eye(2, dtype=torch.float64)
    centre = rasterize(**scene, **view).colors[4, 4]
    assert centre[0] > 4 * centre[1]


def test_footprints_end_with_the_bins_of_gsplat() -> None:
    """A 16-pixel bin that the three-sigma square does not reach stays empty, though alphas there would be visible."""
    scene, view = _scene(1), _view(40, 20)
    scene["means"][:] = torch.tensor([0.0, 0.0, 1.0])
    scene["scales"][:] = math.sqrt(8.5) / view["K"][0, 0]  # 8.8 square pixels with the blur: 3 sigma = 8.9, 3.33 = 9.9
    scene["opacities"][:] = 1.0
    view["K"][1, 2] = 10.5
    ends = {}
    for centre in (6.9, 7.1, -1.1):
        view["K"][0, 2] = centre
        ours = rasterize(**scene, **view)
        assert ours.radii.tolist() == [9]
        ends[centre] = int(ours.alpha[10, :, 0].nonzero().max())
    # 6.9 + 9 is inside the first bin; 7.1 + 9 is not; -1.1 + 9 is, and all of that bin is blended.
    assert ends == {6.9: 15, 7.1: 16, -1.1: 8}


def test_rigid_motion_of_scene_and_camera() -> None:
    scene, view = _scene(200), _view(32, 24)
    angle, shift = 0.7, torch.tensor([0.3, -1.0, 2.0], dtype=torch.float64)
    half = torch.tensor([math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0], dtype=torch.float64)
    rotation = torch.tensor(
        [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]], dtype=torch.float64
    )
    w, x, y, z = scene["quats"].unbind(-1)
    moved = dict(scene)
    moved["means"] = scene["means"] @ rotation.T + shift
    moved["quats"] = torch.stack(
        [half[0] * w - half[2] * y, half[0] * x + half[2] * z, half[0] * y + half[2] * w, half[0] * z - half[2] * x], -1
    )
    other = dict(view)
    other["viewmat"] = torch.eye(4, dtype=torch.float64)
    other["viewmat"][:3, :3], other["viewmat"][:3, 3] = rotation.T, -rotation.T @ shift
    torch.testing.assert_close(
        rasterize(**scene, **view).colors, rasterize(**moved, **other).colors, rtol=0, atol=1e-11
    )


def test_weights_and_energy() -> None:
    scene, view = _scene(300), _view(40, 30)
    geometry = {name: value for name, value in scene.items() if name != "colors"}
    weights = blending_weights(**geometry, **view)
    ours = rasterize(**scene, **view)
    assert (weights >= 0).all()
    torch.testing.assert_close(weights.sum(), ours.alpha.sum())
    torch.testing.assert_close((weights[:, None] * scene["colors"]).sum(0), ours.colors.sum((0, 1)))
    assert (ours.alpha >= 0).all()
    assert (ours.alpha < 1 - 1e-4 + 1e-12).all()
    unseen = weights == 0
    assert unseen.any()
    kept = {name: value[~unseen] for name, value in scene.items()}
    torch.testing.assert_close(rasterize(**kept, **view).colors, ours.colors, rtol=0, atol=1e-13)


def _extreme(case: str) -> dict[str, Tensor]:
    """Scenes beyond those of ``test_steady.py``."""
    scene = _scene(40, dtype=torch.float32)
    if case == "vanishing":
        scene["scales"].fill_(1e-20)  # squares underflow
    elif case == "zero and one":
        scene["opacities"] = (torch.arange(40) % 2).float()
    elif case == "huge at the near plane":
        scene["means"][:, 2] = torch.linspace(-0.02, 0.03, 40)
        scene["means"][:3, 2] = torch.tensor([0.0, 0.01, -0.01])
        scene["scales"][::2] = 1e3
    elif case == "at the camera":
        scene["means"].zero_()
    elif case == "beside":
        scene["means"][:, 0] += 1e6
    else:
        assert case == "none"
        scene = {name: value[:0] for name, value in scene.items()}
    return scene


EXTREMES = ["vanishing", "zero and one", "huge at the near plane", "at the camera", "beside", "none"]


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("case", EXTREMES)
def test_extremes_are_finite(case: str, antialiased: bool) -> None:
    leaves = _leaves(_extreme(case))
    ours = rasterize(**leaves, **_view(20, 20, torch.float32), antialiased=antialiased, absgrad=True, render_depth=True)
    assert ours.depth is not None
    assert ours.alpha.min() >= 0
    assert ours.alpha.max() <= 1
    (ours.colors.square().sum() + ours.alpha.sum() + ours.depth.sum()).backward()
    tensors = [ours.colors, ours.alpha, ours.depth, ours.info["means2d"], ours.info["means2d"].absgrad]
    for value in [*tensors, *(leaf.grad for leaf in leaves.values())]:
        assert value is not None
        assert torch.isfinite(value).all()
    if case in ("transparent", "at the camera", "behind", "beside", "none"):
        assert (ours.colors == 0).all()
        assert (ours.depth == 0).all()
    if case in ("opaque", "huge", "zero quaternions", "crowd"):
        assert ours.alpha.max() > 0.5
    if case == "behind":
        assert (ours.radii == 0).all()


def test_zero_quaternion_is_the_identity() -> None:
    scene, view = _scene(30), _view(16, 16)
    zero, one = dict(scene), dict(scene)
    zero["quats"] = torch.zeros(30, 4, dtype=torch.float64)
    one["quats"] = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).expand(30, 4)
    assert torch.equal(rasterize(**zero, **view).colors, rasterize(**one, **view).colors)


def test_zero_direction_has_a_value_and_no_gradient() -> None:
    directions = torch.zeros(2, 3, requires_grad=True)
    coeffs = torch.randn(2, 16, 3, generator=torch.Generator().manual_seed(0), requires_grad=True)
    value = spherical_harmonics(3, directions, coeffs, backend=REFERENCE)
    value.sum().backward()
    up = spherical_harmonics(3, torch.tensor([[0.0, 0.0, 5.0]]).expand(2, 3), coeffs, backend=REFERENCE)
    torch.testing.assert_close(value, up)
    assert (directions.grad == 0).all()
    assert torch.isfinite(coeffs.grad).all()


def test_gradients_flow_from_any_subset_of_outputs() -> None:
    scene, view = _scene(30), _view(16, 16)
    for chosen in ("colors", "alpha", "depth"):
        leaves = _leaves(scene)
        getattr(rasterize(**leaves, **view, render_depth=True), chosen).sum().backward()
        assert leaves["means"].grad.abs().sum() > 0


@pytest.mark.parametrize("absgrad", [False, True])
def test_default_strategy_grows_on_the_reference(absgrad: bool) -> None:
    gsplat = pytest.importorskip("gsplat")
    scene = _scene(50, dtype=torch.float32)
    params = {name: torch.nn.Parameter(value) for name, value in scene.items()}
    params["scales"].data.log_()
    params["opacities"].data.logit_(eps=1e-3)
    optimizers = {name: torch.optim.Adam([param], 1e-3) for name, param in params.items()}
    strategy = gsplat.DefaultStrategy(
        absgrad=absgrad, refine_start_iter=0, refine_every=2, grow_grad2d=1e-7, refine_scale2d_stop_iter=10
    )
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state()
    for step in (1, 2):
        ours = rasterize(
            params["means"],
            params["quats"],
            params["scales"].exp(),
            params["opacities"].sigmoid(),
            params["colors"],
            **_view(24, 24, torch.float32),
            absgrad=absgrad,
        )
        strategy.step_pre_backward(params, optimizers, state, step, ours.info)
        (ours.colors - 0.5).square().mean().backward()
        strategy.step_post_backward(params, optimizers, state, step, ours.info)
        if step == 1:
            # One count per visible primitive and view.
            assert torch.equal(state["count"] > 0, ours.radii > 0)
            assert state["grad2d"].sum() > 0
    assert params["means"].shape[0] > 50
