"""Measurements of scenes, their quality, bytes and synchronised times; and the table of them, as Markdown and CSV."""

from __future__ import annotations

import csv
import html
import logging
import math
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from io import StringIO
from pathlib import Path
from statistics import fmean, median
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from sundae_ns.core.camera import Camera
from sundae_ns.core.gaussians import FEATURES, bytes_of
from sundae_ns.core.metrics import MOST_PSNR, Lpips, ViewQuality, quality_of
from sundae_ns.core.tables import MEGABYTE, number, table, without_nan
from sundae_ns.core.timing import median_ms
from sundae_ns.cuda.kernels import naming_full_memory
from sundae_ns.data.capture_files import TRANSFORMS, placed_in
from sundae_ns.head.head import bytes_of_module
from sundae_ns.scene.compose import OTHERS, aligned
from sundae_ns.scene.describe import bytes_at, held_out_cameras
from sundae_ns.scene.frames import FrameReplay
from sundae_ns.scene.load_save import load
from sundae_ns.scene.render import GaussianSource, RenderSettings, compensate, draw, scale_plan
from sundae_ns.scene.scene import Scene, middle_and_reach, render, usable

if TYPE_CHECKING:
    from sundae_ns.plugin.finished_runs import Opened

_log = logging.getLogger(__name__)
HEAD_ON, HEAD_OFF = "head on", "head off"
# In the order of a table's columns, with their number of decimals.
METRICS = (("psnr", 2), ("ssim", 4), ("psnr_fitted", 2), ("lpips", 4))
COLUMNS = (
    *("scene", "method", "variant", "keep_ratio", "seed", "steps", "primitives"),
    *("psnr", "ssim", "psnr_base", "ssim_base", "psnr_fitted", "lpips", "lpips_net"),
    *("bytes_primitives", "bytes_head", "bytes_total", "ms_frame", "ms_splat", "ms_head"),
    *("train_s", "prune_s", "peak_primitives", "peak_vram_mib", "gpu", "resolution", "command"),
)
"""Columns of the CSV. Metrics are means over the views, ``*_base`` without the head; ``bytes_*`` are bytes,
``ms_*`` milliseconds per frame, ``*_s`` seconds, ``peak_vram_mib`` the MiB that torch allocated at most in training."""


@dataclass(frozen=True)
class Configuration:
    """One configuration of rendering a scene. ``ms`` and ``views`` come from the same calls with the same arguments."""

    name: str  # HEAD_ON or HEAD_OFF; a scene without a head has only the latter
    ms: float | None  # Synchronised milliseconds per frame, median over the views; None if not timed
    bytes: int  # In fp32, without head and features where they are off; of a file, the whole file
    views: tuple[ViewQuality, ...]  # Empty for the scene that others are compared with

    def mean(self, metric: str) -> float | None:
        """Mean of a metric over the views; None unless every view has it. Equal images count as 100 dB among others."""
        values = [getattr(view, metric) for view in self.views]
        if not values or any(value is None or math.isnan(value) for value in values):
            return None
        equal = math.inf if min(values) == math.inf else MOST_PSNR
        return fmean(equal if value == math.inf else value for value in values)


@dataclass(frozen=True)
class Measured:
    """A scene with its measurements."""

    label: str  # In tables and plots, unique in a report
    source: str  # File or folder that was opened
    scene: str
    primitives: int
    bytes_primitives: int
    bytes_head: int
    resolution: str  # Width x height, pixels
    configurations: tuple[Configuration, ...]  # With the head, if the scene has one, then without it
    method: str = ""
    variant: str = ""
    keep_ratio: float | None = None
    seed: int | None = None  # None if the file does not record it
    steps: int | None = None
    ms_head: float | None = None  # Milliseconds of the head alone; 0 without a head
    precision: str = ""  # Arithmetic of the head; empty without one
    lpips_net: str = ""
    train_s: float | None = None
    prune_s: float | None = None
    peak_primitives: int | None = None
    peak_vram_mib: float | None = None
    gpu: str = ""  # Name of the GPU that rendered; empty for a CPU
    command: str = ""

    @property
    def full(self) -> Configuration:
        """The complete rendering: with the head, if the scene has one."""
        return self.configurations[0]

    @property
    def base(self) -> Configuration:
        """The rendering of base colours, without the head."""
        return self.configurations[-1]

    @property
    def has_head(self) -> bool:
        """Whether the scene has an enabled head."""
        return len(self.configurations) > 1

    def as_json(self) -> dict[str, Any]:
        """All measurements, including those of each view, as plain values for JSON."""
        plain = asdict(self)
        plain["bytes_total"] = self.full.bytes
        for configuration, entry in zip(self.configurations, plain["configurations"], strict=True):
            entry["mean"] = {metric.name: configuration.mean(metric.name) for metric in fields(ViewQuality)}
        return without_nan(plain)


