"""Pruning of a scene by what views see of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from sundae_ns.api.cost import prune_cost, require_memory, state
from sundae_ns.api.refit import refit
from sundae_ns.api.scene import Scene
from sundae_ns.api.virtual import of_unit_size, resized, size_of, virtual_views
from sundae_ns.errors import ConfigError, DataError
from sundae_ns.gaussians import mend
from sundae_ns.pruning import PruneRule, kept_count, prune_field
from sundae_ns.rendering import LocalField, TrainingView, View, contribution

DEFAULT_RULE = PruneRule(selection="pairs")
"""Merges the pairs whose images differ least. Without training it loses less than the draws of ``ns-train sundae``."""


class PrunedScene(NamedTuple):
    """A pruned scene, and what it keeps."""

    scene: Scene
    mask: Tensor
    """True for kept primitives of the scene before the prune, bool ``[N]``."""
    seen: float | None = None
    """Share of the finite primitives that the views see; None if no view was asked."""


def prune(
    scene: Scene,
    *,
    keep: float | None = None,
    count: int | None = None,
    views: Sequence[View] | None = None,
    rule: PruneRule | None = None,
    progress: bool = False,
) -> Scene:
    """Keep the primitives that matter most to the views, and merge the others into them.

    Primitives with NaN, or infinite values without a meaning, are dropped first. An opacity of 1, a width of 0 and the
    like become finite. After a merge by pairs, a few steps fit the kept ones to the scene's own images of the views.

    Args:
        scene: to prune; it does not change.
        keep: share of the finite primitives to keep, in (0, 1].
        count: number of primitives to keep, in place of a share; at least 1.
        views: cameras whose images the prune preserves; by default those stored with the scene, else
            :func:`sundae_ns.virtual_views`.
        rule: score, selection and merge; by default :data:`DEFAULT_RULE`.
        progress: show a progress bar on stderr.

    Returns:
        A scene of ``round(keep * N)`` or ``count`` primitives, on the same device. It keeps the head, which was
        trained for the fuller field.

    Raises:
        ConfigError: neither or both of ``keep`` and ``count`` are given, or they or an option are out of range.
        DataError: no primitive is finite, or the views see none.
        MemoryExhaustedError: the host has too little memory; nothing was started.

    >>> import torch, sundae_ns as sn
    >>> scene = sn.Scene.from_points(torch.rand(200, 3), torch.rand(200, 3))
    >>> sn.prune(scene, keep=0.1, views=sn.virtual_views(scene, 4, size=32)).num_primitives
    20
    """
    return prune_with_mask(scene, keep, count, views, rule, progress=progress).scene


def check_amount(keep: float | None, count: int | None) -> None:
    """Raise ``ConfigError`` unless one of the two is given, and is in its range."""
    if (keep is None) == (count is None):
        raise ConfigError("prune needs either keep (a share) or count (a number of primitives); give one of them")
    if keep is not None and not 0 < keep <= 1:
        raise ConfigError(f"keep is {keep}; give a share in (0, 1], 0.1 to keep a tenth")
    if count is not None and count < 1:
        raise ConfigError(f"count is {count}; give 1 or more primitives")


@torch.no_grad()
def prune_with_mask(
    scene: Scene,
    keep: float | None,
    count: int | None,
    views: Sequence[View] | None,
    rule: PruneRule | None,
    *,
    progress: bool,
    stated: bool = False,
    trains: bool = False,
) -> PrunedScene:
    """As :func:`prune`, with the mask of the kept primitives.

    Args:
        stated: whether its cost was stated already.
        trains: whether training follows, which learns more from merged primitives than from fitted ones.
    """
    check_amount(keep, count)
    rule = rule or DEFAULT_RULE
    mended = mend(scene.field)
    field, finite = mended.field, mended.mask
    if keep is not None:
        count = kept_count(keep, field.num_primitives)
    assert count is not None

    n, numbers = field.num_primitives, sum(value.shape[1:].numel() for value in field.values())
    usable = dataclasses.replace(scene, field=field)
    seen: Sequence[View] = ()
    if rule.uses_contribution and count < n:
        seen = views if views is not None else scene.views or virtual_views(usable)
    pixels = sum(view.width * view.height for view in seen)
    cost = prune_cost(n, numbers, rule, count / max(n, 1), len(seen), pixels)
    on_host, console = field["means"].device.type == "cpu", None
    if on_host:
        require_memory(cost, n, loaded=True)
    if progress:
        from rich.console import Console

        console = Console(stderr=True)
        if on_host and not stated:
            state(cost, n, len(seen))
    weights = None
    if rule.uses_contribution and count < n:
        sized, seen = of_unit_size(usable, seen)
        weights = contribution(
            LocalField(sized.field),
            [TrainingView(view.to(scene.device), None) for view in seen],
            scene.background,
            scene.settings(head=False),
            count=count if rule.uses_detail else None,
            console=console,
        )
        if not bool((weights > 0).any()):
            raise DataError(
                f"{len(seen)} views see none of {field.num_primitives:,} primitives; "
                "give cameras that look at the scene, or export it again"
            )
    pruned = prune_field(field, rule, count, weights)
    small = pruned.field
    if weights is not None and rule.refits and not trains:
        factor = size_of(usable)
        small = resized(dataclasses.replace(scene, field=small), 1 / factor).field
        cameras = [view.to(scene.device) for view in seen]
        small = refit(small, sized.field, cameras, scene.settings(head=False), seed=rule.seed, console=console)
        small = resized(dataclasses.replace(scene, field=small), factor).field
    mask = finite.clone()
    mask[finite] = pruned.decision.mask
    share = None if weights is None else float((weights > 0).float().mean())
    return PrunedScene(dataclasses.replace(scene, field=small), mask, share)
