"""The head of a search: enabled if it is small beside the field, removed if it does not pay, reshaped for a checkpoint."""

from __future__ import annotations

import math

from nerfstudio.utils.rich_utils import CONSOLE

from sundae_ns.compensation import HeadConfig
from sundae_ns.gaussians import FEATURES
from sundae_ns.gaussians.snapshot import narrow
from sundae_ns.training.budget import sizes
from sundae_ns.training.budget.search import Search
from sundae_ns.training.budget.searched_field import SearchedField
from sundae_ns.training.field_state import FieldState


def follow(state: FieldState, search: Search) -> None:
    """Enable or disable the head as the search says."""
    state.head_starts_at = -math.inf if search.head else math.inf


def may_pay(searched: SearchedField, largest: HeadConfig | None) -> bool:
    """Whether a head, at most the one given, is small beside the field without it."""
    count = searched.count
    return largest is not None and sizes.head_for(count * searched.row, count, largest) is not None


def enable(searched: SearchedField, search: Search, largest: HeadConfig | None, primitives: int) -> bool:
    """Enable the head that suits a field of ``primitives``; returns whether there is one."""
    state = searched.state
    config = None if largest is None else sizes.head_for(primitives * searched.row, primitives, largest)
    if config is None or state.head is None:
        return False
    search.head, search.head_size, search.num_features = True, config.size, config.num_features
    if config != state.head.config:
        state.head.resize(config)
        narrow(state.field, state.optimizers, FEATURES, config.num_features)
    follow(state, search)
    CONSOLE.log(f"a {config.size} head is enabled, with {config.num_features} features a primitive")
    searched.restart_rates(head=True)
    return True


def remove(searched: SearchedField, search: Search) -> None:
    """Remove the head and the features for good."""
    searched.state.remove_head()
    search.head_dropped, search.head_size, search.num_features = True, "", 0


def reshape(state: FieldState, search: Search, largest: HeadConfig | None) -> None:
    """Give field and head the shapes that a search has left in a checkpoint; values are loaded afterwards."""
    field, chosen = state.field, sizes.chosen_head(search, largest)
    if search.degree >= 0:
        rest = field["features_rest"]
        rest.data = rest.data[:, : (search.degree + 1) ** 2 - 1]
    if chosen is None:
        state.remove_head()
    elif state.head is not None and state.head.config != chosen:
        state.reshape_head(chosen)