@dataclass(frozen=True)
class Subject:
    """A scene, and the views in which it is measured; cameras and true images are on its device."""

    source: GaussianSource
    settings: RenderSettings
    background: Tensor
    cameras: Sequence[Camera]
    truths: Sequence[Tensor]  # True images [H, W, 3] in [0, 1]
    names: Sequence[str]  # Of the views
    facts: Mapping[str, Any]  # More fields of Measured
    capture: str = ""  # Identifies the capture or the scene that gives the views
    file_bytes: int | None = None  # None for a run: its Gaussians and head count in fp32
    frames: FrameReplay = field(default_factory=FrameReplay)

    @classmethod
    def of_run(cls, opened: Opened) -> Subject:
        """A run, or a file in the test views of a capture."""
        model = opened.model
        facts = {name: getattr(opened, name) for name in ("scene", "method", "variant", "seed", "steps", "prune_s")}
        peak = model.state.pruning["peak"] or None
        facts |= {"source": str(opened.source), "keep_ratio": opened.kept, "peak_primitives": peak}
        settings, cameras = model.render_settings(training=False), [model.camera_of(each) for each in opened.cameras]
        stated = placed_in(opened.capture).placed if (opened.capture / TRANSFORMS).is_file() else {}
        images = opened.datamanager.eval_dataset.image_filenames
        photos = [Path(stated.get(f"images/{path.name}", path.name)).name for path in images]
        views = (cameras, opened.truths, photos, facts, str(opened.capture.resolve()))
        return cls(model.source, settings, model._get_background_color(), *views, opened.packed_bytes)

    @classmethod
    def of_file(cls, scene: Scene, path: Path, title: str, views: Sequence[tuple[Camera, Tensor]]) -> Subject:
        """A scene in cameras, with the images of another one, which gives the ``title``."""
        facts = {"source": str(path), "scene": title}
        cameras, truths = [camera for camera, _ in views], [truth for _, truth in views]
        given = (cameras, truths, [f"camera {i}" for i in range(len(views))], facts, title, bytes_at(path))
        return cls(GaussianSource(scene.gaussians), scene.settings(), scene.background, *given)

    @torch.no_grad()
    def image(self, index: int, *, head: bool = True) -> Tensor:
        """A view as viewers render it, in [0, 1] ``[H, W, 3]``."""
        settings = self.settings if head else replace(self.settings, head=None)
        with naming_full_memory(lambda: self.source.total):
            return self.frames.render(self.source, self.cameras[index], self.background, settings)["rgb"]

    @torch.no_grad()
    def head_ms(self, index: int, time: Callable[[Callable[[], object]], float]) -> float:
        """Milliseconds of the head alone in a view; 0 if it does not run. Its second splatting pass does not count."""
        zoom, weight = scale_plan(self.cameras[index], self.settings.trained_focal)
        if self.settings.head is None or weight == 0:
            return 0.0
        camera = self.cameras[index].zoomed(zoom)
        primitives = self.source.primitives(camera, self.settings, features=True)
        images, splatted = draw(primitives, camera, self.background, self.settings, depth=False)
        return time(partial(compensate, self.settings.head, images["base_rgb"], splatted, self.background))


