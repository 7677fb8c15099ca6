"""Numbers, tensors and colours as callers give them: as lists, arrays or tensors; checked, and in one form."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from sundae_ns.core.errors import ConfigError, DataError, SundaeError, one_line

AnyArray = ArrayLike | Tensor  # lists too
_WHITE = {"uint8": 255.0, "uint16": 65535.0}  # of stored images, by their type


def numbers(values: Any, name: str, *shapes: tuple[int, ...]) -> Tensor:
    """Finite numbers of one of the shapes, float64 on the CPU; ``ConfigError`` for others, and for a lost gradient."""
    given = values.detach() if isinstance(values, Tensor) and not torch.is_grad_enabled() else values
    try:
        array = np.asarray(given.cpu().double() if isinstance(given, Tensor) else given)
    except (TypeError, ValueError, OverflowError, RuntimeError):  # the last for tensors on meta, and with a gradient
        array = np.empty(0)
    if array.shape not in shapes or array.dtype.kind not in "iuf" or not (np.abs(array) < 3e38).all():  # of float32
        wanted = " or ".join(" x ".join(map(str, shape)) or "1" for shape in shapes)
        raise ConfigError(f"{name} is not made of {wanted} finite numbers; give a list, array or detached tensor")
    return torch.from_numpy(array.astype(np.float64))


def whole(value: Any, name: str, least: int = 1, most: int = 2**63 - 1) -> int:
    """A whole number from ``least`` to ``most``; ``ConfigError`` for anything else."""
    if isinstance(value, (int, float)) and value > most:
        raise ConfigError(f"{name} is {value}; give at most {most:,}")
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)) or float(value) % 1 or value < least:
        raise ConfigError(f"{name} is {value!r:.80}; give a whole number, at least {least}")
    return int(value)


def floats(values: Any, name: str, *, colors: bool = False) -> Tensor:
    """Real numbers of any shape as a float32 tensor, on the CPU or where a tensor is; ``DataError`` for anything else.

    With ``colors``, values of 8 or 16 bits become [0, 1] by their type, and others have to be there.
    """
    given = values if isinstance(values, Tensor) else np.ma.filled(values, np.nan)  # masked entries have no value
    kind = str(given.dtype).removeprefix("torch.") if isinstance(given, Tensor) else given.dtype.name
    if not kind.startswith(("float", "bfloat", "int", "uint")) or (kind in _WHITE and not colors):
        raise DataError(f"{name} has values of type {kind}; give floating-point numbers")
    tensor = given.float() if isinstance(given, Tensor) else torch.from_numpy(given.astype(np.float32))
    if not colors or not tensor.numel():
        return tensor
    if kind in _WHITE:
        return tensor / _WHITE[kind]
    low, high = torch.stack(tensor.detach().aminmax()).tolist()
    if not (low >= -0.1 and high <= 1.1):  # resized images may exceed their range a little
        raise DataError(f"{name} has values from {low:g} to {high:g}; give uint8, or numbers in [0, 1]")
    return tensor


def positions(values: Any, name: str) -> Tensor:
    """As :func:`floats`; ``DataError`` too if float32 moves positions by 1e-4 of their spread, as those of surveys."""
    if (tensor := floats(values, name)) is values or not tensor.numel():
        return tensor
    exact = values.double() if isinstance(values, Tensor) else torch.from_numpy(np.asarray(values).astype(np.float64))
    moved, spread = ((exact - other).abs().amax(dim=-1).median() for other in (tensor, exact.median(dim=0).values))
    if moved > 1e-4 * spread > 0:  # medians, as outliers may lie far away; one point has no spread
        raise DataError(f"{name} is too far from zero for float32; subtract its median, and add it to what you export")
    return tensor


@contextmanager
def usual_defaults() -> Iterator[None]:
    """Compute in float32, with new tensors on the CPU and for autograd, in a block, whatever a caller has set."""
    given = torch.empty(0)
    with_gradients = torch.is_grad_enabled()
    with ExitStack() as stack:
        for kind in filter(torch.is_autocast_enabled, ("cpu", "cuda")):
            stack.enter_context(torch.autocast(kind, enabled=False))
        if given.dtype is not torch.float32 or given.device.type != "cpu" or given.is_inference():
            stack.callback(torch.set_default_dtype, given.dtype)
            torch.set_default_dtype(torch.float32)
            stack.enter_context(torch.device("cpu"))
            stack.enter_context(torch.inference_mode(False))
            stack.enter_context(torch.set_grad_enabled(with_gradients))  # the line above enables gradients
        yield


@contextmanager
def fitting() -> Iterator[None]:
    """:func:`usual_defaults`; what an argument of another type, such as None, raises becomes a ``ConfigError``."""
    try:
        with usual_defaults():
            yield
    except (TypeError, ValueError, AttributeError, LookupError, ArithmeticError, RuntimeError, OSError) as error:
        unfit = isinstance(error, NotImplementedError) or str(error).startswith("Boolean value of Tensor")  # by torch
        if isinstance(error, (SundaeError, RuntimeError, OSError)) and not (unfit or getattr(error, "filename", None)):
            raise
        raise ConfigError(f"an argument does not fit ({one_line(error)}); the docstring says what to give") from error
