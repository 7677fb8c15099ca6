"""Choice of a backend, the errors users see, and bounds of a view: terabytes are refused, real views are not."""

import subprocess
import sys

import pytest
import torch
from splat_inputs import blending_weights, inputs_of, rasterize, rasterize_cameras, several_views

from sundae_ns.core.errors import BackendError, ConfigError, DataError, MemoryExhaustedError
from sundae_ns.rasterize import interface
from sundae_ns.rasterize import types as limits
from sundae_ns.rasterize.cpu import backend as backend_of_cpu
from sundae_ns.rasterize.cpu import tiles
from sundae_ns.rasterize.interface import select_backend, spherical_harmonics

REFERENCE = select_backend("reference", "cpu")


def _arguments(n=3):
    return {
        "means": torch.ones(n, 3),
        "quats": torch.ones(n, 4),
        "scales": torch.ones(n, 3),
        "opacities": torch.ones(n),
        "colors": torch.ones(n, 3),
        "viewmat": torch.eye(4),
        "K": torch.eye(3),
        "width": 4,
        "height": 4,
        "backend": REFERENCE,
    }


def test_without_numba_auto_takes_the_reference():
    """In a fresh interpreter that cannot import numba; selected by name, the backend raises the cause."""
    code = """
import sys
sys.modules["numba"] = None
from sundae_ns.core.errors import BackendError
from sundae_ns.rasterize.interface import select_backend
assert select_backend("auto", "cpu").name == "reference"
try:
    select_backend("cpu", "cpu")
except BackendError as error:
    print(error)
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
    with pytest.raises(BackendError, match=f"{message}; or use the backend 'reference'$") as caught:
        select_backend(name, device)
    assert "\n" not in str(caught.value)
    assert select_backend("auto", device).name == instead


def test_unknown_backend():
    with pytest.raises(ConfigError, match="auto, gsplat, cpu or reference"):
        select_backend("vulkan", "cpu")


@pytest.mark.parametrize(("chosen", "missing"), [("'auto', 'cpu'", "gsplat"), ("'reference', 'cpu'", "numba")])
def test_selecting_does_not_import_other_backends(chosen, missing):
    code = (
        f"import sys; from sundae_ns.rasterize.interface import select_backend; select_backend({chosen}); "
        f"sys.exit(any(name.split('.')[0] == '{missing}' for name in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("means", torch.ones(3, 2), r"means has shape \[3, 2\]; pass \[3, 3\]"),
        ("quats", torch.ones(2, 4), r"quats has shape \[2, 4\]"),
        ("scales", torch.ones(3), "scales has shape"),
        ("opacities", torch.ones(3, 1), r"opacities has shape \[3, 1\]; pass \[3\]"),
        ("colors", torch.ones(3, 0), "at least one channel"),
        ("viewmat", torch.eye(4)[:3], "viewmat has shape"),
        ("K", torch.eye(4), "K has shape"),
        ("K", torch.eye(3, dtype=torch.float64), "K is torch.float64"),
        ("width", 0, "empty"),
    ],
)
def test_wrong_arguments(name, value, message):
    arguments = _arguments()
    arguments[name] = value
    with pytest.raises(DataError, match=message):
        rasterize(**arguments)


def test_wrong_harmonics():
    with pytest.raises(DataError, match="degree 5"):
        spherical_harmonics(5, torch.ones(2, 3), torch.ones(2, 36, 3), backend=REFERENCE)
    with pytest.raises(DataError, match="needs"):
        spherical_harmonics(2, torch.ones(2, 3), torch.ones(2, 8, 3), backend=REFERENCE)


def test_blending_weights_with_pixel_weights():
    arguments = {**_arguments(), "scales": torch.full((3, 3), 0.3), "opacities": torch.full((3,), 0.5), "height": 5}
    arguments.pop("colors")
    left = torch.zeros(5, 4)
    left[:, :2] = 2.5
    with torch.no_grad():
        total, of_left, of_right = (blending_weights(**arguments, pixels=p) for p in (None, left, 2.5 - left))
    assert total.shape == (3,)
    assert not total.requires_grad
    torch.testing.assert_close(of_left + of_right, 2.5 * total)
    assert not torch.equal(of_left, of_right)
    with pytest.raises(DataError, match="pixels has shape"):
        blending_weights(**arguments, pixels=left[1:])


@pytest.mark.parametrize("name", ["cpu", "reference"])
def test_several_views_are_those_of_single_passes(name):
    shared, cameras = several_views()
    options = {"width": 40, "height": 30, "antialiased": True, "backend": select_backend(name, "cpu")}
    images = rasterize_cameras(**shared, **cameras, **options)
    assert images.shape == (3, 30, 40, 4)
    for image, colors, viewmat, K in zip(images, *cameras.values(), strict=True):
        assert float(image.max()) > 0.1
        torch.testing.assert_close(image, rasterize(**shared, colors=colors, viewmat=viewmat, K=K, **options).colors)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"viewmats": torch.ones(0, 4, 4)}, "there is no view to rasterize"),
        ({"Ks": torch.ones(2, 3, 3)}, r"Ks has shape \[2, 3, 3\]; pass \[3, 3, 3\]"),
        ({"colors": torch.ones(2, 50, 4)}, r"colors has shape \[2, 50, 4\]; pass \[3, 50, C\]"),
        ({"colors": torch.ones(3, 49, 4)}, r"colors has shape \[49, 4\]; pass \[50, C\]"),
    ],
)
def test_wrong_views(change, message):
    shared, cameras = several_views()
    with pytest.raises(DataError, match=message):
        rasterize_cameras(**shared, **{**cameras, **change}, width=4, height=4, backend=REFERENCE)


# --------------------------------------------------------------------------------------------------------------- memory

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
    assert camera(60_000, 16, 1e-3, spread=1.9, backend=backend).min() > 0
    # On the corner of four tiles.
    assert camera(60_000, 16, 1e-3, backend=backend).max() > 0


def test_a_training_whose_lists_exceed_the_memory_is_refused(monkeypatch):
    monkeypatch.setattr(limits, "_NEGLIGIBLE", 0)
    monkeypatch.setattr(limits, "available_memory", lambda: 1_000_000)
    with pytest.raises(MemoryExhaustedError, match="pairs of a tile and a Gaussian take .* GB, but .* are available"):
        camera(1000, 64, 20.0, training=True)


def test_an_image_of_many_pairs_is_blended_by_regions(monkeypatch):
    """Full-screen Gaussians beside lines in one row of tiles: the lists of each region fit the limit."""
    count, most, regions, lists = 60, 400, [], tiles.tile_lists

    def limited(*arguments):
        for region in lists(*arguments):
            regions.append(region)
            yield region

    def drawn():
        torch.manual_seed(0)
        values = {
            "means": torch.cat([torch.rand(count, 2) - 0.5, torch.full((count, 1), 2.0)], dim=1).requires_grad_(),
            "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
            "scales": torch.cat([torch.full((30, 3), 20.0), torch.tensor([[20.0, 1e-3, 1e-3]]).repeat(30, 1)]),
            "opacities": torch.full((count,), 0.05).requires_grad_(),
            "colors": torch.rand(count, 3).requires_grad_(),
        }
        values["means"].data[30:, 1] = 0.01
        K = torch.tensor([[64.0, 0, 40], [0, 64, 26], [0, 0, 1]])
        ours = rasterize(
            **values, viewmat=torch.eye(4), K=K, width=80, height=52, absgrad=True, backend=select_backend("cpu", "cpu")
        )
        (ours.colors * torch.rand(52, 80, 3) + ours.alpha).sum().backward()
        grads = [values[name].grad for name in ("means", "opacities", "colors")]
        return [ours.colors, ours.alpha, *grads, ours.info["means2d"].absgrad]

    once = drawn()
    monkeypatch.setattr(tiles, "MOST_PAIRS", most)
    monkeypatch.setattr(backend_of_cpu, "tile_lists", limited)
    image, alpha, *grads = drawn()
    assert torch.equal(image, once[0])
    assert torch.equal(alpha, once[1])
    for ours, exact in zip(grads, once[2:], strict=True):
        torch.testing.assert_close(ours, exact, rtol=1e-5, atol=1e-5)
    half = len(regions) // 2
    assert len(regions) == 2 * half >= 10  # the backward pass makes them again
    assert all(len(region.slots) <= most for region in regions)
    drawn_tiles = torch.cat([torch.from_numpy(region.longest_first) for region in regions[:half]])
    assert sorted(drawn_tiles.tolist()) == list(range(70))
    monkeypatch.setattr(tiles, "MOST_PAIRS", 0)  # a tile is not cut
    assert torch.equal(drawn()[0], once[0])


@pytest.mark.parametrize("name", BACKENDS)
def test_defaults_of_torch_do_not_matter(name):
    shared, cameras = several_views()
    inputs = inputs_of(
        **shared,
        **dict(zip(("colors", "viewmat", "K"), (v[0] for v in cameras.values()))),
        width=9,
        height=7,
        render_depth=True,
    )
    expected = interface.rasterize(inputs, backend=select_backend(name, "cpu"))
    interface.numba_problem.cache_clear()
    torch.set_default_dtype(torch.float64)
    torch.set_default_device("meta")
    try:
        ours = interface.rasterize(inputs, backend=select_backend(name, "cpu"))
    finally:
        torch.set_default_dtype(torch.float32)
        torch.set_default_device(None)
    for value, same in ((ours.colors, expected.colors), (ours.depth, expected.depth), (ours.radii, expected.radii)):
        assert torch.equal(value, same)


def test_images_that_exceed_the_memory_are_refused(monkeypatch):
    monkeypatch.setattr(limits, "available_memory", lambda: 1 << 30)
    with pytest.raises(MemoryExhaustedError, match=r"images of 65,536 x 65,536 pixels take 274\.9 GB, but 1\.1 GB are"):
        camera(10, 65_536, 1e-3)


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
