"""A field: the parameters of its primitives, and how they store colours."""

from __future__ import annotations

from collections import UserDict
from collections.abc import Mapping, MutableMapping
from typing import Any, Literal

from torch import Tensor

from sundae_ns.gaussians.parameters import num_primitives, rgb_to_sh, sh_degree

Encoding = Literal["harmonics", "logits"]
"""How a field stores colours. ``harmonics``: ``features_dc`` and ``features_rest`` are coefficients of spherical
harmonics. ``logits``: ``features_dc`` holds logits of view-independent colours, as splatfacto does at SH degree 0."""


class Field(UserDict[str, Any]):
    """Named parameters ``[N, ...]`` (see :mod:`sundae_ns.gaussians.parameters`) and the encoding of their colours.

    A view of the mapping that it is given: surgery that replaces a parameter here replaces it there too. ``len`` counts
    parameters, :attr:`num_primitives` counts primitives.

    Args:
        params: tensors, or ``Parameter``s of a field in training.
        encoding: how colours are stored.
    """

    def __init__(self, params: MutableMapping[str, Any], encoding: Encoding = "harmonics") -> None:
        # Not by UserDict, which would copy the mapping.
        self.data = params  # type: ignore[assignment]
        self.encoding: Encoding = encoding

    @property
    def num_primitives(self) -> int:
        """Number of primitives N."""
        return num_primitives(self)

    @property
    def sh_degree(self) -> int:
        """SH degree of the stored colours."""
        return sh_degree(self["features_rest"])

    def rows(self, mask: Tensor) -> Field:
        """The primitives under a mask, bool ``[N]``, as a field of its own."""
        return Field({name: value[mask] for name, value in self.items()}, self.encoding)

    def replaced(self, values: Mapping[str, Tensor]) -> Field:
        """A field of the same tensors but for these values, in a mapping of its own that surgery does not change."""
        return Field({**self, **values}, self.encoding)

    def as_harmonics(self) -> Field:
        """The field with colours as spherical harmonics; itself if it stores them so."""
        if self.encoding == "harmonics":
            return self
        colors = rgb_to_sh(self["features_dc"].detach().sigmoid())
        return Field({**self, "features_dc": colors}, "harmonics")


def as_field(params: Mapping[str, Any]) -> Field:
    """A mapping of parameters as a field; a plain mapping stores colours as harmonics."""
    return params if isinstance(params, Field) else Field(dict(params))
