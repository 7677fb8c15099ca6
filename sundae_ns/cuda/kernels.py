"""CUDA kernels of ``sundae_ns/csrc``, compiled at run time by NVRTC and launched through the driver's C interface.

Both libraries come with a CUDA build of torch and its driver; neither nvcc nor a CUDA toolkit is needed.
"""

from __future__ import annotations

import ctypes
import functools
import logging
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from ctypes import byref, c_char_p, c_double, c_int, c_size_t, c_uint, c_void_p
from importlib import resources

import torch
from torch import Tensor

from sundae_ns.core.errors import BackendError, MemoryExhaustedError, one_line, out_of_memory

Argument = Tensor | int | float | None
Launch = Callable[[int, Sequence[Argument]], None]
"""Launches a kernel for at least a number of threads: see :meth:`Kernel.__call__`."""

_log = logging.getLogger(__name__)


@functools.cache
def read_source(file: str) -> str:
    """A file of ``sundae_ns/csrc``, with the files that it includes."""
    source = (resources.files("sundae_ns") / "csrc" / file).read_text(encoding="utf-8")
    return re.sub(r'^#include "(.+)"$', lambda include: read_source(include[1]), source, flags=re.MULTILINE)


def compile_cubin(file: str, architecture: str, options: Sequence[str] = ()) -> bytes:
    """Compile a file of ``sundae_ns/csrc`` to machine code, for example ``sm_90``. Needs no device.

    ``BackendError`` if NVRTC is missing, or the source does not compile.
    """
    nvrtc = _library("nvrtc")
    nvrtc.nvrtcGetErrorString.restype = c_char_p
    program, size = c_void_p(), c_size_t()

    def check(result: int) -> None:
        if result != 0:
            text = nvrtc.nvrtcGetErrorString(result).decode()
            raise BackendError(f"NVRTC fails ({text}): install torch with its CUDA packages")

    check(nvrtc.nvrtcCreateProgram(byref(program), read_source(file).encode(), file.encode(), 0, None, None))
    try:
        flags = [f"--gpu-architecture={architecture}".encode(), *(option.encode() for option in options)]
        if (result := nvrtc.nvrtcCompileProgram(program, len(flags), (c_char_p * len(flags))(*flags))) != 0:
            check(nvrtc.nvrtcGetProgramLogSize(program, byref(size)))
            log = ctypes.create_string_buffer(size.value)
            check(nvrtc.nvrtcGetProgramLog(program, log))
            text = " ".join(log.value.decode(errors="replace").split()) or nvrtc.nvrtcGetErrorString(result).decode()
            raise BackendError(f"a CUDA kernel does not compile for {architecture} ({text}): update torch")
        check(nvrtc.nvrtcGetCUBINSize(program, byref(size)))
        code = ctypes.create_string_buffer(size.value)
        check(nvrtc.nvrtcGetCUBIN(program, code))
        return code.raw
    finally:
        nvrtc.nvrtcDestroyProgram(byref(program))


