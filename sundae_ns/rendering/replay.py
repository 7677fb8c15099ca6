"""Pictures that are only looked at, played back: all that the GPU does for a frame, recorded once for each size.

A frame is many small kernels, each started from Python; as one CUDA graph they are started at once. What a recording reads
stays where it is: the field, which may be trained meanwhile, the head's weights, and the three tensors that camera and
background are written to.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import astuple, dataclass, replace
from functools import partial
from threading import Lock
from typing import Any

import torch
from torch import Tensor

from sundae_ns.errors import BackendError
from sundae_ns.gpu.cuda_graphs import Kept, aside, record
from sundae_ns.rasterization import GsplatBackend, Room
from sundae_ns.rendering.render import Style, degree_in_use, plan_of, render
from sundae_ns.rendering.views import View

SPARE = 1.5
"""Room for so many times the pairs of a tile and a primitive of the view that is recorded; another view may have more."""

SHOWN = ("rgb", "base_rgb", "accumulation")

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Recording:
    graph: torch.cuda.CUDAGraph
    given: tuple[Tensor, Tensor, Tensor]
    """Where it reads: world-to-camera, intrinsics, background."""
    made: dict[str, Tensor]
    """Where it writes."""
    pairs: int
    """How many it has room for."""
    needed: Tensor
    """How many there were, int64 ``[]``."""


class Recordings:
    """The recordings of one field, made as they are needed, and forgotten when the field is another."""

    def __init__(self) -> None:
        self._kept: Kept[_Recording] = Kept()
        self._of: object = None
        self._can_record = True
        # A viewer renders in its own thread, and a recording reads what it was given last.
        self._lock = Lock()

    def render(
        self, field: Mapping[str, Tensor], view: View, background: Tensor, style: Style, *, compensate: bool = True
    ) -> dict[str, Any]:
        """The pictures of a view, as :func:`sundae_ns.rendering.render.render` makes them without depth.

        Played back where that is possible: on CUDA by gsplat, without gradients, of a field that one process holds. Other
        pictures, and those of a size that is new, are rendered kernel by kernel. They are the same up to the order in which
        kernels add up.

        Args:
            field: the primitives; all of them, for a part is somewhere else each time.
            view: the camera.
            background: ``[3]`` colour behind everything.
            style: all else.
            compensate: whether the head may take part.

        Returns:
            ``rgb, base_rgb, accumulation``, each ``[H, W, C]``, the caller's own.
        """
        if self._can_record and _recordable(field, style):
            with self._lock:
                try:
                    made = self._played(field, view, background, style, compensate)
                # No compiler, no memory, or whatever a driver says of a recording.
                except (BackendError, RuntimeError) as error:
                    _log.warning("frames are rendered kernel by kernel, for they cannot be recorded: %s", error)
                    _log.debug("", exc_info=True)
                    self._kept.clear()
                    self._can_record, made = False, None
            if made is not None:
                return made
        pictures = render(field, view, background, style, depth=False, compensate=compensate)[0]
        return {name: pictures[name] for name in SHOWN}

    def _played(
        self, field: Mapping[str, Tensor], view: View, background: Tensor, style: Style, compensate: bool
    ) -> dict[str, Any] | None:
        record_for = partial(_record, field, view, background, style, compensate)
        key = self._key(field, view, style, compensate)
        recording = self._kept.get(key, record_for)
        if recording is None:
            return None
        made, needed = _play(recording, view, background)
        if needed > recording.pairs:
            recording = record_for(pairs=int(SPARE * needed))
            self._kept.put(key, recording)
            made, _ = _play(recording, view, background)
        return made

    def _key(self, field: Mapping[str, Tensor], view: View, style: Style, compensate: bool) -> object:
        """What a recording has fixed. The field is told by where it lies, which is what a recording reads."""
        of = tuple((name, value.data_ptr(), value.shape) for name, value in field.items())
        if of != self._of:
            self._kept.clear()
            self._of = of
        head = style.head if compensate else None
        of_head: tuple[object, ...] | None = None
        if head is not None:
            # The network itself, not its number, which a later one might be given; and where its weights lie.
            lie = tuple(value.data_ptr() for value in head.net.parameters())
            of_head = (head.net, lie, astuple(head.config), *plan_of(view, style.trained_focal))
        degree = degree_in_use(field["features_rest"], style.most_bands)
        return view.width, view.height, style.antialiased, style.logits, degree, of_head


def _recordable(field: Mapping[str, Tensor], style: Style) -> bool:
    return (
        style.backend.name == "gsplat"
        and style.arrivals is None
        and not style.training
        and not torch.is_grad_enabled()
        and len(field["means"]) > 0
    )


def _record(
    field: Mapping[str, Tensor],
    view: View,
    background: Tensor,
    style: Style,
    compensate: bool,
    pairs: int | None = None,
) -> _Recording:
    """Record a frame with room for so many pairs; by default for what this view needs, and to spare."""
    with torch.inference_mode(False), torch.no_grad():
        given = (view.viewmat.clone(), view.K.clone(), background.to(view.viewmat).clone())
        here = view._replace(viewmat=given[0], K=given[1])

        def run(room: Room) -> dict[str, Any]:
            by = replace(style, backend=GsplatBackend(room))
            return render(field, here, given[2], by, depth=False, compensate=compensate)[0]

        device = view.viewmat.device
        if pairs is None:
            measured = Room()
            with aside(device):
                run(measured)
            pairs = int(SPARE * max(int(needed) for needed in measured.needed)) + 1
        with aside(device):
            run(Room(pairs))

        def shown() -> tuple[dict[str, Any], Tensor]:
            room = Room(pairs)
            pictures = run(room)
            return {name: pictures[name] for name in SHOWN}, torch.stack(room.needed).amax()

        graph, (made, needed) = record(shown, device)
    return _Recording(graph, given, made, pairs, needed)


def _play(recording: _Recording, view: View, background: Tensor) -> tuple[dict[str, Any], int]:
    """Pictures, and how many pairs there were: with more than there is room for, the pictures are wrong."""
    torch._foreach_copy_(list(recording.given), [view.viewmat, view.K, background.to(view.viewmat)])
    recording.graph.replay()
    made = {name: picture.clone() for name, picture in recording.made.items()}
    return made, int(recording.needed)
