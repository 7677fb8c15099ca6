"""The budget finds itself: cuts the field during training as :mod:`sundae_ns.pruning.search` decides.

Held-back training views judge; test views are never looked at. After the warm-up:

1. the field is trained on with all bands of its harmonics, and for as long with fewer: those that held-back views do not
   miss go, for the whole scene;
2. the field is cut, trained, looked at, and cut again, on its base colours alone;
3. where a network that corrects them is small beside the field that came out, the largest such joins, with features as
   wide as are small beside a primitive, and the field is cut on; it stays only if field, features and network together
   are then smaller;
4. primitives whose colour does not depend on the view lose their bands above 0.

A budget in bytes or primitives takes the place of 2 and 3: then the count follows from it.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from nerfstudio.engine.callbacks import TrainingCallbackAttributes
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.utils import writer
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor
from torch.nn import Parameter

from sundae_ns.after_step import record, refresh
from sundae_ns.compensation import CompensationHead, HeadConfig
from sundae_ns.compensation.head import SIZES
from sundae_ns.datamanager import SundaeDatamanager
from sundae_ns.errors import CheckpointError, ConfigError, DataError
from sundae_ns.evaluation import psnr
from sundae_ns.gaussians import FEATURES, finite_mask, from_points, keep
from sundae_ns.gaussians.rewriting import rewrite
from sundae_ns.gaussians.snapshot import Snapshot, module_snapshot, narrow, restore, restore_module, snapshot
from sundae_ns.pruning import PruneReport, PruningConfig, decide
from sundae_ns.pruning.bands import fold, mean_basis, view_dependence
from sundae_ns.pruning.search import Point, Search, curve_text
from sundae_ns.rasterization.harmonics import harmonic_basis
from sundae_ns.schedulers import notify_pruned
from sundae_ns.storage import accounting, megabytes
from sundae_ns.storage.atomic import write_text

if TYPE_CHECKING:
    from sundae_ns.model import SundaeModel

MAX_VIEWS = 64
"""Training views, evenly chosen, that each scoring looks at: it is repeated at each cut."""
MAX_REJECTED = 3
"""Cuts that may be taken back, before and after the head has joined."""
TRIAL_LOOKS = 3
"""Length, in looks, of the training that is compared with other bands."""
HEAD_SHARE = 0.25
"""A head may join that is at most this share of the field, with features that are at most this share of a primitive."""
WIDTHS = (1, 5, 13, 29)
"""Feature widths that splat without padding."""
FLAT_SHARE = 0.25
"""Share of the tolerated drop that flat colours may cost, right when bands go."""


def bytes_of(field: Mapping[str, Tensor], head: HeadConfig | None) -> int:
    """Bytes that a field and its head are stored in. The one place where a budget counts bytes.

    Args:
        field: the parameters, rows and columns as they would be stored.
        head: the head; None, or its mode off, for none.
    """
    return accounting.bytes_of(field) + head_bytes(head)


def head_bytes(head: HeadConfig | None) -> int:
    """Bytes of a head, without building its weights."""
    if head is None or head.mode == "off":
        return 0
    with torch.device("meta"):
        return accounting.bytes_of_module(CompensationHead(head))


def head_for(stored: int, primitives: int, largest: HeadConfig) -> HeadConfig | None:
    """The largest head, up to the one given, that is small beside a field; None if not one is.

    Args:
        stored: bytes of the field without features.
        primitives: how many these are.
        largest: the head that would be taken for a field of any size.
    """
    narrower = [width for width in WIDTHS if width < largest.num_features]
    room = HEAD_SHARE * stored / primitives / accounting.BYTES_PER_FLOAT
    widths = [width for width in (*narrower, largest.num_features) if width <= room]
    sizes = list(SIZES)[: list(SIZES).index(largest.size) + 1]
    for size in reversed(sizes if widths else []):
        config = replace(largest, size=size, num_features=widths[-1])  # type: ignore[arg-type]
        if head_bytes(config) <= HEAD_SHARE * stored:
            return config
    return None


class _Run(NamedTuple):
    """What a step of the search works on."""

    model: SundaeModel
    attributes: TrainingCallbackAttributes
    datamanager: SundaeDatamanager

    @property
    def optimizers(self) -> Optimizers:
        assert self.attributes.optimizers is not None
        return self.attributes.optimizers

    @property
    def params(self) -> Any:
        return self.model.gaussians


class Budget:
    """The search of one run: its state, and the fields that it may go back to.

    Args:
        config: options of pruning, mode auto.
        head: configuration of the head that may take part.
    """

    def __init__(self, config: PruningConfig, head: HeadConfig) -> None:
        self.config = config
        self._largest = None if head.mode == "off" else head
        self.search = Search()
        self._accepted: dict[str, Snapshot] | None = None
        self._fallback: dict[str, Snapshot] | None = None
        self._flat: Tensor | None = None

    @property
    def head_config(self) -> HeadConfig | None:
        """The head that was chosen, before that the one asked for; None for none at all."""
        return _chosen(self.search, self._largest)

    # ------------------------------------------------------------------------------------------------- checkpoints

    def state(self) -> dict[str, Any]:
        """State for a checkpoint: numbers, and copies of the fields to go back to while the search goes on."""
        return {
            "numbers": self.search.state(),
            "accepted": self._accepted,
            "fallback": self._fallback,
            "flat": self._flat,
        }

    def load_state(self, state: Any) -> None:
        """Counterpart of :meth:`state`.

        Raises:
            CheckpointError: it is not what :meth:`state` gives.
        """
        search = self._search_of(state)
        needed = {"accepted": search.trying, "fallback": search.phase in ("bands", "head")}
        if any(wanted and not isinstance(state.get(name), Mapping) for name, wanted in needed.items()):
            raise CheckpointError("the checkpoint lacks the field that its search would go back to; give another")
        self.search = search
        self._accepted, self._fallback, self._flat = state.get("accepted"), state.get("fallback"), state.get("flat")

    @staticmethod
    def _search_of(state: Any) -> Search:
        if not isinstance(state, Mapping) or not isinstance(state.get("numbers"), Mapping):
            raise CheckpointError(
                "the checkpoint is of a run without a search for a budget; load it with its own method"
            )
        return Search.from_state(state["numbers"])

    def shapes(self, extra: Any, expected: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """``expected`` state of a model, in the shapes that the search of a checkpoint has given it.

        Args:
            extra: what the checkpoint carries beside the tensors; of another method's, nothing is known.
            expected: ``state_dict`` of the model as it is configured.

        Raises:
            CheckpointError: see :meth:`load_state`.
        """
        if not isinstance(extra, Mapping) or extra.get("method") != "sundae":
            return dict(expected)
        search = Budget._search_of(extra.get("budget"))
        shaped = dict(expected)
        rest = "gauss_params.features_rest"
        if search.degree >= 0:
            shaped[rest] = shaped[rest][:, : (search.degree + 1) ** 2 - 1]
        if search.head_dropped:
            shaped = {name: value for name, value in shaped.items() if not name.startswith("head.")}
        chosen, features = _chosen(search, self._largest), "gauss_params.features"
        if features in shaped:
            shaped[features] = shaped[features][
                :, : 0 if search.head_dropped or chosen is None else chosen.num_features
            ]
        if chosen is not None and not search.head_dropped:
            with torch.device("meta"):
                shaped.update({f"head.{name}": value for name, value in CompensationHead(chosen).state_dict().items()})
        return shaped

    def prepare_head(self, extra: Mapping[str, Any], head: CompensationHead | None) -> CompensationHead | None:
        """The head of a model as a checkpoint has it, its values still to be loaded; None where it has none."""
        search = self._search_of(extra.get("budget"))
        chosen = _chosen(search, self._largest)
        if head is None or chosen is None or search.head_dropped:
            return None
        if head.config != chosen:
            head.resize(chosen)
        return head

    # ---------------------------------------------------------------------------------------------------- training

    def check(self, datamanager: SundaeDatamanager) -> None:
        """Check, before the first step, that there are views to judge by, and bytes for a primitive at all.

        Raises:
            ConfigError: no training view is held back, or the budget is too small.
        """
        # With a generator of its own: this is called after the random state of a checkpoint has been restored.
        origin, generator = torch.zeros(1, 3), torch.Generator()
        least = bytes_of(from_points(origin, origin, sh_degree=0, num_features=0, generator=generator), None)
        if self.config.max_bytes is not None and self.config.max_bytes < least:
            raise ConfigError(
                f"pruning.max-bytes is {self.config.max_bytes:,}, and one primitive takes {least}; give more"
            )
        if not datamanager.holdout_indices:
            raise ConfigError(
                "pruning.mode auto judges by training views that are held back, and there are none: give "
                "--pipeline.datamanager.holdout-every 8, less where there are fewer training views"
            )

    def after_step(self, model: SundaeModel, attributes: TrainingCallbackAttributes) -> None:
        """Act after a step of training, once densification has had its say.

        Raises:
            DataError: the budget is too small for one primitive, or the field cannot be scored.
        """
        config, search, step = self.config, self.search, model.schedule_step
        assert attributes.pipeline is not None
        run = _Run(model, attributes, attributes.pipeline.datamanager)  # type: ignore[arg-type]
        if self._flat is not None:
            rest = run.params["features_rest"]
            self._flat = self._flat.to(rest.device)
            rest.data.mul_(~self._flat[:, None, None])
        started = time.perf_counter()
        if search.phase == "before" and step >= config.prune_at:
            self._begin(run)
        elif search.phase == "bands" and step - search.cut_at >= TRIAL_LOOKS * config.search_every:
            self._end_trial(run)
        elif search.phase in ("field", "head") and (step - search.began) % config.search_every == 0:
            self._look(run)
        else:
            return
        refresh(model, run.optimizers)
        search.seconds += time.perf_counter() - started
        self._write(run)

    def finish(self, model: SundaeModel, attributes: TrainingCallbackAttributes) -> None:
        """Measure what came out against the target, and say whether it was reached."""
        search = self.search
        if search.phase == "before":
            CONSOLE.print("[yellow]Warning: training ended before the search for a budget began (pruning.prune-at)")
            return
        assert attributes.pipeline is not None
        run = _Run(model, attributes, attributes.pipeline.datamanager)  # type: ignore[arg-type]
        point = self._point(run, self._measure(run), "final", "reached")
        drop, stored, count = search.reference - point.psnr, point.bytes, model.num_points
        wanted = self._wanted()
        reached = {
            "max_psnr_drop": drop <= self.config.tolerated_drop,
            "max_bytes": stored <= (self.config.max_bytes or 0),
            "max_primitives": count <= (self.config.max_primitives or 0),
        }[wanted]
        point.verdict = "reached" if reached else "missed"
        search.curve = [old for old in search.curve if old.phase != "final"] + [point]
        unfinished = f" The search had not ended: train on to step {self.config.stop}." if search.searching else ""
        limit = getattr(self.config, wanted) or self.config.tolerated_drop
        CONSOLE.log(
            f"budget {wanted} {limit:,}: {point.verdict}. {count:,} of {search.before:,} primitives, "
            f"{megabytes(stored)}, harmonics of degree {self._degree(run)}, "
            f"{'with' if search.head else 'no'} head, {drop:+.3f} dB lost on {search.views} held-back views.{unfinished}"
        )
        self._write(run)

    # ---------------------------------------------------------------------------------------------------- the steps

    def _wanted(self) -> str:
        given = [name for name in ("max_bytes", "max_primitives") if getattr(self.config, name) is not None]
        return given[0] if given else "max_psnr_drop"

    def _begin(self, run: _Run) -> None:
        model, search = run.model, self.search
        self._keep(run, finite_mask(run.params))
        # Densification has ended, and what it counted would not follow a field that goes back to more primitives.
        model.strategy_state.clear()
        model.strategy_state.update(model.strategy.initialize_state(scene_scale=1.0))
        search.began, search.before = model.schedule_step, model.num_points
        search.views = len(run.datamanager.holdout_indices)
        search.reference = self._measure(run)
        search.target = search.reference - self.config.tolerated_drop
        CONSOLE.log(
            f"step {model.step}: warm-up field of {model.num_points:,} primitives, PSNR {search.reference:.3f} dB on "
            f"{search.views} held-back training views"
        )
        self._notify(run, head=False)
        search.degree = self._degree(run)
        if search.degree > 0:
            search.phase = "bands"
            self._fallback = self._snapshot(run)
            self._start_trial(run, search.degree)
        else:
            self._after_bands(run)

    def _after_bands(self, run: _Run) -> None:
        if self._wanted() != "max_psnr_drop":
            self._fit(run)
            self._done(run)
            return
        self.search.begin("field", run.model.num_points)
        self._cut_or_rest(run, self._measure(run))

    def _look(self, run: _Run) -> None:
        search, config, step = self.search, self.config, run.model.schedule_step
        # Half of the time is the head's, if it may join.
        head_to_come = search.phase == "field" and self._head_may_pay(run)
        deadline = (search.began + config.stop) // 2 if head_to_come else config.stop
        value = self._measure(run)
        verdict = search.judge(value, step, config.patience)
        point = self._point(run, value, search.phase, verdict)
        search.curve.append(point)
        CONSOLE.log(
            f"step {run.model.step}: {point.primitives:,} primitives, {value - search.target:+.3f} dB to the target, "
            f"{point.since_cut} steps after the cut: {verdict}"
        )
        writer.put_dict(
            name="Budget",
            scalar_dict={"primitives": point.primitives, "psnr": value, "to_target": value - search.target},
            step=run.model.step,
        )
        if verdict == "waiting":
            return
        if verdict == "rejected":
            self._restore(run, self._accepted)
            value = search.target + search.margin
        # A network that does not help, or that waits for its turn, is not waited for.
        tired = {"field": 1 if head_to_come else math.inf, "head": math.inf if search.cuts else 3}[search.phase]
        over = step + config.patience * config.search_every > deadline or search.looks >= tired * config.patience
        if over or search.rejected >= MAX_REJECTED:
            self._end_phase(run)
        else:
            self._cut_or_rest(run, value)

    def _cut_or_rest(self, run: _Run, value: float) -> None:
        """Cut on as far as the margin allows; nothing where it allows nothing."""
        config = self.config
        count = self.search.next_count(value, config.num_neighbors + 1 if config.uses_graph else 1)
        if count is None:
            return
        self._accepted = self._snapshot(run)
        self._cut_to(run, count)
        self.search.cut(value, count, run.model.schedule_step)

    def _cut_to(self, run: _Run, count: int) -> None:
        step = run.model.schedule_step
        options = replace(self.config, seed=self.config.seed + step)
        ratio = count / run.model.num_points if options.uses_detail else None
        decision = decide(run.params, options, lambda: self._contribution(run, ratio), count=count)
        self._keep(run, decision.mask)
        if decision.values is not None:
            rewrite(run.params, run.optimizers.optimizers, decision.values)
        run.model.pruning_state["pruned_at"] = step
        run.model.pruning_state["num_prunes"] += 1

    def _end_phase(self, run: _Run) -> None:
        search, step = self.search, run.model.schedule_step
        if search.phase == "field" and self._head_may_pay(run) and step < self.config.stop:
            self._fallback = self._snapshot(run)
            search.begin("head", search.accepted)
            search.head_at = step
            self._join(run, run.model.num_points * self._row(run), run.model.num_points)
            return
        if search.phase == "head":
            assert self._fallback is not None
            without = {name: entry["value"] for name, entry in self._fallback["field"].items() if name != FEATURES}
            if bytes_of(run.params, self.head_config) >= bytes_of(without, None):
                search.steps_lost += step - search.head_at
                search.head = False
                self._restore(run, self._fallback)
        if not search.head:
            self._drop_head(run)
        self._done(run)

    def _fit(self, run: _Run) -> None:
        """The count that follows from a budget of bytes or primitives."""
        config, model = self.config, run.model
        row, count = self._row(run), min(config.max_primitives or model.num_points, model.num_points)
        if config.max_bytes is not None:
            count = min(config.max_bytes // row, model.num_points)
            if count == 0:
                raise DataError(
                    f"pruning.max-bytes is {config.max_bytes:,}, and one primitive takes {row:,}; give more"
                )
        if not self._join(run, count * row, count):
            self._drop_head(run)
        if config.max_bytes is not None:
            head = self.head_config if self.search.head else None
            count = accounting.rows_within(run.params, config.max_bytes, lambda rows: bytes_of(rows, head))
        if count < model.num_points:
            self._cut_to(run, count)
        self.search.accepted = model.num_points
        self.search.curve.append(self._point(run, self._measure(run), "field", "cut"))

    def _done(self, run: _Run) -> None:
        search, model = self.search, run.model
        search.phase = "done"
        self._accepted = self._fallback = None
        self._flatten(run)
        report = PruneReport(
            step=model.schedule_step,
            before=search.before,
            after=model.num_points,
            dropped_nonfinite=0,
            peak=model.pruning_state["peak"],
            seconds=search.seconds,
            tau=None,
            sigma=None,
            isolated=None,
        )
        CONSOLE.log(report.summary())
        record(model, run.attributes, report, model.step, before={}, after={})

    # --------------------------------------------------------------------------------------------------- the head

    def _row(self, run: _Run) -> int:
        """Bytes of a primitive without features."""
        return bytes_of({name: value[:1] for name, value in run.params.items() if name != FEATURES}, None)

    def _head_may_pay(self, run: _Run) -> bool:
        """Whether a network is small beside the field without it."""
        count = run.model.num_points
        return self._largest is not None and head_for(count * self._row(run), count, self._largest) is not None

    def _join(self, run: _Run, stored: int, primitives: int) -> bool:
        """Let the head that suits a field take part, if one does."""
        head = run.model.head
        config = None if self._largest is None else head_for(stored, primitives, self._largest)
        if config is None or head is None:
            return False
        search = self.search
        search.head, search.head_size, search.num_features = True, config.size, config.num_features
        if config != head.config:
            head.resize(config)
            narrow(run.params, run.optimizers.optimizers, FEATURES, config.num_features)
        CONSOLE.log(f"a {config.size} head joins, with {config.num_features} features a primitive")
        self._notify(run, head=True)
        return True

    def _drop_head(self, run: _Run) -> None:
        if self._largest is None:
            return
        run.model.head = None
        run.optimizers.optimizers["compensation"].state.clear()
        narrow(run.params, run.optimizers.optimizers, FEATURES, 0)
        self.search.head_dropped, self.search.head_size, self.search.num_features = True, "", 0

    def _notify(self, run: _Run, *, head: bool) -> None:
        """Restart the rates of the field, or those of the head."""
        schedulers = {
            name: value for name, value in run.optimizers.schedulers.items() if (name == "compensation") == head
        }
        notify_pruned(schedulers, run.model.step)

    # ---------------------------------------------------------------------------------------------- the harmonics

    def _degree(self, run: _Run) -> int:
        return round((run.params["features_rest"].shape[1] + 1) ** 0.5) - 1

    def _start_trial(self, run: _Run, degree: int) -> None:
        """Train on from the warm-up field with the bands up to ``degree``."""
        search = self.search
        if degree < search.degree:
            dc, rest = run.params["features_dc"], run.params["features_rest"]
            mean, _ = self._view_basis(run, search.degree)
            dc.data.copy_(fold(dc.data, rest.data, mean, degree)[0])
            narrow(run.params, run.optimizers.optimizers, "features_rest", (degree + 1) ** 2 - 1)
            search.degree = degree
        search.cut_at = run.model.schedule_step

    def _end_trial(self, run: _Run) -> None:
        search, tolerated = self.search, self.config.tolerated_drop
        search.degrees[str(search.degree)] = self._measure(run)
        top = max(int(name) for name in search.degrees)
        if search.degree == search.lowest_degree(top, tolerated):
            self._accepted = self._snapshot(run)
        degree = search.next_degree(top, tolerated)
        if len(search.degrees) > 1:  # this trial, or the one that it has replaced
            search.steps_lost += run.model.schedule_step - search.cut_at
        if degree is not None:
            self._restore(run, self._fallback)
            self._start_trial(run, degree)
            return
        if search.degree != search.lowest_degree(top, tolerated):
            self._restore(run, self._accepted)
        self._fallback = None
        levels = ", ".join(f"{name}: {value:.3f}" for name, value in search.degrees.items())
        CONSOLE.log(f"harmonics of degree {search.degree} (PSNR by degree after the same training: {levels} dB)")
        self._after_bands(run)

    def _flatten(self, run: _Run) -> None:
        """Set the bands of those primitives to 0 that look the same from everywhere, as many as held-back views allow."""
        search, degree = self.search, self._degree(run)
        if degree == 0:
            return
        dc, rest = run.params["features_dc"], run.params["features_rest"]
        weight = self._contribution(run)
        mean, square = self._view_basis(run, degree)
        order = view_dependence(rest.data, mean, square, weight).cpu().argsort(stable=True).to(rest.device)
        folded, _ = fold(dc.data, rest.data, mean, 0)
        least = self._measure(run) - FLAT_SHARE * self.config.tolerated_drop

        def flattened(count: int) -> tuple[Tensor, Tensor, Tensor]:
            flat = torch.zeros(len(order), dtype=torch.bool, device=rest.device)
            flat[order[:count]] = True
            return flat, torch.where(flat[:, None], folded, dc.data), rest.data * ~flat[:, None, None]

        low, high = 0, len(order)
        for _ in range(6):
            middle = (low + high + 1) // 2
            _, colours, bands = flattened(middle)
            with _values(dc, colours), _values(rest, bands):
                good = self._measure(run) >= least
            low, high = (middle, high) if good else (low, middle)
        flat, colours, bands = flattened(low)
        dc.data.copy_(colours)
        rest.data.copy_(bands)
        self._flat, search.zeroed = flat, low
        CONSOLE.log(f"{low:,} of {len(order):,} primitives look the same from everywhere: their harmonics are 0")

    # ------------------------------------------------------------------------------------------------------- views

    def _weights(self, run: _Run, keep_ratio: float | None = None) -> Iterator[tuple[Any, Tensor]]:
        cameras = list(run.datamanager.training_cameras())
        stride = -(-len(cameras) // MAX_VIEWS)
        for camera in cameras[::stride]:
            view = run.model.view_of(camera)
            yield view, run.model.weights_of(view, keep_ratio)

    @torch.no_grad()
    def _contribution(self, run: _Run, keep_ratio: float | None = None) -> Tensor:
        total = torch.zeros(run.model.num_points, device=run.model.device)
        for _, weight in self._weights(run, keep_ratio):
            total += weight
        return total

    @torch.no_grad()
    def _view_basis(self, run: _Run, degree: int) -> tuple[Tensor, Tensor]:
        def weighted() -> Iterator[tuple[Tensor, Tensor]]:
            means = run.params["means"].data
            for view, weight in self._weights(run):
                centre = -view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
                directions = torch.nn.functional.normalize(means - centre, dim=-1)
                yield weight, harmonic_basis(degree, directions)

        return mean_basis(weighted())

    @torch.no_grad()
    def _measure(self, run: _Run) -> float:
        """Mean PSNR over the held-back views, dB, the head included where it takes part."""
        model = run.model
        training = model.training
        model.eval()
        background = model._get_background_color()
        values = []
        for camera, batch in run.datamanager.holdout_views:
            pictures, _ = model.render(run.params, model.view_of(camera), background, depth=False)
            target = model.composite_with_background(model.get_gt_img(batch["image"]), background)
            values.append(psnr(pictures["rgb"], target))
        model.train(training)
        return float(torch.stack([torch.as_tensor(value) for value in values]).mean())

    # ------------------------------------------------------------------------------------------------------ fields

    def _keep(self, run: _Run, mask: Tensor) -> None:
        keep(run.params, run.optimizers.optimizers, run.model.pruning_state, mask)

    def _snapshot(self, run: _Run) -> dict[str, Snapshot]:
        optimizers = run.optimizers.optimizers
        saved = {"field": snapshot(run.params, optimizers)}
        if self.search.head:
            assert run.model.head is not None
            saved["head"] = module_snapshot(run.model.head.parameters(), optimizers["compensation"])
        return saved

    def _restore(self, run: _Run, saved: dict[str, Snapshot] | None) -> None:
        assert saved is not None
        restore(run.params, run.optimizers.optimizers, saved["field"])
        if "head" in saved:
            assert run.model.head is not None
            restore_module(run.model.head.parameters(), run.optimizers.optimizers["compensation"], saved["head"])
        self.search.degree = self._degree(run)
        # Whatever is kept per count of primitives is stale.
        run.model.pruning_state["num_prunes"] += 1

    def _point(self, run: _Run, value: float, phase: str, verdict: str) -> Point:
        stored = run.params if self.search.head else {k: v for k, v in run.params.items() if k != FEATURES}
        return Point(
            step=run.model.step,
            phase=phase,
            primitives=run.model.num_points,
            bytes=bytes_of(stored, self.head_config if self.search.head else None),
            psnr=value,
            verdict=verdict,
            since_cut=run.model.schedule_step - self.search.cut_at,
        )

    def _write(self, run: _Run) -> None:
        """``budget.json`` and ``budget.txt`` in the run's folder: the curve, the choice, and what it cost."""
        trainer, search = run.attributes.trainer, self.search
        if trainer is None:
            return
        wanted = self._wanted()
        steps = trainer.config.max_num_iterations
        content = {
            "budget": {wanted: getattr(self.config, wanted) or self.config.tolerated_drop},
            **asdict(search),
            "primitives": run.model.num_points,
            "cost": {
                "steps_lost": search.steps_lost,
                "share_of_steps": search.steps_lost / steps,
                "seconds": search.seconds,
            },
        }
        folder = trainer.base_dir
        folder.mkdir(parents=True, exist_ok=True)
        write_text(folder / "budget.json", json.dumps(content, indent=2))
        write_text(folder / "budget.txt", curve_text(search.curve, search.target) + "\n")


def _chosen(search: Search, largest: HeadConfig | None) -> HeadConfig | None:
    if largest is None or not search.head_size:
        return largest
    return replace(largest, size=search.head_size, num_features=search.num_features)  # type: ignore[arg-type]


@contextmanager
def _values(parameter: Parameter, value: Tensor) -> Iterator[None]:
    """Another value for a while."""
    before = parameter.data
    parameter.data = value
    try:
        yield
    finally:
        parameter.data = before
