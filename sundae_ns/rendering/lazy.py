"""Outputs of a model that are computed on first access."""

from __future__ import annotations

from collections import UserDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch


@dataclass(frozen=True)
class Later:
    """An output that is not computed yet."""

    make: Callable[[], Any]
    """Computes it. It may run in another thread after the model has changed, so it must hold what it reads."""


class LazyOutputs(UserDict[str, Any]):
    """Named outputs. One that is :class:`Later` is computed on first access, without gradients, and then kept.

    nerfstudio's commands read one or two outputs of a frame; the others cost nothing. Listing names, counting and
    ``in`` compute nothing. It is not a ``dict``, because ``dict(outputs)`` and ``{**outputs}`` would then skip the
    computation.
    """

    def __getitem__(self, name: str) -> Any:
        value = self.data[name]
        if isinstance(value, Later):
            with torch.no_grad():
                value = self.data[name] = value.make()
        return value
