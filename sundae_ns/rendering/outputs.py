"""Outputs of a model that are computed on first access, and the outputs of an empty crop."""

from __future__ import annotations

from collections import UserDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sundae_ns.errors import DataError
from sundae_ns.evaluation import display
from sundae_ns.gaussians import FEATURES
from sundae_ns.gaussians.field import Field
from sundae_ns.pruning import PruneRule, response
from sundae_ns.rendering.render import RenderSettings, splat
from sundae_ns.rendering.views import View

OUTPUTS = ("rgb", "base_rgb", "depth", "accumulation", "features", "response")
"""Outputs beside the background, in the order in which viewers list them."""

FieldKey = tuple[int, int]
"""Identifies a state of a field: number of primitives, and number of prunes."""


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


class ShownResponse:
    """Spectral response of a field for display, kept until the field is pruned again."""

    def __init__(self) -> None:
        # The field, and its values. One tuple, because the viewer reads it from its own thread.
        self._last: tuple[FieldKey | None, Tensor | None] = (None, None)

    def values(self, field: Field, key: FieldKey | None, rule: PruneRule) -> Tensor | None:
        """Values in [0, 1] ``[N]``; None if there is no response, as for a single primitive without neighbours.

        Args:
            field: the primitives.
            key: their state; None for a field that still grows, whose response is not shown.
            rule: signal and graph.
        """
        if key is None:
            return None
        of, values = self._last
        if of != key:
            try:
                values = display.response_values(response(field, rule))
            except DataError:
                values = None
            self._last = (key, values)
        return values


def late_outputs(
    images: Mapping[str, Any],
    drawn: Field,
    field: Field,
    mask: Tensor | None,
    view: View,
    settings: RenderSettings,
    values: Callable[[], Tensor | None],
    *,
    splattable: bool,
) -> LazyOutputs:
    """All outputs but the background; ``depth``, ``features`` and ``response`` are computed on access.

    ``features`` shows principal components as colours, ``response`` the response of the visible primitives.

    Args:
        images: from a render. Depth and features that are missing are splatted on access.
        drawn: the primitives of these images.
        field: all primitives. Both fields are kept, so their mappings must not change.
        mask: the primitives that were drawn, bool ``[N]``; None for all.
        view: the camera.
        settings: of the render.
        values: gives the response of all primitives, in [0, 1] ``[N]``, or None.
        splattable: whether there are features that this process can splat by itself; otherwise their image is black.
    """
    alpha, found_depth, found_features = (images.get(name) for name in ("accumulation", "depth", "feature_image"))
    assert alpha is not None

    def depth() -> Tensor:
        found = found_depth
        if found is None:
            found = splat(drawn, view, drawn["opacities"], settings, render_depth=True).depth
            assert found is not None
        return display.fill_depth(found, alpha)

    def features() -> Tensor:
        image = found_features
        if image is None or image.shape[-1] == 0:
            if not splattable:
                return alpha.new_zeros(*alpha.shape[:2], 3)
            image = splat(drawn, view, drawn[FEATURES], settings).colors
        return display.feature_colors(image, *display.principal_components(field[FEATURES]), alpha)

    def response_image() -> Tensor:
        shown = values()
        if shown is None:
            return field["means"].new_zeros(view.height, view.width, 1)
        visible = field if mask is None else field.rows(mask)
        return splat(visible, view, (shown if mask is None else shown[mask])[:, None], settings).colors

    late = {"depth": Later(depth), "features": Later(features), "response": Later(response_image)}
    outputs = {**images, **late}
    return LazyOutputs({name: outputs[name] for name in OUTPUTS})


def empty_outputs(width: int, height: int, background: Tensor) -> dict[str, Any]:
    """Outputs of a crop without primitives: the keys and shapes of any other image."""
    image = background.expand(height, width, 3)
    zeros = background.new_zeros(height, width, 1)
    return {
        "rgb": image,
        "base_rgb": image,
        "depth": zeros + 10,
        "accumulation": zeros,
        "features": background.new_zeros(height, width, 3),
        "response": zeros,
        "background": image,
    }
