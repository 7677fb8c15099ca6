"""Scenes as values: opening, saving, rendering, pruning and measuring them."""

import dataclasses
from functools import cache
from unittest.mock import Mock

import pytest
import torch
from fields import random_field
from packed_scenes import KINDS, scene, write_kind

import sundae_ns as sn
from sundae_ns.core.errors import BackendError, ConfigError, MemoryExhaustedError
from sundae_ns.rasterize.gsplat_backend import GsplatBackend


@cache
def cameras():
    return sn.virtual_cameras(scene(), 3, size=32)


@pytest.mark.parametrize(
    ("suffix", "least"), [(".ply", 80.0), (".glb", 80.0), (".spz", 35.0), (".sog", 33.0), (".sundae", 33.0)]
)
@pytest.mark.parametrize(("degree", "antialiased"), [(0, True), (2, False)])
def test_a_file_gives_the_scene_back(suffix, least, degree, antialiased, tmp_path):
    """Measured: exact for .ply, else 36 dB and more."""
    truth = sn.Scene(scene(degree=degree).gaussians, antialiased=antialiased)
    sn.save(truth, tmp_path / f"a{suffix}")
    found = sn.load(tmp_path / f"a{suffix}")
    assert (found.num_gaussians, found.gaussians.sh_degree, found.antialiased) == (200, degree, antialiased)
    assert not found.in_model_frame
    assert sn.measure(found, truth, cameras()).psnr > least


@pytest.mark.parametrize("name", ["logits", "degree 4, antialiased", "measured", "features"])
def test_packed_scenes_are_packed_again(name, tmp_path):
    found = sn.load(write_kind(tmp_path / "a.sundae", KINDS[name]))
    assert len(found.cameras) == 2
    sn.save(found, tmp_path / "b.sundae")
    again = sn.load(tmp_path / "b.sundae")
    assert (again.head is None) == (found.head is None)
    assert (again.background_color, again.trained_focal) == (found.background_color, found.trained_focal)
    torch.testing.assert_close(again.cameras[0].viewmat, found.cameras[0].viewmat)
    assert sn.measure(again, found, found.cameras, head=False).psnr > 30


def test_saving_refuses_what_it_cannot(tmp_path):
    with pytest.raises(ConfigError, match="no supported suffix"):
        sn.save(scene(), tmp_path / "a.png")
    with pytest.raises(ConfigError, match="leave out upright"):
        sn.save(scene(), tmp_path / "a.sundae", upright=True)
    (tmp_path / "file").touch()
    with pytest.raises(sn.SundaeError, match="a file stands where a folder should be"):
        sn.save(scene(), tmp_path / "file" / "a.ply")
    sn.save(scene(), tmp_path / "new" / "folder" / "a.ply")
    assert sn.load(tmp_path / "new" / "folder" / "a.ply").num_gaussians == scene().num_gaussians


@pytest.fixture
def headed(tmp_path):
    return sn.load(write_kind(tmp_path / "a.sundae", KINDS["residual"]))


def test_a_head_corrects_images_unless_it_is_left_out(headed):
    images, without = (sn.render(headed, headed.cameras[0], head=head) for head in (True, False))
    assert (images.rgb - images.base_rgb).abs().max() > 1e-3
    assert torch.equal(without.rgb, images.base_rgb)
    assert [tuple(image.shape) for image in images] == [(37, 50, 3), (37, 50, 3), (37, 50, 1), (37, 50, 1)]


def test_a_head_moves_to_another_device(headed, monkeypatch):
    monkeypatch.setattr("sundae_ns.scene.scene.checked", lambda same: same)  # it refuses this device
    before = torch.get_rng_state()
    moved = headed.to("meta")
    assert moved.device.type == "meta"
    assert {value.device.type for value in moved.head.parameters()} == {"meta"}
    assert headed.device.type == next(headed.head.parameters()).device.type == "cpu"
    assert torch.equal(torch.get_rng_state(), before)


def test_views_choose_what_stays():
    """What no view sees goes first."""
    truth = scene(400)
    truth.gaussians["means"][:200, 0] += 50
    camera = sn.Camera.look_at((0.0, -6.0, 0.0), (0.0, 0.0, 0.0), width=64, height=64)
    small = sn.prune(truth, keep=0.4, cameras=[camera], rule=sn.PruneRule(redistribution="none"))
    assert (small.gaussians["means"][:, 0] < 25).all()


@pytest.mark.usefixtures("short_prunes")
def test_primitives_that_are_not_finite_are_dropped():
    truth = scene()
    truth.gaussians["means"][:100] = torch.nan
    assert sn.prune(truth, keep=1.0, cameras=cameras()).num_gaussians == 100
    half = sn.prune(truth, keep=0.5, cameras=cameras())
    assert torch.isfinite(half.means).all()
    assert len(half) == 50
    assert len(sn.virtual_cameras(truth, 4)) == 4


