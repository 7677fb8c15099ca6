"""Choice of a backend, the errors users see, and bounds of a view: terabytes are refused, real views are not."""

import subprocess
import sys
from unittest.mock import Mock

import pytest
import torch
from splat_inputs import blending_weights, rasterize, rasterize_cameras, several_views

from sundae_ns.core.errors import BackendError, ConfigError, DataError, MemoryExhaustedError
from sundae_ns.cuda.kernels import _check
from sundae_ns.rasterize import interface
from sundae_ns.rasterize import types as limits
from sundae_ns.rasterize.gsplat_backend import RecordableGsplat
from sundae_ns.rasterize.gsplat_kernels import Capacity
from sundae_ns.rasterize.interface import harmonic_colors, select_backend

REFERENCE = select_backend("reference", "cpu")


def test_selecting_imports_no_other_backend_and_without_numba_auto_takes_the_reference():
    """In a fresh interpreter; a backend that is selected by name raises the cause."""
    code = """
import sys
from sundae_ns.core.errors import BackendError
from sundae_ns.rasterize.interface import numba_problem, select_backend
select_backend("reference", "cpu")
assert not {"numba", "gsplat"} & set(sys.modules)
sys.modules["numba"] = None
assert select_backend("auto", "cpu").name == "reference"
try:
    select_backend("cpu", "cpu")
except BackendError as error:
    print(error)
del sys.modules["numba"]
numba_problem.cache_clear()
assert select_backend("auto", "cpu").name == "cpu"
assert "gsplat" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    (line,) = done.stdout.splitlines()
    assert line.startswith("cpu cannot rasterize: numba does not import (")
    assert line.endswith("; pip install numba; or use the backend 'reference'")


@pytest.mark.parametrize(
    ("name", "device", "gpu", "message", "instead"),
    [
        ("cpu", "meta", False, "on the device 'meta'; move them to 'cpu'", "reference"),
        ("gsplat", "cuda", False, "CUDA is not available; use .*", "reference"),
        ("gsplat", "cpu", True, "on the device 'cpu'; move them to 'cuda'", "cpu"),
        ("gsplat", "cuda:0", True, "its kernels do not run", "reference"),
    ],
)
def test_a_backend_that_cannot_run_is_one_line_and_auto_falls_back(name, device, gpu, message, instead, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    monkeypatch.setattr(interface, "_kernel_problem", lambda: "its kernels do not run")
    with pytest.raises(BackendError, match=f"^.*{message}; or use the backend 'reference'$"):
        select_backend(name, device)
    assert select_backend("auto", device).name == instead
    with pytest.raises(ConfigError, match="auto, gsplat, cpu or reference"):
        select_backend("vulkan", device)


@pytest.mark.parametrize("call", [interface._kernel_problem, interface.numba_problem, lambda: _check(Mock(), 2)])
def test_full_memory_is_an_error_at_each_call_and_no_missing_kernel(call, monkeypatch):
    full = MemoryError() if call is interface.numba_problem else RuntimeError("CUDA error: out of memory")
    monkeypatch.setattr(torch, "ones", Mock(side_effect=full))
    getattr(call, "cache_clear", bool)()
    for _ in range(2):
        with pytest.raises(MemoryExhaustedError, match="memory is full .*; end other programs"):
            call()


def one_view(call=rasterize, **changes):
    """A pass over three Gaussians, with other arguments."""
    shapes = {"means": (3, 3), "quats": (3, 4), "scales": (3, 3), "opacities": (3,), "colors": (3, 3)}
    values = {name: torch.ones(shape) for name, shape in shapes.items()}
    size = {"width": 4, "height": 4}
    return call(**{**values, "viewmat": torch.eye(4), "K": torch.eye(3), **size, **changes}, backend=REFERENCE)


def views(backend=REFERENCE, **changes):
    shared, cameras = several_views()
    return rasterize_cameras(**shared, **{**cameras, **changes}, width=4, height=4, backend=backend)


def harmonics(degree, terms, backend=REFERENCE, **types):
    values = torch.ones(2, 3), torch.ones(3), torch.ones(2, 3, **types), torch.ones(2, terms - 1, 3)
    return harmonic_colors(degree, *values, backend=backend)


REFUSED = [
    (lambda: one_view(means=torch.ones(3, 2)), r"means has shape \[3, 2\]; pass \[3, 3\]"),
    (lambda: one_view(quats=torch.ones(2, 4)), r"quats has shape \[2, 4\]"),
    (lambda: one_view(scales=torch.ones(3)), "scales has shape"),
    (lambda: one_view(opacities=torch.ones(3, 1)), r"opacities has shape \[3, 1\]; pass \[3\]"),
    (lambda: one_view(colors=torch.ones(3, 0)), "at least one channel"),
    (lambda: one_view(viewmat=torch.eye(4)[:3]), "viewmat has shape"),
    (lambda: one_view(K=torch.eye(4)), "K has shape"),
    (lambda: one_view(K=torch.eye(3).double()), "K is torch.float64"),
    (lambda: one_view(width=0), "empty"),
    (lambda: one_view(blending_weights, pixels=torch.ones(3, 4)), "pixels has shape"),
    (lambda: views(viewmats=torch.ones(0, 4, 4)), "there is no view to rasterize"),
    (lambda: views(Ks=torch.ones(2, 3, 3)), r"Ks has shape \[2, 3, 3\]; pass \[3, 3, 3\]"),
    (lambda: views(colors=torch.ones(2, 50, 4)), r"colors has shape \[2, 50, 4\]; pass \[3, 50, C\]"),
    (lambda: views(colors=torch.ones(3, 49, 4)), r"colors has shape \[49, 4\]; pass \[50, C\]"),
    (lambda: harmonics(5, 36), "degree 5"),
    (lambda: harmonics(2, 8), "needs"),
    (lambda: harmonics(1, 4, dtype=torch.float64), "features_dc is torch.float64 on cpu but means is torch.float32"),
    (lambda: harmonics(2, 8, RecordableGsplat(Capacity())), "features_rest has shape .* needs"),
    (lambda: one_view(means=torch.ones(3, 3).bfloat16()), "means is torch.bfloat16; give float32 or float64"),
]


@pytest.mark.parametrize(("call", "message"), REFUSED)
def test_wrong_arguments(call, message):
    with pytest.raises(DataError, match=message):
        call()


def test_several_views_without_gradients_record_none():
    torch.set_num_threads(2)
    modes = []
    spy = Mock(rasterize=lambda inputs: modes.append(torch.is_grad_enabled()) or REFERENCE.rasterize(inputs))
    with torch.no_grad():
        views(spy)
    assert modes == 3 * [False]


def test_blending_weights_with_pixel_weights():
    values = {"scales": torch.full((3, 3), 0.3), "opacities": torch.full((3,), 0.5)}
    left = torch.zeros(4, 4)
    left[:, :2] = 2.5
    with torch.no_grad():
        total, *parts = (one_view(blending_weights, **values, pixels=pixels) for pixels in (None, left, 2.5 - left))
    assert total.shape == (3,)
    assert not total.requires_grad
    torch.testing.assert_close(sum(parts), 2.5 * total)
    assert not torch.equal(*parts)


BACKENDS = ("cpu", "reference")


def camera(count, size, scale, *, spread=0.0, backend="reference", **options):
    """The image of faint Gaussians in front of a camera."""
    torch.manual_seed(0)
    means = torch.cat([spread * (torch.rand(count, 2) - 0.5), torch.full((count, 1), 2.0)], dim=1)
    values = {
        "means": means.requires_grad_(options.get("training", False)),
        "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        "scales": torch.full((count, 3), scale),
        "opacities": torch.full((count,), 0.01),
        "colors": torch.ones(count, 1),
    }
    K = torch.tensor([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1.0]])
    return rasterize(
        **values, viewmat=torch.eye(4), K=K, width=size, height=size, backend=select_backend(backend, "cpu")
    ).colors


@pytest.mark.parametrize("backend", BACKENDS)
def test_more_primitives_than_in_any_scene_are_refused(backend, monkeypatch):
    monkeypatch.setattr(limits, "MOST_PER_TILE", 100)
    monkeypatch.setattr(limits, "ALWAYS", 0)
    bins = {"cpu": 64, "reference": 16}[backend]
    # Each Gaussian touches all tiles; four of them are its own.
    most = 100 * bins // (bins - 4)
    assert camera(most, 64, 20.0, backend=backend).shape == (64, 64, 1)
    camera(200, 64, 20.0, backend=backend, training=True)
    with pytest.raises(MemoryExhaustedError, match=r"the view has \d+ Gaussians in each tile .* less than 100;"):
        camera(most + 1, 64, 20.0, backend=backend)
    with torch.no_grad(), pytest.raises(MemoryExhaustedError):
        camera(200, 64, 20.0, backend=backend, training=True)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_small_image_of_many_primitives_is_drawn(backend, monkeypatch):
    """A large scene from far away, or as a thumbnail; large Gaussians take little too, whatever their lists."""
    assert camera(20_000, 40, 20.0, backend=backend).shape == (40, 40, 1)
    monkeypatch.setattr(limits, "ALWAYS", 0)
    assert camera(20_000, 16, 1e-3, spread=1.9, backend=backend).min() > 0
    # On the corner of four tiles.
    assert camera(20_000, 16, 1e-3, backend=backend).max() > 0


def test_images_and_lists_of_a_training_that_exceed_the_memory_are_refused(monkeypatch):
    monkeypatch.setattr(limits, "available_memory", lambda: 1 << 30)
    with pytest.raises(MemoryExhaustedError, match=r"images of 65,536 x 65,536 pixels take 274\.9 GB, but 1\.1 GB are"):
        camera(10, 65_536, 1e-3)
    monkeypatch.setattr(limits, "_NEGLIGIBLE", 0)
    monkeypatch.setattr(limits, "available_memory", lambda: 1_000_000)
    with pytest.raises(MemoryExhaustedError, match="pairs of a tile and a Gaussian take .* GB, but .* are available"):
        camera(1000, 64, 20.0, training=True)


def test_the_memory_is_that_of_machine_and_control_group(tmp_path, monkeypatch):
    memory = tmp_path / "meminfo"
    monkeypatch.setattr(limits, "_PROCESS", tmp_path)
    monkeypatch.setattr(limits, "_CONTROL_GROUP", tmp_path)
    assert limits.available_memory() is None
    memory.write_text("MemTotal:  9000 kB\nMemAvailable:    5000 kB\n")
    assert limits.available_memory() == 5000 * 1024
    (tmp_path / "memory.max").write_text("3000000\n")
    (tmp_path / "memory.current").write_text("2500000\n")
    (tmp_path / "memory.stat").write_text("anon 1\nactive_file 100000\ninactive_file 200000\n")
    assert limits.available_memory() == 800_000
    (tmp_path / "memory.max").write_text("max\n")
    assert limits.available_memory() == 5000 * 1024
    (tmp_path / "self").mkdir()
    (tmp_path / "self" / "statm").write_text("100 50 1 1 0 1 0\n")
    for limit, available in (("unlimited", 5000 * 1024), (str(limits.PAGESIZE * 350), limits.PAGESIZE * 250)):
        (tmp_path / "self" / "limits").write_text(f"Limit  Soft\nMax address space   {limit}  unlimited  bytes\n")
        assert limits.available_memory() == available
