"""What the doctor finds on simulated machines, and what it advises."""

import ctypes.util
import re
import sys
from importlib import metadata
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch
from command_line import run
from fake_colmap import FakeColmap

from sundae_ns.cli import doctor
from sundae_ns.core.errors import BackendError

KERNELS = ("sundae_ns.graph.neighbors.Kernel", "sundae_ns.head.fused.head_kernels", "sundae_ns.cuda.loss.loss_kernels")


def check(name, compile_kernels=False):
    """Whether a part is there, what the doctor says of it, and its remedy."""
    (part,) = [part for part in doctor.parts(compile_kernels) if part.name == name]
    return part.works, part.text, part.remedy


@pytest.fixture
def no_cuda(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


@pytest.fixture
def cuda(monkeypatch):
    """A CUDA device that only torch's answers simulate."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _: "Imaginary 9000")
    monkeypatch.setattr(doctor, "kernels_built", lambda: False)
    for kernel in KERNELS:
        monkeypatch.setattr(kernel, Mock())


def test_without_cuda_auto_selects_the_compiled_loops(no_cuda, monkeypatch):
    assert not check("CUDA")[0]
    assert "auto selects cpu" in check("rasteriser")[1]
    for name in ("gsplat kernels", "our kernels"):
        assert check(name, True)[:2] == (False, check(name)[1])
    monkeypatch.setattr("sundae_ns.rasterize.interface.numba_problem", lambda: "numba does not import (x; y)")
    works, text, remedy = check("rasteriser")
    assert (works, remedy) == (False, "pip install numba")
    assert re.match(r"auto selects reference.*numba does not import \(x; y\)", text)


def test_kernels_of_gsplat(cuda, monkeypatch):
    assert "Imaginary 9000" in check("CUDA")[1]
    select = Mock(side_effect=BackendError("its kernels do not run (no nvcc)"))
    monkeypatch.setattr("sundae_ns.rasterize.interface.select_backend", select)
    works, text, remedy = check("gsplat kernels")
    assert (works, text.partition(";")[0]) == (False, "not built yet"), "they are built only on request"
    assert remedy.startswith("sundae doctor --compile")
    assert check("gsplat kernels", True)[:2] == (False, "its kernels do not run (no nvcc)")
    select.assert_called_once_with("gsplat", "cuda")
    select.side_effect = None
    assert check("gsplat kernels", True)[0]
    assert "auto selects gsplat" in check("rasteriser")[1]


@pytest.mark.parametrize("kernel", KERNELS)
def test_our_kernels(cuda, monkeypatch, kernel):
    assert check("our kernels")[:2] == (True, "working")
    monkeypatch.setattr(kernel, Mock(side_effect=BackendError("it does not run (too old)")))
    works, text, remedy = check("our kernels")
    assert (works, text) == (False, "it does not run (too old)")
    assert "update the driver" in remedy


def test_built_kernels_are_found_in_torchs_folders(tmp_path, monkeypatch):
    package = tmp_path / "gsplat" / "__init__.py"
    package.parent.mkdir()
    package.touch()
    monkeypatch.setattr(doctor.importlib.util, "find_spec", lambda _: SimpleNamespace(origin=str(package)))
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path / "cache"))
    assert not doctor.kernels_built()
    for built in (tmp_path / "cache" / "py311_cu128" / "gsplat_cuda" / "gsplat_cuda.so", package.parent / "csrc.so"):
        built.parent.mkdir(parents=True, exist_ok=True)
        built.touch()
        assert doctor.kernels_built()
        built.unlink()


def compiler(folder, output):
    """A program that reports its CUDA version like nvcc."""
    folder.mkdir(parents=True, exist_ok=True)
    made = folder / "nvcc"
    made.write_text(f"#!/bin/sh\necho '{output}'\n")
    made.chmod(0o755)
    return made


@pytest.fixture
def no_compiler(tmp_path, monkeypatch):
    """An empty folder as PATH, for a torch built for CUDA 13.0."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", str(folder))
    for name in ("CUDA_HOME", "CUDA_PATH"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    return folder


def test_nvcc_of_the_same_major_version_suffices(no_compiler):
    for output, suffices in (("release 13.1, V13.1.88", True), ("release 3.0", False), ("hello", False)):
        compiler(no_compiler, f"Cuda compilation tools, {output}")
        works, text, remedy = check("nvcc")
        assert works == suffices
        assert ("this torch 13.0" in text) != suffices
        assert remedy.startswith("apt-get install cuda-toolkit-13-0 ")
        assert "export CUDA_HOME=/usr/local/cuda-13.0" in remedy


def test_nvcc_is_searched_like_torch_and_gsplat_do(no_compiler, monkeypatch):
    """gsplat calls nvcc from PATH, torch the one in CUDA_HOME; both must exist, and torch's version counts."""
    home = no_compiler.parent / "cuda"
    monkeypatch.setenv("CUDA_HOME", str(home))
    compiler(no_compiler, "release 12.0")
    assert f"not found in {home / 'bin'}" in check("nvcc")[1]
    nvcc = compiler(home / "bin", "release 13.0")
    assert check("nvcc")[1].startswith(f"{nvcc} 13.0")
    (no_compiler / "nvcc").unlink()
    assert check("nvcc")[1].startswith("not found in PATH")
    compiler(no_compiler, "release 12.0")
    monkeypatch.setattr(torch.version, "cuda", None)
    assert check("nvcc")[0], "there is no version to compare"


def test_the_oldest_driver_is_named(no_cuda, monkeypatch):
    for version, words in (("13.0", "driver 580 or newer"), ("12.8", "driver 525 or newer"), ("99.0", "of its CUDA")):
        monkeypatch.setattr(torch.version, "cuda", version)
        assert words in check("CUDA")[2]
    monkeypatch.setattr(torch.version, "cuda", None)
    assert check("CUDA") == (False, "this torch is built without CUDA", "pip install torch==2.11.0")


def test_programs_packages_and_weights(monkeypatch, tmp_path):
    path = tmp_path / "weights.pth"
    monkeypatch.setattr(doctor, "lpips_weights", lambda: ("https://a", path))
    works, _, remedy = check("LPIPS weights")
    assert (works, remedy) == (False, f"curl --location --create-dirs --output {path} https://a")
    path.touch()
    assert check("LPIPS weights")[0]
    monkeypatch.setenv("PATH", str(tmp_path))
    assert check("ffmpeg") == (False, "not found, for ns-render", "apt-get install ffmpeg")
    (tmp_path / "ffmpeg").touch(mode=0o755)
    assert check("ffmpeg")[:2] == (True, f"{tmp_path / 'ffmpeg'}, for ns-render")
    monkeypatch.setattr(ctypes.util, "find_library", lambda _: None)
    assert not check("libGL")[0]
    monkeypatch.setitem(sys.modules, "pycolmap", FakeColmap())
    assert check("pycolmap")[1].startswith("4.2.1, for ")
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    works, text, remedy = check("pycolmap")
    assert (works, text.partition(" (")[0], remedy) == (False, "camera poses need pycolmap", doctor.INSTALL)


def test_the_report_lists_every_part_and_each_remedy(no_cuda, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "300")
    assert run("doctor") == 0
    text = capsys.readouterr().out
    assert metadata.version("gsplat") in text
    for part in doctor.parts():
        assert part.name in text
        assert part.works != (f"{part.name}: {part.remedy}" in text)
    monkeypatch.setattr(doctor, "PACKAGES", ("torch", "no-such-package"))
    assert run("doctor") == 1, "training lacks something"
    assert "no-such-package: pip install no-such-package" in capsys.readouterr().out
    monkeypatch.setattr(doctor, "parts", lambda _: [doctor.Part("python", True, "3.11")])
    assert run("doctor") == 0
    assert "To fix" not in capsys.readouterr().out
