"""``sundae doctor``: which parts of SUNDAE run on this machine, and how to fix the others."""

from __future__ import annotations

import ctypes.util
import importlib
import importlib.util
import os
import platform
import re
import shlex
import shutil
import subprocess
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import torch
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sundae_ns.cli.options import Flag
from sundae_ns.core.errors import BackendError
from sundae_ns.core.metrics import lpips_weights

PACKAGES = ("sundae-ns", "nerfstudio", "gsplat", "torch", "torchvision", "numpy", "scipy", "tyro")


class Missing(Exception):
    """A part is missing or does not work; the message says how."""


class Part(NamedTuple):
    """One line of the report."""

    name: str
    check: Callable[[], str]
    """What there is; raises :class:`Missing`."""
    remedy: str = ""
    """Command or advice for a part that is missing."""
    needed: bool = False
    """Whether training needs it."""


def doctor(compile: Flag = False) -> int:  # noqa: A002
    """Check this machine, and print the command that installs or repairs each missing part.

    Args:
        compile: build gsplat's CUDA kernels if they are not built yet; this takes minutes and needs nvcc.
    """
    console, table = Console(), Table(show_header=False, box=None, pad_edge=False)
    remedies, code = [], 0
    with console.status("Building gsplat's kernels, some minutes" if compile else "Checking"):
        for part in parts(compile):
            try:
                table.add_row("[green]ok[/]", part.name, escape(part.check()))
            except Missing as error:
                table.add_row("[red]missing[/]" if part.needed else "[yellow]-[/]", part.name, escape(str(error)))
                remedies.append(f"  {part.name}: {part.remedy}")
                code = max(code, int(part.needed))
    console.print(table)
    if remedies:
        console.print("\n".join(["\nTo fix:", *remedies]), soft_wrap=True, highlight=False, markup=False)
    return code


def parts(compile_kernels: bool = False) -> list[Part]:
    """All parts, in the order of the report."""
    cuda = torch.version.cuda or ""
    driver = {"12": 525, "13": 580}.get(cuda.partition(".")[0])  # oldest for Linux, by the toolkit's release notes
    home = f"/usr/local/cuda-{cuda}"
    url, path = lpips_weights()
    photos = 'pip install "sundae_ns[photos]"'
    return [
        Part("python", platform.python_version),
        *(Part(name, lambda name=name: _version(name), f"pip install {name}", True) for name in PACKAGES),  # type: ignore[misc]
        Part(
            "CUDA",
            _cuda,
            "apt-get install nvidia-driver (Ubuntu: ubuntu-drivers install), then reboot; nvidia-smi shows whether it "
            f"works. This torch needs driver {driver or 'of its CUDA version'} or newer; for an older one, pip install "
            "-c constraints-cuda12.txt -e ."
            if cuda
            else "pip install torch==2.11.0",
        ),
        Part(
            "nvcc",
            _nvcc,
            f"apt-get install cuda-toolkit-{cuda.replace('.', '-')} from NVIDIA's repository (Ubuntu 24.04's own "
            f"nvidia-cuda-toolkit is 12.0), then export CUDA_HOME={home} PATH={home}/bin:$PATH",
        ),
        Part(
            "gsplat kernels", lambda: _gsplat(compile_kernels), "sundae doctor --compile, once CUDA and nvcc are there"
        ),
        Part("our kernels", _kernels, "update the driver; without them the CPU and PyTorch do their work"),
        Part("rasteriser", _rasterizer, "pip install numba"),
        Part(
            "LPIPS weights",
            lambda: _system(str(path) if path.is_file() else None, "LPIPS among the metrics"),
            f"curl --location --create-dirs --output {shlex.quote(str(path))} {url}",
        ),
        Part(
            "libusb-1.0",
            lambda: _system(ctypes.util.find_library("usb-1.0"), "ns-export"),
            "apt-get install libusb-1.0-0",
        ),
        Part("libGL", lambda: _system(ctypes.util.find_library("GL"), "ns-export"), "apt-get install libgl1"),
        Part("pycolmap", lambda: _module("pycolmap", "sundae poses"), photos),
        Part("pillow-heif", lambda: _module("pillow_heif", "HEIC photos"), photos),
        Part("ffmpeg", lambda: _system(shutil.which("ffmpeg"), "ns-render"), "apt-get install ffmpeg"),
    ]


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError as error:
        raise Missing("not installed") from error


