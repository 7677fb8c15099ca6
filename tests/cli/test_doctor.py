"""The doctor's findings and advice on simulated machines."""

from __future__ import annotations

import ctypes.util
import shutil
import sys
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from sundae_ns import evaluation
from sundae_ns.cli import doctor, main
from sundae_ns.errors import BackendError


def finding(name: str, compile_kernels: bool = False) -> doctor.Finding:
    (found,) = [one for one in doctor.examine(compile_kernels) if one.name == name]
    return found


@pytest.fixture
def no_cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


@pytest.fixture
def cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    """A CUDA device that only torch's answers simulate."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _: "Imaginary 9000")
    monkeypatch.setattr("sundae_ns.graphs.neighbors.Kernel", lambda *_: None)
    monkeypatch.setattr("sundae_ns.compensation.fused.head_kernels", lambda *_: {})
    monkeypatch.setattr("sundae_ns.gpu.loss.loss_kernels", lambda *_: None)


def _kernels(monkeypatch: pytest.MonkeyPatch, problem: str | None) -> None:
    def select(name: str, device: str) -> None:
        assert (name, device) == ("gsplat", "cuda")
        if problem:
            raise BackendError(problem)

    monkeypatch.setattr("sundae_ns.rasterization.select_backend", select)


def test_without_cuda_auto_selects_the_compiled_loops(no_cuda: None) -> None:
    found = finding("CUDA")
    assert not found.ok
    assert not found.needed
    assert found.fix
    assert "auto selects cpu" in finding("rasteriser").detail
    assert not finding("gsplat kernels", compile_kernels=True).ok


def test_without_numba_auto_selects_the_reference(no_cuda: None, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = "numba does not import (x; y); pip install numba"
    monkeypatch.setattr("sundae_ns.rasterization.numba_problem", lambda: problem)
    found = finding("rasteriser")
    assert not found.ok
    assert not found.needed
    assert "auto selects reference" in found.detail
    assert "numba does not import (x; y)" in found.detail
    assert found.fix == "pip install numba"


def test_with_working_kernels_auto_selects_gsplat(cuda: None, monkeypatch: pytest.MonkeyPatch) -> None:
    _kernels(monkeypatch, None)
    assert "Imaginary 9000" in finding("CUDA").detail
    assert finding("gsplat kernels", compile_kernels=True).ok
    assert finding("rasteriser", compile_kernels=True).detail == "auto selects gsplat"


def test_missing_kernels_are_built_only_on_request(cuda: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "kernels_built", lambda: False)
    _kernels(monkeypatch, "must not be tried")
    found = finding("gsplat kernels")
    assert found.detail == "not built yet"
    assert found.fix.startswith("sundae doctor --compile")
    assert "auto selects gsplat, after its kernels are built" in finding("rasteriser").detail


def test_kernels_that_do_not_run(cuda: None, monkeypatch: pytest.MonkeyPatch) -> None:
    _kernels(monkeypatch, "its kernels do not run (no nvcc)")
    found = finding("gsplat kernels", compile_kernels=True)
    assert not found.ok
    assert "no nvcc" in found.detail
    assert "auto selects reference" in finding("rasteriser", compile_kernels=True).detail


def test_own_kernels(cuda: None, monkeypatch: pytest.MonkeyPatch) -> None:
    assert finding("our kernels").ok

    def refuse(*_: object) -> None:
        raise BackendError("a CUDA kernel does not run (too old): update the driver")

    places = (
        "sundae_ns.graphs.neighbors.Kernel",
        "sundae_ns.compensation.fused.head_kernels",
        "sundae_ns.gpu.loss.loss_kernels",
    )
    for place in places:
        with monkeypatch.context() as patch:
            patch.setattr(place, refuse)
            found = finding("our kernels")
        assert not found.ok
        assert not found.needed
        assert "layer by layer" in found.detail
        assert found.fix == "update the driver"


def test_built_kernels_are_found_in_torchs_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "gsplat" / "__init__.py"
    package.parent.mkdir()
    package.touch()
    spec: Any = type("Spec", (), {"origin": str(package)})
    monkeypatch.setattr(doctor.importlib.util, "find_spec", lambda _: spec)
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path / "cache"))
    assert not doctor.kernels_built()
    built = tmp_path / "cache" / "py311_cu128" / "gsplat_cuda" / "gsplat_cuda.so"
    built.parent.mkdir(parents=True)
    built.touch()
    assert doctor.kernels_built()
    built.unlink()
    (package.parent / "csrc.so").touch()
    assert doctor.kernels_built()


def compiler(folder: Path, output: str) -> Path:
    """A program that reports its CUDA version like nvcc."""
    folder.mkdir(parents=True, exist_ok=True)
    made = folder / "nvcc"
    made.write_text(f"#!/bin/sh\necho '{output}'\n")
    made.chmod(0o755)
    return made


@pytest.fixture
def no_compiler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder as PATH, for a torch built for CUDA 13.0."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", str(folder))
    for name in ("CUDA_HOME", "CUDA_PATH"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    return folder


@pytest.mark.parametrize("release", ["13.0", "13.1"])
def test_nvcc_of_the_same_major_version_suffices(no_compiler: Path, release: str) -> None:
    nvcc = compiler(no_compiler, f"Cuda compilation tools, release {release}, V{release}.88")
    assert finding("nvcc") == doctor.Finding("nvcc", True, f"{nvcc} {release}, for gsplat's kernels")


@pytest.mark.parametrize("output", ["Cuda compilation tools, release 12.0, V12.0.140", "release 3.0", "hello"])
def test_nvcc_of_another_version_is_refused_by_torch(no_compiler: Path, output: str) -> None:
    compiler(no_compiler, output)
    found = finding("nvcc")
    assert not found.ok
    assert not found.needed
    assert "this torch is built for 13.0" in found.detail
    assert found.fix.startswith("apt-get install cuda-toolkit-13-0 ")
    assert "export CUDA_HOME=/usr/local/cuda-13.0" in found.fix


def test_torch_without_cuda_has_no_version_to_compare(no_compiler: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.version, "cuda", None)
    monkeypatch.setenv("CUDA_HOME", str(no_compiler / "nowhere"))
    assert "CUDA toolkit of torch's version" in finding("nvcc").fix
    monkeypatch.setenv("CUDA_HOME", str(no_compiler.parent))
    compiler(no_compiler, "release 12.0")
    assert finding("nvcc").ok


def test_nvcc_is_searched_like_torch_and_gsplat_do(no_compiler: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """gsplat calls nvcc from PATH, torch the one in CUDA_HOME; both must exist, and torch's version counts."""
    home = no_compiler.parent / "cuda"
    monkeypatch.setenv("CUDA_HOME", str(home))
    compiler(no_compiler, "release 12.0")
    assert f"not found in {home / 'bin'}" in finding("nvcc").detail
    nvcc = compiler(home / "bin", "release 13.0")
    assert finding("nvcc").detail.startswith(f"{nvcc} 13.0")
    (no_compiler / "nvcc").unlink()
    assert finding("nvcc").fix == f"export PATH={home / 'bin'}:$PATH"


