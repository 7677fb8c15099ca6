"""Outputs of a model that are made when they are first asked for."""

from __future__ import annotations

from collections import UserDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch


@dataclass(frozen=True)
class Later:
    """An output to be."""

    make: Callable[[], Any]
    """Computes it. This may run in another thread, after the model has changed, so that it must hold what it reads."""


class LazyOutputs(UserDict[str, Any]):
    """Named outputs; one that is :class:`Later` is computed at its first access, without gradients, and then kept.

    nerfstudio's commands take one or two pictures of a frame and leave the rest; what nobody looks at costs nothing.
    Listing names, counting and ``in`` compute nothing. Not a ``dict``, because ``dict(outputs)`` and ``{**outputs}`` would
    then pass by the computing.
    """

    def __getitem__(self, name: str) -> Any:
        value = self.data[name]
        if isinstance(value, Later):
            with torch.no_grad():
                value = self.data[name] = value.make()
        return value
