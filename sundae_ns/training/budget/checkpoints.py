"""A search in a checkpoint: what it says, and which shapes it has given to the tensors beside it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from sundae_ns.compensation import CompensationHead, HeadConfig
from sundae_ns.errors import CheckpointError
from sundae_ns.training.budget.search import Search
from sundae_ns.training.budget.sizes import chosen_head


def search_of(state: Any) -> Search:
    """The search that a checkpoint carries.

    Raises:
        CheckpointError: it carries none, or what no search is like.
    """
    if not isinstance(state, Mapping) or not isinstance(state.get("numbers"), Mapping):
        raise CheckpointError("the checkpoint is of a run without a search for a budget; load it with its own method")
    return Search.from_state(state["numbers"])


def shapes(search: Search, largest: HeadConfig | None, expected: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """``expected`` state of a model, in the shapes that a search has given it.

    Args:
        search: of the checkpoint.
        largest: the head that the model is configured with.
        expected: ``state_dict`` of the model as it is configured.
    """
    shaped = dict(expected)
    rest, features = "gauss_params.features_rest", "gauss_params.features"
    head = chosen_head(search, largest)
    if search.degree >= 0:
        shaped[rest] = shaped[rest][:, : (search.degree + 1) ** 2 - 1]
    if head is None:
        shaped = {name: value for name, value in shaped.items() if not name.startswith("head.")}
    if features in shaped:
        shaped[features] = shaped[features][:, : 0 if head is None else head.num_features]
    if head is not None:
        with torch.device("meta"):
            shaped.update({f"head.{name}": value for name, value in CompensationHead(head).state_dict().items()})
    return shaped
