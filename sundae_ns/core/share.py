"""A share of the Gaussians as an option. Apart from all that a library imports, which need not wait for tyro."""

from __future__ import annotations

from typing import Annotated

from tyro.constructors import PrimitiveConstructorSpec


def _share(words: list[str]) -> float:
    return float(words[0].removesuffix("%")) / (100 if words[0].endswith("%") else 1)


SHARE = PrimitiveConstructorSpec(1, "SHARE", _share, lambda x: isinstance(x, float | None), lambda x: [str(x)])
Share = Annotated[float, SHARE]  # 0.25 or 25%
