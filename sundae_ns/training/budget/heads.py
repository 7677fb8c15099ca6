"""The head of a search: it joins where it is small beside the field, goes where it does not pay, and is rebuilt on loading."""

from __future__ import annotations

from nerfstudio.utils.rich_utils import CONSOLE

from sundae_ns.compensation import CompensationHead, HeadConfig
from sundae_ns.gaussians import FEATURES
from sundae_ns.gaussians.snapshot import narrow
from sundae_ns.training.budget import sizes
from sundae_ns.training.budget.run import Run
from sundae_ns.training.budget.search import Search


def may_pay(run: Run, largest: HeadConfig | None) -> bool:
    """Whether a head, up to the one given, is small beside the field without it."""
    count = run.model.num_points
    return largest is not None and sizes.head_for(count * run.row, count, largest) is not None


def join(run: Run, search: Search, largest: HeadConfig | None, primitives: int) -> bool:
    """Let the head that suits a field of so many primitives take part; whether one does."""
    head = run.model.head
    config = None if largest is None else sizes.head_for(primitives * run.row, primitives, largest)
    if config is None or head is None:
        return False
    search.head, search.head_size, search.num_features = True, config.size, config.num_features
    if config != head.config:
        head.resize(config)
        narrow(run.params, run.optimizers.optimizers, FEATURES, config.num_features)
    CONSOLE.log(f"a {config.size} head joins, with {config.num_features} features a primitive")
    run.restart_rates(head=True)
    return True


def drop(run: Run, search: Search) -> None:
    """Do without a head, and without features, for good."""
    run.model.head = None
    run.optimizers.optimizers["compensation"].state.clear()
    narrow(run.params, run.optimizers.optimizers, FEATURES, 0)
    search.head_dropped, search.head_size, search.num_features = True, "", 0


def prepared(search: Search, largest: HeadConfig | None, head: CompensationHead | None) -> CompensationHead | None:
    """The head of a model as a search has left it, its values still to be loaded; None where it has none."""
    chosen = sizes.chosen_head(search, largest)
    if head is None or chosen is None:
        return None
    if head.config != chosen:
        head.resize(chosen)
    return head
