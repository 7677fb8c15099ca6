"""Choice of a backend, and the errors users see."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch
from splat_inputs import several_views

from sundae_ns.errors import BackendError, ConfigError, DataError
from sundae_ns.rasterization import (
    BackendName,
    blending_weights,
    rasterize,
    rasterize_views,
    select_backend,
    spherical_harmonics,
)

REFERENCE = select_backend("reference", "cpu")


def _arguments(n: int = 3) -> dict:
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


@pytest.mark.parametrize("device", ["cpu", torch.device("cpu")])
def test_auto_takes_the_compiled_loops_on_a_cpu(device: torch.device | str) -> None:
    assert select_backend("auto", device).name == "cpu"


def test_without_numba_auto_takes_the_reference() -> None:
    """In a fresh interpreter that cannot import numba; selected by name, the backend raises the cause."""
    code = """
import sys
sys.modules["numba"] = None
from sundae_ns.errors import BackendError
from sundae_ns.rasterization import select_backend
assert select_backend("auto", "cpu").name == "reference"
try:
    select_backend("cpu", "cpu")
except BackendError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    (line,) = done.stdout.splitlines()
    assert line.startswith("the cpu backend cannot rasterize: numba does not import (")
    assert line.endswith("; pip install numba; or use the backend 'reference'")


def test_cpu_backend_off_the_cpu_is_refused() -> None:
    with pytest.raises(BackendError, match=r"on the device 'meta'; move them to 'cpu'; or use the backend 'reference'"):
        select_backend("cpu", "meta")


def test_gsplat_without_a_gpu_is_one_line_with_cause_and_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(BackendError, match=r"CUDA is not available; use .* or use the backend 'reference'") as caught:
        select_backend("gsplat", "cuda")
    assert "\n" not in str(caught.value)
    assert select_backend("auto", "cuda").name == "reference"


def test_gsplat_on_cpu_tensors_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    with pytest.raises(BackendError, match="on the device 'cpu'"):
        select_backend("gsplat", "cpu")
    assert select_backend("auto", "cpu").name == "cpu"


def test_kernels_that_fail_are_reported_and_auto_falls_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr("sundae_ns.rasterization.interface._kernel_problem", lambda: "its kernels do not run (x); mend")
    with pytest.raises(BackendError, match="its kernels do not run"):
        select_backend("gsplat", "cuda")
    assert select_backend("auto", "cuda:0").name == "reference"


def test_unknown_backend() -> None:
    with pytest.raises(ConfigError, match="auto, gsplat, cpu or reference"):
        select_backend("vulkan", "cpu")  # type: ignore[arg-type]


@pytest.mark.parametrize(("chosen", "missing"), [("'auto', 'cpu'", "gsplat"), ("'reference', 'cpu'", "numba")])
def test_selecting_does_not_import_other_backends(chosen: str, missing: str) -> None:
    code = (
        f"import sys; from sundae_ns.rasterization import select_backend; select_backend({chosen}); "
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
def test_wrong_arguments(name: str, value: object, message: str) -> None:
    arguments = _arguments()
    arguments[name] = value
    with pytest.raises(DataError, match=message):
        rasterize(**arguments)


def test_wrong_harmonics() -> None:
    with pytest.raises(DataError, match="degree 5"):
        spherical_harmonics(5, torch.ones(2, 3), torch.ones(2, 36, 3), backend=REFERENCE)
    with pytest.raises(DataError, match="needs"):
        spherical_harmonics(2, torch.ones(2, 3), torch.ones(2, 8, 3), backend=REFERENCE)


def test_blending_weights_work_without_grad() -> None:
    arguments = _arguments()
    arguments.pop("colors")
    with torch.no_grad():
        weights = blending_weights(**arguments)
    assert weights.shape == (3,)
    assert not weights.requires_grad


def test_blending_weights_with_pixel_weights() -> None:
    arguments = {**_arguments(), "scales": torch.full((3, 3), 0.3), "opacities": torch.full((3,), 0.5), "height": 5}
    arguments.pop("colors")
    left = torch.zeros(5, 4)
    left[:, :2] = 2.5
    total, of_left, of_right = (blending_weights(**arguments, pixels=p) for p in (None, left, 2.5 - left))
    torch.testing.assert_close(of_left + of_right, 2.5 * total)
    assert not torch.equal(of_left, of_right)
    with pytest.raises(DataError, match="pixels has shape"):
        blending_weights(**arguments, pixels=left[1:])


@pytest.mark.parametrize("name", ["cpu", "reference"])
def test_several_views_are_those_of_single_passes(name: BackendName) -> None:
    shared, views = several_views()
    options = {"width": 40, "height": 30, "antialiased": True, "backend": select_backend(name, "cpu")}
    images = rasterize_views(**shared, **views, **options)
    assert images.shape == (3, 30, 40, 4)
    for image, colors, viewmat, K in zip(images, *views.values(), strict=True):
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
def test_wrong_views(change: dict, message: str) -> None:
    shared, views = several_views()
    with pytest.raises(DataError, match=message):
        rasterize_views(**shared, **{**views, **change}, width=4, height=4, backend=REFERENCE)