def against_photos(data: Path | None) -> Callable[[Path], Subject]:
    """A function that opens runs and files in the test views of a capture; a run comes first unless ``data`` names it.

    Files that do not say how their capture is read get the views of the first scene.
    """
    before: list[Opened] = []

    def subject(path: Path) -> Subject:
        from sundae_ns.plugin.finished_runs import load_model  # imports nerfstudio, which takes seconds

        with redirect_stdout(StringIO()), redirect_stderr(StringIO()):  # nerfstudio's messages
            before.append(load_model(path, data, like=before[0] if before else None))
        return Subject.of_run(before[-1])

    return subject


def against_first(path: Path, reference: Scene, cameras: Sequence[Camera]) -> Callable[[Path], Subject]:
    """A function that opens scenes in views of the scene at a path, ``reference``, whose images are the truth."""
    views = [(camera.to(reference.device), render(reference, camera).rgb) for camera in cameras]
    if blank := sum(bool((image == reference.background).all()) for _, image in views):
        _log.warning("%d of %d cameras see nothing of %s; %s", blank, len(views), path, OTHERS)
    middle, reach = middle_and_reach(usable(reference))

    def subject(other: Path) -> Subject:
        if other == path:
            return Subject.of_file(reference, path, path.name, [])
        scene = replace(aligned(load(other), reference), background_color=reference.background_color)
        there, size = middle_and_reach(usable(scene))
        if (away := float((there - middle).norm())) > max(reach, size) or not 0.5 <= size / reach <= 2:
            found = f"{other} is {size / reach:.3g} times as large as {path}, and its middle is {away:.3g} away"
            _log.warning("%s; if it was moved or scaled, undo that by sundae_ns.transform", found)
        return Subject.of_file(scene.to(reference.device), other, path.name, views)

    return subject


def cost_line(file: Path, source: Path, reference: Scene, name: str = "the whole scene", *, seed: int = 0) -> str:
    """What a file costs: its bytes of those of its source, and its images against those of the ``reference`` scene.

    At most 16 of the scene's cameras see both; without any, virtual ones that no prune of the ``seed`` sees.
    """
    given, views = reference.cameras, held_out_cameras(reference, reference.cameras, seed=seed)
    opened = against_first(source, reference, views)
    before, after = (measure(opened(path), repeats=0) for path in (source, file))
    values = [min(view.psnr, MOST_PSNR) for view in after.full.views]
    by = f"{len(views)}{f' of {len(given)}' if len(given) > len(views) else ''} {'' if given else 'held-out '}cameras"
    if given and views[0][2:] != given[0][2:]:
        by += f" at {views[0].width} x {views[0].height} px"
    sizes = f"{number(after.full.bytes / MEGABYTE, 2)} MB (of {number(before.full.bytes / MEGABYTE, 2)})"
    ssim = number(after.full.mean("ssim"), 3)
    return f"{sizes}; {fmean(values):.1f} dB, {ssim} against {name} on {by}, worst {min(values):.1f}"


def labels_of(paths: Sequence[Path]) -> list[str]:
    """Names of the files of some paths, or the paths where two names are the same."""
    names = [(path.parent if path.name == "config.yml" else path).name for path in paths]
    return [str(path) if names.count(name) > 1 else name for path, name in zip(paths, names, strict=True)]