class Kernel:
    """The kernel ``name`` of a file of ``sundae_ns/csrc`` on one device, callable with tensors and numbers.

    ``options`` are further compiler options, ``block`` is the number of threads per block. ``BackendError`` if it
    cannot be compiled or loaded.
    """

    def __init__(self, file: str, name: str, device: torch.device, options: Sequence[str] = (), block: int = 128):
        self._driver, self._device, self._block = _library("cuda"), device, block
        self._function, self._context = c_void_p(), c_void_p()
        module = _module(file, tuple(options), device)
        with torch.cuda.device(device):
            _check(self._driver, self._driver.cuCtxGetCurrent(byref(self._context)))
            _check(self._driver, self._driver.cuModuleGetFunction(byref(self._function), module, name.encode()))

    def __call__(self, threads: int, arguments: Sequence[Argument]) -> None:
        """Launch at least this many threads on the current stream; ``BackendError`` if the driver refuses.

        Tensors, on the kernel's device, are passed as pointers to their first element, None as a null pointer, integers
        as C ints, floats as doubles. Integers are below 2^31, else a ``BackendError`` too.
        """
        values = [_as_c(argument, self._device) for argument in arguments]
        pointers = (c_void_p * len(values))(*(ctypes.addressof(value) for value in values))
        grid = (c_uint(-(-threads // self._block)), c_uint(1), c_uint(1))
        block = (c_uint(self._block), c_uint(1), c_uint(1))
        with torch.cuda.device(self._device):
            # Autograd's threads may launch kernels before torch has done any work on them.
            _check(self._driver, self._driver.cuCtxSetCurrent(self._context))
            stream = c_void_p(torch.cuda.current_stream(self._device).cuda_stream)
            launch = (*grid, *block, c_uint(0), stream, pointers, c_void_p())
            _check(self._driver, self._driver.cuLaunchKernel(self._function, *launch))


@functools.cache
def load_kernels(
    file: str, names: tuple[str, ...], options: tuple[str, ...], device: torch.device, block: int = 128
) -> dict[str, Launch]:
    """Kernels of one file by name, compiled on the first call; arguments and errors are those of :class:`Kernel`."""
    return {name: Kernel(file, name, device, options, block) for name in names}


@functools.cache
def kernels_where_possible(
    load: Callable[[torch.device], dict[str, Launch]], device: torch.device, instead: str
) -> dict[str, Launch] | None:
    """Kernels from ``load``; None on a CPU, and with one line in the log where they cannot be compiled or loaded.

    ``instead`` says what happens without them.
    """
    try:
        return load(device) if device.type == "cuda" else None
    except BackendError as error:
        _log.warning("%s, on %s: %s", instead, device, error)
        return None


@functools.cache
def _module(file: str, options: tuple[str, ...], device: torch.device) -> c_void_p:
    """A compiled file, loaded once for all of its kernels: compiling takes up to a second."""
    major, minor = torch.cuda.get_device_capability(device)
    code = compile_cubin(file, f"sm_{major}{minor}", options)
    driver = _library("cuda")
    module = c_void_p()
    with torch.cuda.device(device):
        # The driver's calls need torch's context on this thread; work on the device creates it.
        torch.zeros(1, device=device)
        _check(driver, driver.cuModuleLoadData(byref(module), code))
    return module


def _check(driver: ctypes.CDLL, result: int) -> None:
    if result != 0:
        text = c_char_p()
        driver.cuGetErrorString(result, byref(text))
        reason = text.value.decode() if text.value else f"error {result}"
        if result == 2:  # CUDA_ERROR_OUT_OF_MEMORY, unlike a missing kernel, may pass
            raise MemoryExhaustedError("the GPU's memory is full before a kernel is loaded; end other programs on it")
        raise BackendError(f"a CUDA kernel does not run ({reason}): update the driver")


def _as_c(argument: Argument, device: torch.device) -> ctypes.c_void_p | ctypes.c_int | ctypes.c_double:
    if argument is None:
        return c_void_p()
    if isinstance(argument, Tensor):
        if argument.device != device:
            raise BackendError(f"a kernel on {device} got a tensor on {argument.device}: pass tensors on {device}")
        return c_void_p(argument.data_ptr())
    if isinstance(argument, float):
        return c_double(argument)
    if abs(argument) >= 2**31:  # ctypes would cut the upper bits off
        raise BackendError(f"a kernel got {argument:,}, and counts to 2^31: use fewer Gaussians, or a smaller image")
    return c_int(argument)


def _library(name: str) -> ctypes.CDLL:
    """Load NVRTC of torch's CUDA version, or the driver."""
    if torch.version.cuda is None:
        raise BackendError("this torch is built without CUDA: install a CUDA build")
    file = "libcuda.so.1" if name == "cuda" else f"libnvrtc.so.{torch.version.cuda.split('.')[0]}"
    try:
        return ctypes.CDLL(file)
    except OSError as error:
        raise BackendError(f"{file} cannot be loaded ({error}): install torch with its CUDA packages") from error


@contextmanager
def naming_full_memory(num_gaussians: Callable[[], int]) -> Iterator[None]:
    """Turn errors of full memory inside the block into ``MemoryExhaustedError``, which names the Gaussians."""
    try:
        yield
    except torch.cuda.OutOfMemoryError as error:
        raise out_of_memory(error, num_gaussians()) from error
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, MemoryError) or "DefaultCPUAllocator" in str(error):
            cause = f"the memory is full with {num_gaussians():,} Gaussians ({one_line(error)})"
            raise MemoryExhaustedError(f"{cause}; give smaller images, or fewer Gaussians") from error
        raise
