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


class Part(NamedTuple):
    """One line of the report."""

    name: str
    works: bool
    text: str
    """Version or path, or why it does not work."""
    remedy: str = ""
    needed: bool = False
    """Whether training needs it."""


def doctor(compile: Flag = False) -> int:  # noqa: A002
    """Check this machine, and print the command that installs or repairs each missing part.

    Args:
        compile: build gsplat's CUDA kernels if they are not built yet; this takes minutes and needs nvcc.
    """
    console, table = Console(), Table(show_header=False, box=None, pad_edge=False)
    with console.status("Building gsplat's kernels, some minutes" if compile else "Checking"):
        checked = parts(compile)
    for part in checked:
        missing = "[red]missing[/]" if part.needed else "[yellow]-[/]"
        table.add_row("[green]ok[/]" if part.works else missing, part.name, escape(part.text))
    console.print(table)
    remedies = [f"  {part.name}: {part.remedy}" for part in checked if not part.works]
    if remedies:
        console.print("\n".join(["\nTo fix:", *remedies]), soft_wrap=True, highlight=False, markup=False)
    return int(any(part.needed and not part.works for part in checked))


def parts(compile_kernels: bool = False) -> list[Part]:
    """Check all parts, in the order of the report."""
    cuda, (url, weights) = torch.version.cuda or "", lpips_weights()
    driver = {"12": 525, "13": 580}.get(cuda.partition(".")[0], "of its CUDA version")  # the oldest for Linux
    fix_cuda = (
        "apt-get install nvidia-driver (Ubuntu: ubuntu-drivers install), then reboot; nvidia-smi shows whether it "
        f"works. This torch needs driver {driver} or newer; for an older one, pip install -c constraints-cuda12.txt "
        "-e ."
    )
    home = f"/usr/local/cuda-{cuda}"
    fix_nvcc = (
        f"apt-get install cuda-toolkit-{cuda.replace('.', '-')} from NVIDIA's repository (Ubuntu 24.04's own "
        f"nvidia-cuda-toolkit is 12.0), then export CUDA_HOME={home} PATH={home}/bin:$PATH"
    )
    fix_weights = f"curl --location --create-dirs --output {shlex.quote(str(weights))} {url}"
    fix_ours = "update the driver; without them the CPU and PyTorch do their work"
    fix_photos, library = 'pip install "sundae_ns[photos]"', ctypes.util.find_library
    return [
        Part("python", True, platform.python_version()),
        *(Part(name, *_version(name), f"pip install {name}", True) for name in PACKAGES),
        Part("CUDA", *_cuda(), fix_cuda if cuda else "pip install torch==2.11.0"),
        Part("nvcc", *_nvcc(), fix_nvcc),
        Part("gsplat kernels", *_gsplat(compile_kernels), "sundae doctor --compile, once CUDA and nvcc are there"),
        Part("our kernels", *_loads(_load_kernels), fix_ours),
        Part("rasteriser", *_rasterizer(), "pip install numba"),
        Part("LPIPS weights", *_file(weights.is_file() and weights, "LPIPS among the metrics"), fix_weights),
        Part("libusb-1.0", *_file(library("usb-1.0"), "ns-export"), "apt-get install libusb-1.0-0"),
        Part("libGL", *_file(library("GL"), "ns-export"), "apt-get install libgl1"),
        Part("pycolmap", *_module("pycolmap", "sundae poses"), fix_photos),
        Part("pillow-heif", *_module("pillow_heif", "HEIC photos"), fix_photos),
        Part("ffmpeg", *_file(shutil.which("ffmpeg"), "ns-render"), "apt-get install ffmpeg"),
    ]


def _version(package: str) -> tuple[bool, str]:
    try:
        return True, metadata.version(package)
    except metadata.PackageNotFoundError:
        return False, "not installed"


def _file(path: object, purpose: str) -> tuple[bool, str]:
    return bool(path), f"{path or 'not found'}, for {purpose}"


