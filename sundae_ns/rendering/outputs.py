"""Pictures beside the two that everybody asks for, each made when it is looked at, and what stands for an empty crop."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from torch import Tensor

from sundae_ns.errors import DataError
from sundae_ns.evaluation import display
from sundae_ns.gaussians import FEATURES
from sundae_ns.pruning import PruningConfig, response
from sundae_ns.rendering.lazy import Later
from sundae_ns.rendering.render import Style, splat
from sundae_ns.rendering.views import View

OUTPUTS = ("rgb", "base_rgb", "depth", "accumulation", "features", "response")
"""What a picture has beside its background, in the order in which viewers list it."""

FieldKey = tuple[int, int]
"""Tells one state of a field from the next: its primitives, and how often it was pruned."""


class ShownResponse:
    """Spectral response of a field for display, kept until the field is pruned again."""

    def __init__(self) -> None:
        # One tuple, because the viewer asks from its own thread.
        self._last: tuple[FieldKey | None, Tensor | None] = (None, None)

    @property
    def of(self) -> FieldKey | None:
        """The field that is kept; None before the first."""
        return self._last[0]

    def values(self, field: Mapping[str, Tensor], key: FieldKey | None, config: PruningConfig) -> Tensor | None:
        """Values in [0, 1] ``[N]``; None where there is nothing to show, as of one primitive, which has no neighbour.

        Args:
            field: the primitives.
            key: their state; None for a field that still grows, whose response is not shown.
            config: what the response is computed by.
        """
        if key is None:
            return None
        of, values = self._last
        if of != key:
            try:
                values = display.response_values(response(field, config).magnitude)
            except DataError:
                values = None
            self._last = (key, values)
        return values


def late_outputs(
    pictures: Mapping[str, Any],
    drawn: Mapping[str, Tensor],
    field: Mapping[str, Tensor],
    mask: Tensor | None,
    view: View,
    style: Style,
    values: Callable[[], Tensor | None],
) -> dict[str, Later]:
    """``depth``, ``features`` (principal components as colours) and ``response`` (of the primitives seen), to be made.

    Args:
        pictures: from :func:`sundae_ns.rendering.render.render`; depth and features that are not there are splatted when they
            are looked at, features even of a picture that the head took no part in; but not where other ranks would have to.
        drawn: the primitives that they were made of.
        field: all primitives. Both mappings are kept and have to stay as they are.
        mask: which of them were drawn, bool ``[N]``; None for all.
        view: the camera.
        style: how the pictures were made.
        values: gives the response of all primitives, from 0 to 1 ``[N]``, or None.
    """
    alpha = pictures["accumulation"]
    return {
        "depth": Later(partial(_depth_image, pictures.get("depth"), drawn, view, style, alpha)),
        "features": Later(partial(_feature_colors, pictures.get("feature_image"), field, drawn, view, style, alpha)),
        "response": Later(partial(_response_image, field, mask, view, style, values)),
    }


def _depth_image(depth: Tensor | None, drawn: Mapping[str, Tensor], view: View, style: Style, alpha: Tensor) -> Tensor:
    if depth is None:
        depth = splat(drawn, view, drawn["opacities"], style, render_depth=True).depth
        assert depth is not None
    return display.fill_depth(depth, alpha)


def _feature_colors(
    image: Tensor | None,
    field: Mapping[str, Tensor],
    drawn: Mapping[str, Tensor],
    view: View,
    style: Style,
    alpha: Tensor,
) -> Tensor:
    if image is None or image.shape[-1] == 0:
        if style.head is None or style.arrivals is not None:
            return alpha.new_zeros(*alpha.shape[:2], 3)
        image = splat(drawn, view, drawn[FEATURES], style).colors
    return display.feature_colors(image, *display.principal_components(field[FEATURES]), alpha)


def _response_image(
    field: Mapping[str, Tensor],
    mask: Tensor | None,
    view: View,
    style: Style,
    values: Callable[[], Tensor | None],
) -> Tensor:
    shown = values()
    if shown is None:
        return field["means"].new_zeros(view.height, view.width, 1)
    if mask is not None:
        field, shown = {name: value[mask] for name, value in field.items()}, shown[mask]
    return splat(field, view, shown[:, None], style).colors


def empty_outputs(width: int, height: int, background: Tensor) -> dict[str, Any]:
    """What a crop without primitives shows: the same keys and shapes as any other picture."""
    picture = background.expand(height, width, 3)
    zeros = background.new_zeros(height, width, 1)
    return {
        "rgb": picture,
        "base_rgb": picture,
        "depth": zeros + 10,
        "accumulation": zeros,
        "features": background.new_zeros(height, width, 3),
        "response": zeros,
        "background": picture,
    }