@pytest.mark.usefixtures("short_prunes")
@pytest.mark.parametrize("kind", [".ply", ".spz", ".sundae", ".html"])
def test_a_scene_of_opaque_and_flat_primitives_is_saved_whole(tmp_path, kind):
    """One that was made in memory: files are mended when they are opened."""
    truth = dataclasses.replace(scene(), cameras=tuple(cameras()[:2]))
    truth.gaussians["opacities"][:90], truth.gaussians["scales"][80:, 1] = torch.inf, -torch.inf
    truth.gaussians["means"][5] = torch.nan
    sn.save(truth, tmp_path / f"a{kind}")
    if kind != ".html":
        found = sn.load(tmp_path / f"a{kind}")
        assert found.num_gaussians == truth.num_gaussians - 1
        assert all(value.isfinite().all() for value in found.gaussians.values())
        assert int((found.gaussians["opacities"].sigmoid() > 0.999).sum()) == 89
    if kind == ".ply":
        small = sn.prune(truth, keep=0.5, cameras=truth.cameras)
        assert all(value.isfinite().all() for value in small.gaussians.values())


def test_quality_against_images_and_against_a_scene():
    truth = scene()
    found = sn.measure(truth[::2], [sn.render(truth, camera).rgb for camera in cameras()], cameras())
    assert found == sn.measure(truth[::2], truth, cameras())
    assert found.psnr == pytest.approx(sum(found.psnrs) / 3)
    # Both scenes have the background of the reference.
    white = sn.measure(truth, dataclasses.replace(truth, background_color="white"), cameras())
    assert white.psnr > 80
    assert white.ssim == pytest.approx(1.0)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize("name", [*random_field(1, features=0), "viewmat", "K"])
def test_an_image_has_a_gradient_for_each_tensor_that_asks_for_one(name, backend):
    field, camera = scene(40).gaussians, cameras()[2]
    on_camera = name in ("viewmat", "K")
    value = (getattr(camera, name) if on_camera else field[name]).clone().requires_grad_()

    def total(value):
        there = camera._replace(**{name: value}) if on_camera else camera
        made = sn.Scene(field if on_camera else field.replaced({name: value}))
        return (sn.render(made, there, backend=backend).rgb.double() * weights).sum()

    weights = torch.rand(32, 32, 3, dtype=torch.float64)
    (gradient,) = torch.autograd.grad(total(value), value)
    assert gradient.norm() > 0
    step = 1e-3 * gradient / gradient.norm()
    slope = (total((value + step).detach()) - total((value - step).detach())) / 2
    assert float(slope) == pytest.approx(float((gradient * step).sum()), rel=0.1)


def test_an_image_has_no_graph_unless_something_asks_for_it(headed):
    field, camera = scene().gaussians, cameras()[0]
    asking = sn.Scene(field.replaced({"means": field["means"].clone().requires_grad_()}))
    assert sn.render(asking, camera).rgb.requires_grad
    with torch.no_grad():
        assert not sn.render(asking, camera).rgb.requires_grad
    assert not sn.render(sn.Scene(field), camera).rgb.requires_grad
    assert not sn.render(headed, headed.cameras[0]).rgb.requires_grad
    headed.head.train()
    image = sn.render(headed, headed.cameras[0])
    assert torch.autograd.grad(image.rgb.sum(), headed.head.net.out.weight)[0].any()
    assert not image.base_rgb.requires_grad


def test_gsplat_refuses_a_gradient_that_it_would_cut(monkeypatch):
    K = cameras()[0].K.clone().requires_grad_()
    monkeypatch.setattr("sundae_ns.scene.scene.select_backend", lambda *_: GsplatBackend())
    with pytest.raises(BackendError, match="no gradient for camera.K; detach it, or use the backend 'reference'"):
        sn.render(scene(), cameras()[0]._replace(K=K))


@pytest.mark.parametrize(
    "full",
    [
        MemoryError("Unable to allocate 11.2 GiB for an array with shape (3, 4)"),
        RuntimeError("[enforce fail] . DefaultCPUAllocator: can't allocate memory: you tried to allocate 11 bytes."),
    ],
    ids=["numpy", "torch"],
)
def test_full_memory_is_one_line(full, monkeypatch):
    monkeypatch.setattr("sundae_ns.scene.scene.render_view", Mock(side_effect=full))
    with pytest.raises(MemoryExhaustedError, match=r"^the memory is full with 200 Gaussians \(.*llocate .*\); give"):
        sn.render(scene(), cameras()[0])
    full.args = ("another error",)
    with pytest.raises(MemoryExhaustedError if isinstance(full, MemoryError) else RuntimeError, match="another error"):
        sn.render(scene(), cameras()[0])