def _system(found: str | None, purpose: str) -> str:
    if not found:
        raise Missing(f"not found, for {purpose}")
    return f"{found}, for {purpose}"


def _module(name: str, purpose: str) -> str:
    try:
        return f"{importlib.import_module(name).__version__}, for {purpose}"
    except ImportError as error:
        absent = isinstance(error, ModuleNotFoundError) and error.name == name
        raise Missing(f"{'not installed' if absent else f'cannot be loaded ({error})'}, for {purpose}") from error


def _cuda() -> str:
    if not torch.cuda.is_available():
        raise Missing("no device that torch can use" if torch.version.cuda else "this torch is built without CUDA")
    return f"{torch.cuda.get_device_name(0)}, torch built for {torch.version.cuda}"


def _nvcc() -> str:
    """A CUDA compiler that builds gsplat's kernels: gsplat calls the one in PATH, torch the one in CUDA_HOME."""
    purpose, in_path = "gsplat needs it once, to build its kernels", shutil.which("nvcc")
    home = os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH")
    compiler = Path(home) / "bin" / "nvcc" if home else Path(in_path or "/usr/local/cuda/bin/nvcc")
    if not compiler.is_file() or not in_path:
        raise Missing(f"not found in {'PATH' if compiler.is_file() else compiler.parent}; {purpose}")
    try:
        words = [str(compiler), "--version"]
        done = subprocess.run(words, capture_output=True, encoding="utf-8", errors="replace", check=True, timeout=60)
        (release,) = re.findall(r"release (\d+\.\d+)", done.stdout)[:1] or [""]
    except (OSError, subprocess.SubprocessError):
        release = ""
    built = torch.version.cuda
    if built and release.partition(".")[0] != built.partition(".")[0]:  # torch refuses one of another major version
        raise Missing(f"{compiler} has CUDA {release or 'of unknown version'}, this torch {built}; {purpose}")
    return f"{compiler} {release}, for gsplat's kernels"


def _gsplat(compile_kernels: bool) -> str:
    from sundae_ns.rasterize.interface import select_backend

    if not torch.cuda.is_available():
        raise Missing("need a CUDA device")
    if not compile_kernels and not kernels_built():
        raise Missing("not built yet; the first training step builds them, in minutes")
    try:
        select_backend("gsplat", "cuda")
    except BackendError as error:
        raise Missing(str(error)) from error
    return "working"


def kernels_built() -> bool:
    """Whether gsplat's CUDA extension is installed or was built before; builds nothing."""
    spec = importlib.util.find_spec("gsplat")
    if spec is None or spec.origin is None:
        return False
    cache = os.environ.get("TORCH_EXTENSIONS_DIR")
    root = Path(cache) if cache else Path(torch.hub.get_dir()).parent.parent / "torch_extensions"
    return any(Path(spec.origin).parent.glob("csrc*")) or any(root.glob("**/gsplat_cuda.so"))


def _kernels() -> str:
    """This package's own: neighbour search, the loss, and the fused parts of the head."""
    if not torch.cuda.is_available():
        raise Missing("need a CUDA device; a CPU uses equivalent code")
    from sundae_ns.cuda import loss
    from sundae_ns.graph import neighbors
    from sundae_ns.head import fused
    from sundae_ns.head.head import CompensationHead, HeadConfig

    device = torch.device("cuda", 0)
    try:
        neighbors.load_kernel(device, torch.float32, 16)
        loss.loss_kernels(device)
        net = CompensationHead(HeadConfig()).net
        fused.head_kernels(device, torch.bfloat16, fused.head_options(net, True))
    except BackendError as error:
        raise Missing(str(error)) from error
    return "working"


def _rasterizer() -> str:
    """Which one ``auto`` selects."""
    from sundae_ns.rasterize.interface import numba_problem

    if torch.cuda.is_available():
        return "auto selects gsplat, if its kernels work"
    problem = numba_problem()
    if problem is not None:
        raise Missing(f"auto selects reference, in plain PyTorch, several times slower than cpu: {problem}")
    return "auto selects cpu, compiled by numba; it suits small scenes, a capture needs CUDA"
