"""The doctor's findings on machines that it is told about, and what it advises."""

from __future__ import annotations

import ctypes.util
import io
import shutil
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console

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
    """A CUDA device that exists in torch's answers only."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _: "Imaginary 9000")
    monkeypatch.setattr("sundae_ns.nvrtc.Kernel", lambda *_: None)
    monkeypatch.setattr("sundae_ns.compensation.kernels.compiled", lambda *_: {})


def _kernels(monkeypatch: pytest.MonkeyPatch, problem: str | None) -> None:
    def select(name: str, device: str) -> None:
        assert (name, device) == ("gsplat", "cuda")
        if problem:
            raise BackendError(problem)

    monkeypatch.setattr("sundae_ns.rasterization.select_backend", select)


def test_without_cuda_auto_takes_the_compiled_loops(no_cuda: None) -> None:
    found = finding("CUDA")
    assert not found.ok
    assert not found.needed
    assert found.mend
    assert "auto takes cpu" in finding("rasteriser").detail
    assert not finding("gsplat kernels", compile_kernels=True).ok


def test_without_numba_auto_takes_the_reference(no_cuda: None, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = "numba does not import (x; y); pip install numba"
    monkeypatch.setattr("sundae_ns.rasterization.numba_problem", lambda: problem)
    found = finding("rasteriser")
    assert not found.ok
    assert not found.needed
    assert "auto takes reference" in found.detail
    assert "numba does not import (x; y)" in found.detail
    assert found.mend == "pip install numba"


def test_with_running_kernels_auto_takes_gsplat(cuda: None, monkeypatch: pytest.MonkeyPatch) -> None:
    _kernels(monkeypatch, None)
    assert "Imaginary 9000" in finding("CUDA").detail
    assert finding("gsplat kernels", compile_kernels=True).ok
    assert finding("rasteriser", compile_kernels=True).detail == "auto takes gsplat"


def test_kernels_that_are_not_built_are_built_on_request_only(cuda: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "kernels_built", lambda: False)
    _kernels(monkeypatch, "this must not have been tried")
    found = finding("gsplat kernels")
    assert found.detail == "not built yet"
    assert found.mend.startswith("sundae doctor --compile")
    assert "auto takes gsplat, after it has built its kernels" in finding("rasteriser").detail


def test_kernels_that_do_not_run(cuda: None, monkeypatch: pytest.MonkeyPatch) -> None:
    _kernels(monkeypatch, "its kernels do not run (no nvcc)")
    found = finding("gsplat kernels", compile_kernels=True)
    assert not found.ok
    assert "no nvcc" in found.detail
    assert "auto takes reference" in finding("rasteriser", compile_kernels=True).detail


def test_own_kernels(cuda: None, monkeypatch: pytest.MonkeyPatch) -> None:
    assert finding("our kernels").ok

    def refuse(*_: object) -> None:
        raise BackendError("a CUDA kernel does not run (too old): update the driver")

    for place in ("sundae_ns.nvrtc.Kernel", "sundae_ns.compensation.kernels.compiled"):
        with monkeypatch.context() as patch:
            patch.setattr(place, refuse)
            found = finding("our kernels")
        assert not found.ok
        assert not found.needed
        assert "layer by layer" in found.detail
        assert found.mend == "update the driver"


def test_built_kernels_are_found_where_torch_puts_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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


@pytest.mark.parametrize("where", ["path", "home", None])
def test_nvcc(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str | None) -> None:
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", str(folder if where == "path" else tmp_path))
    monkeypatch.setenv("CUDA_HOME", str(tmp_path if where == "home" else tmp_path / "none"))
    if where:
        (folder / "nvcc").touch(mode=0o755)
    found = finding("nvcc")
    assert found.ok == bool(where)
    assert bool(found.mend) != found.ok


@pytest.mark.parametrize("at_hand", [True, False])
def test_lpips_weights(monkeypatch: pytest.MonkeyPatch, at_hand: bool) -> None:
    monkeypatch.setattr(evaluation, "lpips_weights_available", lambda: at_hand)
    found = finding("LPIPS weights")
    assert found.ok == at_hand
    if not at_hand:
        assert not found.needed
        # A command that puts the right file where it is looked for.
        *_, path, url = found.mend.split()
        assert Path(path) == evaluation.lpips_weights_path()
        assert url == evaluation.lpips_weights_url()


def test_libraries_of_the_exporter(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ctypes.util, "find_library", lambda _: None)
    assert finding("libusb-1.0").mend == "apt-get install libusb-1.0-0"
    assert finding("libGL").mend == "apt-get install libgl1"
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: f"lib{name}.so")
    assert finding("libGL").ok


def test_versions_of_what_matters() -> None:
    found = {one.name: one.detail for one in doctor.versions()}
    assert found["torch"] == metadata.version("torch")
    assert found["gsplat"] == metadata.version("gsplat")
    assert {"python", "nerfstudio", "numpy"} <= set(found)


def report(**options: Any) -> tuple[int, str]:
    out = io.StringIO()
    code = doctor.run_doctor(console=Console(file=out, width=200), **options)
    return code, out.getvalue()


def test_a_machine_without_a_gpu_is_fine(no_cuda: None) -> None:
    code, text = report()
    assert code == 0
    assert "auto takes cpu" in text
    for one in doctor.examine():
        assert one.name in text
        assert one.ok or f"{one.name}: {one.mend}" in text


def test_a_package_that_is_missing_is_not(no_cuda: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "PACKAGES", ("torch", "no-such-package"))
    code, text = report()
    assert code == 1
    assert "no-such-package: pip install no-such-package" in text


def test_everything_at_hand_needs_no_advice(cuda: None, monkeypatch: pytest.MonkeyPatch) -> None:
    _kernels(monkeypatch, None)
    monkeypatch.setattr(evaluation, "lpips_weights_available", lambda: True)
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: f"lib{name}.so")
    monkeypatch.setattr(shutil, "which", lambda *_, **__: "/usr/local/cuda/bin/nvcc")
    code, text = report(compile_kernels=True)
    assert code == 0
    assert "To mend" not in text


def test_command(no_cuda: None, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["doctor"])
    assert caught.value.code == 0
    assert "rasteriser" in capsys.readouterr().out
