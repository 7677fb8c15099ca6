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
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import torch
from rich.console import Console
from rich.markup import escape
from rich.table import Table

PACKAGES = ("sundae-ns", "nerfstudio", "gsplat", "torch", "torchvision", "numpy", "scipy", "tyro")
LEAST_DRIVERS = {"12": 525, "13": 580}
"""Oldest Linux driver by the CUDA version of torch, from the release notes of NVIDIA's CUDA toolkit."""
NOT_BUILT = "not built yet"


@dataclass(frozen=True)
class Finding:
    """One line of the report."""

    name: str
    ok: bool
    detail: str
    fix: str = ""
    """Command or advice that fixes it."""
    needed: bool = False
    """Whether training needs it."""


def versions() -> list[Finding]:
    """Versions of Python and of the required packages."""
    findings = [Finding("python", True, platform.python_version())]
    for package in PACKAGES:
        try:
            findings.append(Finding(package, True, metadata.version(package)))
        except metadata.PackageNotFoundError:
            findings.append(Finding(package, False, "not installed", f"pip install {package}", needed=True))
    return findings


def cuda() -> Finding:
    """Whether torch finds a CUDA device."""
    if torch.cuda.is_available():
        return Finding("CUDA", True, f"{torch.cuda.get_device_name(0)}, torch built for {torch.version.cuda}")
    if torch.version.cuda is None:
        return Finding("CUDA", False, "this torch is built without CUDA", "pip install torch==2.11.0")
    fix = (
        "apt-get install nvidia-driver (Ubuntu: ubuntu-drivers install), then reboot; nvidia-smi shows whether it works"
    )
    least = LEAST_DRIVERS.get(torch.version.cuda.partition(".")[0])
    if least:
        fix += f", and its version: this torch is built for CUDA {torch.version.cuda}, which needs {least} or newer"
        if torch.version.cuda.partition(".")[0] == "13":
            fix += "; with an older driver, pip install -c constraints-cuda12.txt -e ."
    return Finding("CUDA", False, "no device that torch can use", fix)


def nvcc() -> Finding:
    """Whether a CUDA compiler can build gsplat's kernels; torch refuses one of another major version."""
    purpose = "gsplat needs it once, to build its kernels"
    built = torch.version.cuda
    fix = "NVIDIA's CUDA toolkit of torch's version, with CUDA_HOME set to it and its bin folder in PATH"
    if built:
        place = f"/usr/local/cuda-{built}"
        fix = (
            f"apt-get install cuda-toolkit-{built.replace('.', '-')} from NVIDIA's repository (Ubuntu 24.04's own "
            f"nvidia-cuda-toolkit is 12.0), then export CUDA_HOME={place} PATH={place}/bin:$PATH"
        )
    in_path = shutil.which("nvcc")
    home = os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH")
    # The same search order as torch's.
    found = Path(in_path) if in_path and not home else Path(home or "/usr/local/cuda") / "bin" / "nvcc"
    if not found.is_file():
        where = f" in {found.parent}, the folder that CUDA_HOME names" if home else ""
        return Finding("nvcc", False, f"not found{where}; {purpose}", fix)
    if not in_path:  # gsplat calls nvcc by name before torch builds
        detail = f"{found} is not in PATH; {purpose}"
        return Finding("nvcc", False, detail, f"export PATH={found.parent}:$PATH")
    release = _release_of(found)
    if built and release.partition(".")[0] != built.partition(".")[0]:
        detail = f"{found} has CUDA {release or 'of unknown version'}, this torch is built for {built}; {purpose}"
        return Finding("nvcc", False, detail, fix)
    return Finding("nvcc", True, f"{found} {release}, for gsplat's kernels")


def _release_of(compiler: Path) -> str:
    """CUDA version that a compiler reports, such as ``13.0``; empty if it reports none."""
    try:
        words = [str(compiler), "--version"]
        done = subprocess.run(words, capture_output=True, encoding="utf-8", errors="replace", check=True, timeout=60)
    except (OSError, subprocess.SubprocessError):
        return ""
    return next(iter(re.findall(r"release (\d+\.\d+)", done.stdout)), "")


def kernels_built() -> bool:
    """Whether gsplat's CUDA extension is installed or was built before; builds nothing."""
    spec = importlib.util.find_spec("gsplat")
    if spec is None or spec.origin is None:
        return False
    if any(Path(spec.origin).parent.glob("csrc*")):
        return True
    cache = os.environ.get("TORCH_EXTENSIONS_DIR")
    root = Path(cache) if cache else Path(torch.hub.get_dir()).parent.parent / "torch_extensions"
    return any(root.glob("**/gsplat_cuda.so"))


def kernels(compile_kernels: bool) -> Finding:
    """Whether gsplat's kernels run; ``compile_kernels`` builds missing ones."""
    if not torch.cuda.is_available():
        fix = "sundae doctor --compile, once there is a CUDA device"
        return Finding("gsplat kernels", False, "need a CUDA device", fix)
    if not compile_kernels and not kernels_built():
        fix = "sundae doctor --compile (takes minutes; otherwise the first training step builds them)"
        return Finding("gsplat kernels", False, NOT_BUILT, fix)
    from sundae_ns.errors import BackendError
    from sundae_ns.rasterization import select_backend

    try:
        select_backend("gsplat", "cuda")
    except BackendError as error:
        return Finding("gsplat kernels", False, str(error), "sundae doctor --compile")
    return Finding("gsplat kernels", True, "working")