def test_the_oldest_driver_is_named(no_cuda: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    assert "built for CUDA 13.0, which needs 580 or newer; with an older driver, pip install -c" in finding("CUDA").fix
    monkeypatch.setattr(torch.version, "cuda", "12.8")
    assert finding("CUDA").fix.endswith("needs 525 or newer")
    monkeypatch.setattr(torch.version, "cuda", "99.0")
    assert "needs" not in finding("CUDA").fix


def test_programs_of_nerfstudios_commands(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert finding("ffmpeg").fix == "apt-get install ffmpeg"
    (tmp_path / "ffmpeg").touch(mode=0o755)
    assert finding("ffmpeg").detail == f"{tmp_path / 'ffmpeg'}, for ns-render"


@pytest.mark.parametrize(("name", "module"), [("pycolmap", "pycolmap"), ("pillow-heif", "pillow_heif")])
def test_packages_for_photos(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str, module: str) -> None:
    monkeypatch.setitem(sys.modules, module, SimpleNamespace(__version__="4.2.1"))  # type: ignore[arg-type]
    assert finding(name).detail.startswith("4.2.1, for ")
    monkeypatch.setitem(sys.modules, module, None)
    found = finding(name)
    assert (found.ok, found.needed) == (False, False)
    assert found.detail.startswith("not installed, for ")
    assert found.fix == 'pip install "sundae_ns[photos]"'
    (tmp_path / f"{module}.py").write_text("raise ImportError('libgomp.so.1: cannot open shared object file')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, module)
    assert "cannot be loaded (libgomp.so.1: cannot open" in finding(name).detail


@pytest.mark.parametrize("on_disk", [True, False])
def test_lpips_weights(monkeypatch: pytest.MonkeyPatch, on_disk: bool) -> None:
    monkeypatch.setattr(evaluation, "lpips_weights_available", lambda: on_disk)
    found = finding("LPIPS weights")
    assert found.ok == on_disk
    if not on_disk:
        assert not found.needed
        # The command puts the file at the expected path.
        *_, path, url = found.fix.split()
        assert Path(path) == evaluation.lpips_weights_path()
        assert url == evaluation.lpips_weights_url()


def test_libraries_of_the_exporter(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ctypes.util, "find_library", lambda _: None)
    assert finding("libusb-1.0").fix == "apt-get install libusb-1.0-0"
    assert finding("libGL").fix == "apt-get install libgl1"
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: f"lib{name}.so")
    assert finding("libGL").ok


def test_versions_of_packages() -> None:
    found = {one.name: one.detail for one in doctor.versions()}
    assert found["torch"] == metadata.version("torch")
    assert found["gsplat"] == metadata.version("gsplat")
    assert {"python", "nerfstudio", "numpy"} <= set(found)


@pytest.fixture
def report(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str]]:
    """Runs the doctor on a wide terminal: exit code and text."""
    monkeypatch.setenv("COLUMNS", "200")
    return lambda **options: (doctor.run_doctor(**options), capsys.readouterr().out)


def test_a_machine_without_a_gpu_passes(no_cuda: None, report: Callable[..., tuple[int, str]]) -> None:
    code, text = report()
    assert code == 0
    assert "auto selects cpu" in text
    for one in doctor.examine():
        assert one.name in text
        assert one.ok or f"{one.name}: {one.fix}" in text


def test_a_missing_package_fails(
    no_cuda: None, monkeypatch: pytest.MonkeyPatch, report: Callable[..., tuple[int, str]]
) -> None:
    monkeypatch.setattr(doctor, "PACKAGES", ("torch", "no-such-package"))
    code, text = report()
    assert code == 1
    assert "no-such-package: pip install no-such-package" in text


def test_everything_on_disk_needs_no_advice(
    cuda: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, report: Callable[..., tuple[int, str]]
) -> None:
    _kernels(monkeypatch, None)
    monkeypatch.setattr(evaluation, "lpips_weights_available", lambda: True)
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: f"lib{name}.so")
    monkeypatch.setattr(shutil, "which", lambda name: str(tmp_path / name))
    for module in ("pycolmap", "pillow_heif"):
        monkeypatch.setitem(sys.modules, module, SimpleNamespace(__version__="9.9"))  # type: ignore[arg-type]
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setenv("CUDA_HOME", str(tmp_path))
    compiler(tmp_path / "bin", "release 13.0")
    code, text = report(compile_kernels=True)
    assert code == 0
    assert "To fix" not in text


def test_command(no_cuda: None, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["doctor"])
    assert caught.value.code == 0
    assert "rasteriser" in capsys.readouterr().out