def _module(name: str, purpose: str) -> tuple[bool, str]:
    try:
        return True, f"{importlib.import_module(name).__version__}, for {purpose}"
    except ImportError as error:
        absent = isinstance(error, ModuleNotFoundError) and error.name == name
        return False, f"{'not installed' if absent else f'cannot be loaded ({error})'}, for {purpose}"


def _cuda() -> tuple[bool, str]:
    if torch.cuda.is_available():
        return True, f"{torch.cuda.get_device_name(0)}, torch built for {torch.version.cuda}"
    return False, "no device that torch can use" if torch.version.cuda else "this torch is built without CUDA"


def _nvcc() -> tuple[bool, str]:
    """A CUDA compiler that builds gsplat's kernels: gsplat calls the one in PATH, torch the one in CUDA_HOME."""
    purpose, in_path = "gsplat needs it once, to build its kernels", shutil.which("nvcc")
    home = os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH")
    compiler = Path(home) / "bin" / "nvcc" if home else Path(in_path or "/usr/local/cuda/bin/nvcc")
    if not compiler.is_file() or not in_path:
        return False, f"not found in {'PATH' if compiler.is_file() else compiler.parent}; {purpose}"
    try:
        words = [str(compiler), "--version"]
        done = subprocess.run(words, capture_output=True, encoding="utf-8", errors="replace", check=True, timeout=60)
        (release,) = re.findall(r"release (\d+\.\d+)", done.stdout)[:1] or [""]
    except (OSError, subprocess.SubprocessError):
        release = ""
    built = torch.version.cuda
    if built and release.partition(".")[0] != built.partition(".")[0]:  # torch refuses one of another major version
        return False, f"{compiler} has CUDA {release or 'of unknown version'}, this torch {built}; {purpose}"
    return True, f"{compiler} {release}, for gsplat's kernels"


def _loads(load: Callable[[], object]) -> tuple[bool, str]:
    if not torch.cuda.is_available():
        return False, "need a CUDA device; a CPU uses equivalent code"
    try:
        load()
    except BackendError as error:
        return False, str(error)
    return True, "working"


def _gsplat(compile_kernels: bool) -> tuple[bool, str]:
    from sundae_ns.rasterize.interface import select_backend

    if torch.cuda.is_available() and not compile_kernels and not kernels_built():
        return False, "not built yet; the first training step builds them, in minutes"
    return _loads(lambda: select_backend("gsplat", "cuda"))


def kernels_built() -> bool:
    """Whether gsplat's CUDA extension is installed or was built before; builds nothing."""
    spec = importlib.util.find_spec("gsplat")
    if spec is None or spec.origin is None:
        return False
    cache = os.environ.get("TORCH_EXTENSIONS_DIR")
    root = Path(cache) if cache else Path(torch.hub.get_dir()).parent.parent / "torch_extensions"
    return any(Path(spec.origin).parent.glob("csrc*")) or any(root.glob("**/gsplat_cuda.so"))


def _load_kernels() -> None:
    from sundae_ns.cuda.loss import loss_kernels
    from sundae_ns.graph.neighbors import load_kernel
    from sundae_ns.head.fused import head_kernels, head_options
    from sundae_ns.head.head import CompensationHead, HeadConfig

    device = torch.device("cuda", 0)
    load_kernel(device, torch.float32, 16)
    loss_kernels(device)
    head_kernels(device, torch.bfloat16, head_options(CompensationHead(HeadConfig()).net, True))


def _rasterizer() -> tuple[bool, str]:
    """The backend that ``auto`` selects."""
    from sundae_ns.rasterize.interface import numba_problem

    if torch.cuda.is_available():
        return True, "auto selects gsplat, if its kernels work"
    problem = numba_problem()
    if problem is not None:
        return False, f"auto selects reference, in plain PyTorch, several times slower than cpu: {problem}"
    return True, "auto selects cpu, compiled by numba; it suits small scenes, a capture needs CUDA"
