"""``sundae doctor``: which parts of SUNDAE run on this machine, and how to fix the others."""

from __future__ import annotations

import ctypes.util
import importlib.util
import os
import platform
import re
import shlex
import shutil
import subprocess
from collections.abc import Callable
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import torch
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sundae_ns.cli.options import Flag
from sundae_ns.core.errors import BackendError, SundaeError
from sundae_ns.core.metrics import lpips_weights
from sundae_ns.cuda import loss
from sundae_ns.data.reconstruct import INSTALL, pycolmap
from sundae_ns.graph import neighbors
from sundae_ns.head import fused
from sundae_ns.head.head import CompensationHead, HeadConfig
from sundae_ns.rasterize import interface

PACKAGES = ("sundae-ns", "nerfstudio", "gsplat", "torch", "torchvision", "numpy", "scipy", "tyro")


class Part(NamedTuple):
    """One line of the report."""

    name: str
    works: bool
    text: str  # Version or path, or why it does not work
    remedy: str = ""


def doctor(compile: Flag = False) -> int:  # noqa: A002
    """Check this machine, and print the command that installs or repairs each missing part.

    Args:
        compile: build gsplat's CUDA kernels if they are not built yet; this takes minutes and needs nvcc.
    """
    console, table = Console(), Table(show_header=False, box=None, pad_edge=False)
    with console.status("Building gsplat's kernels, some minutes" if compile else "Checking"):
        checked = parts(compile)
    for part in checked:
        missing = "[red]missing[/]" if part.name in PACKAGES else "[yellow]-[/]"  # training needs these
        table.add_row("[green]ok[/]" if part.works else missing, part.name, escape(part.text))
    console.print(table)
    if remedies := [f"  {part.name}: {part.remedy}" for part in checked if not part.works]:
        console.print("\n".join(["\nTo fix:", *remedies]), soft_wrap=True, highlight=False, markup=False)
    return int(any(part.name in PACKAGES and not part.works for part in checked))


def parts(compile_kernels: bool = False) -> list[Part]:
    """Check all parts, in the order of the report."""
    cuda = torch.version.cuda or ""
    url, weights = lpips_weights()
    driver = {"12": 525, "13": 580}.get(cuda.partition(".")[0], "of its CUDA version")  # the oldest for Linux
    fix_cuda = (
        "apt-get install nvidia-driver (Ubuntu: ubuntu-drivers install), reboot, and look at nvidia-smi. This torch "
        f"needs driver {driver} or newer; for an older one, pip install -c constraints-cuda12.txt -e ."
    )
    fix_nvcc = (
        f"apt-get install cuda-toolkit-{cuda.replace('.', '-')} from NVIDIA's repository (Ubuntu 24.04's own is 12.0), "
        f"then export CUDA_HOME=/usr/local/cuda-{cuda} PATH=/usr/local/cuda-{cuda}/bin:$PATH"
    )
    fix_weights = f"curl --location --create-dirs --output {shlex.quote(str(weights))} {url}"
    checks: list[tuple[str, Callable[[], str | None], str, str]] = [
        ("python", platform.python_version, "", ""),
        *((name, partial(metadata.version, name), f"pip install {name}", "") for name in PACKAGES),
        ("CUDA", _cuda, fix_cuda if cuda else "pip install torch==2.11.0", ""),
        ("nvcc", _nvcc, fix_nvcc, "the first build of gsplat's kernels"),
        ("gsplat kernels", partial(_gsplat, compile_kernels), "sundae doctor --compile, with CUDA and nvcc", ""),
        ("our kernels", _kernels, "update the driver; without them the CPU and PyTorch do their work", ""),
        ("rasteriser", _rasterizer, "pip install numba", ""),
        ("LPIPS weights", lambda: str(weights) if weights.is_file() else None, fix_weights, "LPIPS among the metrics"),
        ("libusb-1.0", partial(ctypes.util.find_library, "usb-1.0"), "apt-get install libusb-1.0-0", "ns-export"),
        ("libGL", partial(ctypes.util.find_library, "GL"), "apt-get install libgl1", "ns-export"),
        ("pycolmap", lambda: pycolmap().__version__, INSTALL, "sundae poses"),
        ("pillow-heif", partial(metadata.version, "pillow-heif"), INSTALL, "HEIC photos"),
        ("ffmpeg", partial(shutil.which, "ffmpeg"), "apt-get install ffmpeg", "ns-render"),
    ]
    return [_checked(*check) for check in checks]


def _checked(name: str, check: Callable[[], str | None], remedy: str, purpose: str) -> Part:
    """The part of a check, which returns nothing or raises an error if the part is missing."""
    version, problem = None, "not found"
    try:
        version = check()
    except SundaeError as error:
        problem = str(error)
    except metadata.PackageNotFoundError:
        problem = "not installed"
    return Part(name, bool(version), (version or problem) + (f", for {purpose}" if purpose else ""), remedy)


def _cuda() -> str:
    if torch.cuda.is_available():
        return f"{torch.cuda.get_device_name(0)}, torch built for {torch.version.cuda}"
    raise BackendError("no device that torch can use" if torch.version.cuda else "this torch is built without CUDA")


def _nvcc() -> str:
    """The compiler of gsplat's kernels: gsplat calls the one in PATH, torch the one in CUDA_HOME."""
    in_path, built = shutil.which("nvcc"), torch.version.cuda
    home = os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH")
    compiler = Path(home) / "bin" / "nvcc" if home else Path(in_path or "/usr/local/cuda/bin/nvcc")
    if not compiler.is_file() or not in_path:
        raise BackendError(f"not found in {'PATH' if compiler.is_file() else compiler.parent}")
    try:
        words = [str(compiler), "--version"]
        done = subprocess.run(words, capture_output=True, encoding="utf-8", errors="replace", check=True, timeout=60)
        release = "".join(re.findall(r"release (\d+\.\d+)", done.stdout)[:1])
    except (OSError, subprocess.SubprocessError):
        release = ""
    if built and release.partition(".")[0] != built.partition(".")[0]:  # torch refuses one of another major version
        raise BackendError(f"{compiler} has CUDA {release or 'of unknown version'}, this torch {built}")
    return f"{compiler} {release}"


def _gsplat(compile_kernels: bool) -> str:
    _cuda()
    if not compile_kernels and not kernels_built():
        raise BackendError("not built yet; the first training step builds them, in minutes")
    interface.select_backend("gsplat", "cuda")
    return "working"


def kernels_built() -> bool:
    """Whether gsplat's CUDA extension is installed or was built before; builds nothing."""
    if (spec := importlib.util.find_spec("gsplat")) is None or spec.origin is None:
        return False
    root = Path(os.environ.get("TORCH_EXTENSIONS_DIR") or Path(torch.hub.get_dir()).parents[1] / "torch_extensions")
    return any(Path(spec.origin).parent.glob("csrc*")) or any(root.glob("**/gsplat_cuda.so"))


def _kernels() -> str:
    _cuda()
    device = torch.device("cuda", 0)
    neighbors.load_kernel(device, torch.float32, 16)
    loss.loss_kernels(device)
    fused.head_kernels(device, torch.bfloat16, fused.head_options(CompensationHead(HeadConfig()).net, True))
    return "working"


def _rasterizer() -> str:
    if torch.cuda.is_available():
        return "auto selects gsplat, if its kernels work"
    if (problem := interface.numba_problem()) is not None:
        raise BackendError(f"auto selects reference, in plain PyTorch, several times slower than cpu: {problem}")
    return "auto selects cpu, compiled by numba; it suits small scenes, a capture needs CUDA"
