"""The head of a search: enabled if it is small beside the field, and removed if it does not pay."""

from __future__ import annotations

from dataclasses import replace

from nerfstudio.utils.rich_utils import CONSOLE

from sundae_ns.compensation import HeadConfig
from sundae_ns.compensation.head import SIZES
from sundae_ns.gaussians import FEATURES
from sundae_ns.gaussians.surgery import narrow
from sundae_ns.storage import accounting
from sundae_ns.training.budget.search import SearchProgress
from sundae_ns.training.budget.searched_field import SearchedField
from sundae_ns.training.field_state import FieldState

HEAD_SHARE = 0.25
"""Largest share of the field's bytes that a head may take, and of a primitive's bytes that its features may take."""
WIDTHS = (1, 5, 13, 29)
"""Numbers of features that splat without padding."""


def head_for(stored: int, primitives: int, largest: HeadConfig) -> HeadConfig | None:
    """The largest head, at most ``largest``, that is small beside ``stored`` bytes without features; else None."""
    narrower = [width for width in WIDTHS if width < largest.num_features]
    floats = HEAD_SHARE * stored / primitives / accounting.BYTES_PER_FLOAT
    widths = [width for width in (*narrower, largest.num_features) if width <= floats]
    sizes = list(SIZES)[: list(SIZES).index(largest.size) + 1]
    for size in reversed(sizes if widths else []):
        config = replace(largest, size=size, num_features=widths[-1])  # type: ignore[arg-type]
        if accounting.bytes_of_head(config) <= HEAD_SHARE * stored:
            return config
    return None


def chosen_head(search: SearchProgress, largest: HeadConfig | None) -> HeadConfig | None:
    """The head that a search has chosen, before that the largest that it may choose; None for none."""
    if largest is None or search.head_dropped:
        return None
    if not search.head_size:
        return largest
    return replace(largest, size=search.head_size, num_features=search.num_features)  # type: ignore[arg-type]


def may_pay(searched: SearchedField, largest: HeadConfig | None) -> bool:
    """Whether a head, at most the one given, is small beside the field without it."""
    count = searched.count
    return largest is not None and head_for(count * searched.row, count, largest) is not None


def enable(searched: SearchedField, largest: HeadConfig | None, primitives: int) -> bool:
    """Enable the head that suits a field of ``primitives``; returns whether there is one."""
    state, search = searched.state, searched.search
    config = None if largest is None else head_for(primitives * searched.row, primitives, largest)
    if config is None or state.head is None:
        return False
    search.head, search.head_size, search.num_features = True, config.size, config.num_features
    if config != state.head.config:
        state.head.resize(config)
        narrow(state.field, state.optimizers, FEATURES, config.num_features)
    searched.engine.enable_head(state, True)
    CONSOLE.log(f"a {config.size} head is enabled, with {config.num_features} features a primitive")
    searched.restart_rates(head=True)
    return True


def remove(searched: SearchedField) -> None:
    """Remove the head and the features for good."""
    search = searched.search
    searched.state.remove_head()
    search.head_dropped, search.head_size, search.num_features = True, "", 0


def reshape(state: FieldState, search: SearchProgress, largest: HeadConfig | None) -> None:
    """Give field and head the shapes that a search has left in a checkpoint; values are loaded afterwards."""
    field, chosen = state.field, chosen_head(search, largest)
    if search.degree >= 0:
        rest = field["features_rest"]
        rest.data = rest.data[:, : (search.degree + 1) ** 2 - 1]
    if chosen is None:
        state.remove_head()
    elif state.head is not None and state.head.config != chosen:
        state.reshape_head(chosen)