def own_kernels() -> Finding:
    """Whether this package's kernels compile and load: neighbour search, the loss, and the fused parts of the head."""
    name = "our kernels"
    if not torch.cuda.is_available():
        return Finding(name, False, "need a CUDA device", "nothing; a CPU uses equivalent code")
    from sundae_ns.compensation import CompensationHead, HeadConfig, fused
    from sundae_ns.errors import BackendError
    from sundae_ns.gpu import loss
    from sundae_ns.graphs import neighbors

    device = torch.device("cuda", 0)
    try:
        neighbors.load_kernel(device, torch.float32, 16)
        loss.loss_kernels(device)
        net = CompensationHead(HeadConfig()).net
        fused.head_kernels(device, torch.bfloat16, fused.head_options(net, True))
    except BackendError as error:
        cause, fix = str(error).rsplit(": ", 1)
        detail = f"{cause}: neighbours are searched on the CPU; head and SSIM run layer by layer"
        return Finding(name, False, detail, fix)
    return Finding(name, True, "working")


def rasterizer(kernels_finding: Finding) -> Finding:
    """Which rasteriser ``auto`` selects."""
    from sundae_ns.rasterization import numba_problem

    if torch.cuda.is_available():
        chosen = "gsplat" if kernels_finding.ok else "gsplat, after its kernels are built"
        if not kernels_finding.ok and kernels_finding.detail != NOT_BUILT:
            chosen = "reference, in plain PyTorch, which is slow; fix gsplat's kernels"
        return Finding("rasteriser", True, f"auto selects {chosen}")
    problem = numba_problem()
    if problem is None:
        detail = "auto selects cpu, compiled by numba; it suits small scenes, a capture needs CUDA"
        return Finding("rasteriser", True, detail)
    cause, fix = problem.rsplit("; ", 1)
    detail = f"auto selects reference, in plain PyTorch; it is several times slower than cpu. {cause}"
    return Finding("rasteriser", False, detail, fix)


def lpips() -> Finding:
    """Whether the weights of LPIPS are on disk."""
    from sundae_ns.evaluation import lpips_weights_available, lpips_weights_path, lpips_weights_url

    if lpips_weights_available():
        return Finding("LPIPS weights", True, "on disk")
    fix = f"curl --location --create-dirs --output {shlex.quote(str(lpips_weights_path()))} {lpips_weights_url()}"
    return Finding("LPIPS weights", False, "missing; metrics leave out LPIPS", fix)


def installed(name: str, place: str | None, purpose: str, package: str) -> Finding:
    """Whether a library or program of the system has a place; if not, the package of apt that has it."""
    if place:
        return Finding(name, True, f"{place}, for {purpose}")
    return Finding(name, False, f"not found, for {purpose}", f"apt-get install {package}")


def photo_packages() -> list[Finding]:
    """Whether the packages of ``sundae poses`` are installed and can be loaded."""
    from sundae_ns.poses.reconstruct import INSTALL

    findings = []
    for name, module, purpose in (
        ("pycolmap", "pycolmap", "sundae poses, which finds camera poses of photos"),
        ("pillow-heif", "pillow_heif", "HEIC photos"),
    ):
        try:
            found = importlib.import_module(module)
        except ImportError as error:
            missing = isinstance(error, ModuleNotFoundError) and error.name == module
            cause = "not installed" if missing else f"cannot be loaded ({error})"
            findings.append(Finding(name, False, f"{cause}, for {purpose}", INSTALL))
        else:
            findings.append(Finding(name, True, f"{found.__version__}, for {purpose}"))
    return findings


def examine(compile_kernels: bool = False) -> list[Finding]:
    """All findings, in the order of the report."""
    kernels_finding = kernels(compile_kernels)
    return [
        *versions(),
        cuda(),
        nvcc(),
        kernels_finding,
        own_kernels(),
        rasterizer(kernels_finding),
        lpips(),
        installed("libusb-1.0", ctypes.util.find_library("usb-1.0"), "ns-export", "libusb-1.0-0"),
        installed("libGL", ctypes.util.find_library("GL"), "ns-export", "libgl1"),
        *photo_packages(),
        # ns-render requires it even if it writes only images.
        installed("ffmpeg", shutil.which("ffmpeg"), "ns-render", "ffmpeg"),
    ]


def run_doctor(compile_kernels: bool = False) -> int:
    """Print the report, and build gsplat's kernels if asked to; the exit code is 1 if training lacks something."""
    console = Console()
    with console.status("Building gsplat's kernels, some minutes" if compile_kernels else "Checking"):
        findings = examine(compile_kernels)
    table = Table(show_header=False, box=None, pad_edge=False)
    for finding in findings:
        mark = "[green]ok[/]" if finding.ok else "[red]missing[/]" if finding.needed else "[yellow]-[/]"
        table.add_row(mark, finding.name, escape(finding.detail))
    console.print(table)
    fixes = [finding for finding in findings if not finding.ok and finding.fix]
    if fixes:
        console.print("\nTo fix:")
        for finding in fixes:
            console.print(f"  {finding.name}: {finding.fix}", soft_wrap=True, highlight=False, markup=False)
    return int(any(finding.needed and not finding.ok for finding in findings))