@torch.no_grad()
def measure(
    subject: Subject,
    *,
    label: str = "",
    lpips: Lpips | None = None,
    warmup: int = 3,
    repeats: int = 5,
    progress: Callable[[], object] = lambda: None,
    command: str = "",
) -> Measured:
    """Evaluate and time a scene in its views, with the head and without; ``label`` is its name in tables.

    ``lpips`` is left out where its weights are missing. ``warmup`` renders of each view are untimed, ``repeats`` timed;
    none leaves times out. ``progress`` is called after each view, and the ``command`` recorded.
    """
    settings, gaussians = subject.settings, subject.source.gaussians
    device, head = gaussians["means"].device, settings.head
    ways = {HEAD_OFF: False} if head is None else {HEAD_ON: True, HEAD_OFF: False}
    time = partial(median_ms, device=device, warmup=warmup, repeats=repeats)
    times: dict[str, list[float]] = {name: [] for name in (*ways, "head")}
    views: dict[str, list[ViewQuality]] = {name: [] for name in ways}
    for i, truth in enumerate(subject.truths):
        for name, on in ways.items():
            views[name].append(quality_of(subject.image(i, head=on), truth, lpips))
            if repeats:
                times[name].append(time(partial(subject.image, i, head=on)))
        if repeats:
            times["head"].append(subject.head_ms(i, time))
        progress()
    bare = bytes_of({name: value for name, value in gaussians.items() if name != FEATURES})
    # A disabled head is not needed, and neither are its features. A file is read completely in any case.
    stored = (bare if head is None else bytes_of(gaussians), bytes_of_module(head))
    stored = stored if subject.file_bytes is None else (subject.file_bytes, 0)
    needed = {HEAD_ON: sum(stored), HEAD_OFF: subject.file_bytes or bare}
    resolutions = list(dict.fromkeys(f"{camera.width}x{camera.height}" for camera in subject.cameras))
    return Measured(
        label=label,
        **subject.facts,
        primitives=subject.source.total,
        bytes_primitives=stored[0],
        bytes_head=stored[1],
        resolution=resolutions[0] + " and others" if len(resolutions) > 1 else "".join(resolutions),
        configurations=tuple(
            Configuration(name, median(times[name]) if times[name] else None, needed[name], tuple(views[name]))
            for name in ways
        ),
        ms_head=median(times["head"]) if times["head"] else None,
        precision="" if head is None else "fp32" if device.type == "cpu" else head.config.precision,
        lpips_net=lpips.net if lpips is not None else "",
        gpu=torch.cuda.get_device_name(device) if device.type == "cuda" else "",
        command=command,
    )


def cells_of(runs: Sequence[Measured]) -> tuple[list[str], list[list[str]]]:
    """Heads, and the cells of each configuration of some scenes; columns in which nothing is measured are left out."""
    nets = sorted({run.lpips_net for run in runs if run.full.mean("lpips") is not None})
    heads = ["scene", "rendered with", "Gaussians", "MB", "ms per frame", "PSNR, dB", "worst, dB", "SSIM"]
    heads += ["colours fitted, dB", f"LPIPS ({', '.join(nets)})"]
    no_head = "no head" if any(run.has_head for run in runs) else "-"
    rows = []
    for run in runs:
        for way in run.configurations:
            psnr, *means = (number(way.mean(metric), digits) for metric, digits in METRICS)
            figures = [number(run.primitives, 0), number(way.bytes / MEGABYTE, 2), number(way.ms, 2)]
            worst = number(min((view.psnr for view in way.views), default=None), 2)
            rows.append([run.label, way.name if run.has_head else no_head, *figures, psnr, worst, *means])
    known = [i for i in range(len(heads)) if any(row[i] != "-" for row in rows)]
    return [heads[i] for i in known], [[row[i] for i in known] for row in rows]


def markdown(scenes: Mapping[str, Sequence[Measured]], notes: Sequence[str]) -> str:
    """The table of each scene, and what was left out, as a Markdown page; names stay text."""
    parts = []
    for scene, runs in scenes.items():
        heads, rows = cells_of(runs)
        cells = [[_plain(cell) for cell in row] for row in rows]
        parts.append(f"# {_plain(scene)}\n\n" + "\n".join(table(heads, cells, words=heads.index("Gaussians"))))
    return "\n\n".join([*parts, *(f"- Left out: {_plain(note)}" for note in notes)]) + "\n"


def _plain(text: str) -> str:
    """Text of one line in which Markdown and HTML mark nothing."""
    return re.sub(r"([\\`*\[\]|~])", r"\\\1", html.escape(" ".join(text.split()), quote=False))


def csv_text(runs: Sequence[Mapping[str, Any]]) -> str:
    """Runs of :meth:`Measured.as_json` as CSV; an empty cell means not measured."""
    buffer = StringIO()
    writer = csv.DictWriter(buffer, COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for run in runs:
        full, base = run["configurations"][0], run["configurations"][-1]
        cells = {"ms_frame": full["ms"], "ms_splat": base["ms"], **full["mean"]}
        cells |= {"psnr_base": base["mean"]["psnr"], "ssim_base": base["mean"]["ssim"]}
        cells["lpips_net"] = run["lpips_net"] if cells["lpips"] is not None else ""
        writer.writerow({**run, **cells})
    return buffer.getvalue()
