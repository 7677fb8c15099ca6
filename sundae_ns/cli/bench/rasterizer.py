"""``sundae bench rasterizer``: milliseconds of the rasterisers, each with the error of the timed view."""

from __future__ import annotations

import json as jsonlib
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, cast

import torch
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import Tensor

from sundae_ns.cli.bench.figures import significant
from sundae_ns.cli.bench.shards import parse_shard
from sundae_ns.errors import BackendError, ConfigError, DataError
from sundae_ns.evaluation.timing import now
from sundae_ns.rasterization import Backend, BackendName, rasterize, select_backend

DTYPES = {"float32": torch.float32, "float64": torch.float64}
DEPTHS = (2.0, 4.0)
"""Nearest and farthest depth of primitives, world units."""
WORTH_IT = 20.0
"""Seconds after which no further repeat starts."""


CANDIDATES: tuple[tuple[BackendName, str], ...] = (
    ("gsplat", "cuda"),
    ("reference", "cuda"),
    ("cpu", "cpu"),
    ("reference", "cpu"),
)
"""Rasterisers and their devices; by default all that run here are measured."""


@dataclass(frozen=True)
class Case:
    """One measurement: the fields that tell rows apart."""

    rasterizer: BackendName
    device: str
    dtype: str
    primitives: int
    width: int
    height: int
    channels: int
    pixels: float
    seed: int
    threads: int


Drawn = dict[str, Tensor]
"""Tensors by name: activated primitives, a camera, or the results of rendering them."""


def run_rasterizer(
    *,
    counts: Sequence[int],
    rasterizers: Sequence[BackendName],
    dtypes: Sequence[str],
    size: tuple[int, int],
    channels: int,
    pixels: float,
    repeats: int,
    seed: int,
    shard: str,
    output: Path | None,
    json: bool,
) -> int:
    """Measure and print; options are those of the command.

    Raises:
        BackendError: a rasteriser that was asked for does not run here.
        ConfigError: an option cannot work.
        DataError: a line of the output file is no JSON.
    """
    if not counts or min(counts) < 1 or min(size) < 1 or channels < 1 or repeats < 1 or not pixels > 0:
        raise ConfigError("nothing to measure: primitives, size, channels, pixels and repeats must be at least 1")
    index, parts = parse_shard(shard)
    threads = torch.get_num_threads()
    cases = [
        Case(name, device, dtype, count, *size, channels, pixels, seed, threads)
        for count in counts
        for name, device in _backends(rasterizers)
        for dtype in dtypes
        if not (name == "gsplat" and dtype == "float64")  # its kernels know no other precision
    ][index::parts]
    rows = {case: row for row in _read(output) if (case := _case_of(row)) in cases}
    if done := len(rows):
        print(f"{output} has {done} of {len(cases)} rows already", file=sys.stderr)
    todo = [case for case in cases if case not in rows]
    oracle = _Oracle()
    for case in track(todo, description="Rasterisers", transient=True, console=Console(stderr=True), disable=not todo):
        rows[case] = {"benchmark": "rasterizer", **asdict(case), **measure(case, oracle(case), repeats)}
        if output is not None:
            output.parent.mkdir(parents=True, exist_ok=True)
            with output.open("a") as lines:
                lines.write(jsonlib.dumps(rows[case]) + "\n")
        if json:
            print(jsonlib.dumps(rows[case]), flush=True)
    if not json:
        title = f"{size[0]}x{size[1]}, {channels} channels, primitives of {pixels:g} px, {threads} threads"
        Console().print(_table([rows[case] for case in cases], title))
    return 0


def draw_view(case: Case) -> tuple[Drawn, Drawn]:
    """Activated primitives and a camera, float64 on the CPU; rounded to float32, so that all dtypes get the same inputs.

    Centres are uniform over image and depth, opacities in [0, 1]. Standard deviations on the screen are uniform between 0.5
    and 1.5 times ``case.pixels``.
    """
    generator = torch.Generator().manual_seed(case.seed)

    def even(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    n, focal = case.primitives, 1.2 * max(case.width, case.height)
    depth = DEPTHS[0] + (DEPTHS[1] - DEPTHS[0]) * even(n, 1)
    screen = (even(n, 2) - 0.5) * torch.tensor([case.width, case.height])
    scene = {
        "means": torch.cat([screen * depth / focal, depth], dim=1),
        "quats": torch.randn(n, 4, generator=generator, dtype=torch.float64),
        "scales": case.pixels * depth / focal * (0.5 + even(n, 3)),
        "opacities": even(n),
        "colors": even(n, case.channels),
    }
    K = torch.tensor([[focal, 0, case.width / 2], [0, focal, case.height / 2], [0, 0, 1]], dtype=torch.float64)
    camera = {"viewmat": torch.eye(4, dtype=torch.float64), "K": K}
    return tuple({key: value.float().double() for key, value in part.items()} for part in (scene, camera))  # type: ignore[return-value]


def measure(case: Case, exact: Drawn, repeats: int) -> dict[str, Any]:
    """Times in milliseconds, medians after one run that is not timed; errors against the oracle.

    ``cpu_ms`` is processor time of all threads. If it is less than the wall clock of one thread, the machine was shared.

    Args:
        case: the measurement.
        exact: from :func:`render` by the reference in float64.
        repeats: timed runs; fewer if together they take longer than ``WORTH_IT`` seconds.
    """
    backend = select_backend(case.rasterizer, case.device)
    cotangents = _cotangents(case, DTYPES[case.dtype], case.device)
    scene, camera = (
        {key: value.to(case.device, DTYPES[case.dtype]) for key, value in part.items()} for part in draw_view(case)
    )
    found = render(case, scene, camera, cotangents, backend)
    errors = {key: (found[key].cpu().double() - exact[key]) for key in exact}
    gradients = {
        key: float(errors[key].norm()) / max(float(exact[key].norm()), 1e-30) for key in errors if key in scene
    }
    image = torch.cat([errors["image"], errors["alpha"]], dim=-1).abs()
    del found, errors

    def forward() -> None:
        with torch.no_grad():
            _image(case, scene, camera, backend)

    forward_ms, forward_cpu_ms, _ = _median_ms(forward, repeats, case.device)
    both = _median_ms(lambda: render(case, scene, camera, cotangents, backend), repeats, case.device)
    return {
        "forward_ms": significant(forward_ms),
        "forward_backward_ms": significant(both[0]),
        "forward_cpu_ms": significant(forward_cpu_ms),
        "forward_backward_cpu_ms": significant(both[1]),
        "repeats": both[2],
        "max_error": significant(float(image.max())),
        "mean_error": significant(float(image.mean())),
        "gradient_error": significant(max(gradients.values())),
        **{f"gradient_error_{key}": significant(value) for key, value in gradients.items()},
        "device_name": torch.cuda.get_device_name() if case.device == "cuda" else f"CPU, {case.threads} threads",
        "torch": torch.__version__,
    }


def render(case: Case, scene: Drawn, camera: Drawn, cotangents: tuple[Tensor, Tensor], backend: Backend) -> Drawn:
    """Image ``[H, W, C]``, alpha ``[H, W, 1]``, and the gradients of their inner products with the cotangents.

    No torch operation stands between rasteriser and gradients: it would be timed, and its idle threads would occupy the cores
    of the backward pass.
    """
    leaves = {key: value.detach().requires_grad_() for key, value in scene.items()}
    image, alpha = _image(case, leaves, camera, backend)
    gradients = torch.autograd.grad((image, alpha), list(leaves.values()), cotangents)
    return {"image": image.detach(), "alpha": alpha.detach(), **dict(zip(leaves, gradients))}


class _Oracle:
    """Result of the reference in float64 on the CPU, cached for rows of the same view."""

    def __init__(self) -> None:
        self._view: tuple[object, ...] | None = None
        self._exact: Drawn = {}

    def __call__(self, case: Case) -> Drawn:
        view = (case.primitives, case.width, case.height, case.channels, case.pixels, case.seed)
        if view != self._view:
            self._exact = render(case, *draw_view(case), _cotangents(case), select_backend("reference", "cpu"))
            self._view = view
        return self._exact


def _image(case: Case, scene: Drawn, camera: Drawn, backend: Backend) -> tuple[Tensor, Tensor]:
    view = rasterize(
        scene["means"],
        scene["quats"],
        scene["scales"],
        scene["opacities"],
        scene["colors"],
        camera["viewmat"],
        camera["K"],
        case.width,
        case.height,
        backend=backend,
    )
    return view.colors, view.alpha


def _cotangents(case: Case, dtype: torch.dtype = torch.float64, device: str = "cpu") -> tuple[Tensor, Tensor]:
    """Cotangents of image and alpha: fixed random numbers, exact in float32."""
    generator = torch.Generator().manual_seed(case.seed + 1)
    cotangent = torch.randn(case.height, case.width, case.channels + 1, generator=generator).to(device, dtype)
    return cotangent[..., :-1].contiguous(), cotangent[..., -1:].contiguous()


def _backends(names: Sequence[BackendName]) -> Iterator[tuple[BackendName, str]]:
    """Rasterisers and their devices: the named ones, or by default all that run here."""
    if names:
        for name in names:
            device = "cuda" if name == "gsplat" else "cpu"
            yield cast(BackendName, select_backend(name, device).name), device  # not auto
        return
    for name, device in CANDIDATES:
        if device == "cuda" and not torch.cuda.is_available():
            continue
        try:
            select_backend(name, device)
        except BackendError as error:
            print(f"without {name}: {error}", file=sys.stderr)
            continue
        yield name, device


def _median_ms(function: Callable[[], object], repeats: int, device: str) -> tuple[float, float, int]:
    """Median wall-clock milliseconds, median processor milliseconds, and the number of runs."""
    function()
    times: list[float] = []
    busy: list[float] = []
    while len(times) < repeats and sum(times) < WORTH_IT:
        started, computed = now(device), time.process_time()
        function()
        times.append(now(device) - started)
        busy.append(time.process_time() - computed)
    return 1e3 * statistics.median(times), 1e3 * statistics.median(busy), len(times)


def _read(output: Path | None) -> Iterator[dict[str, Any]]:
    if output is None or not output.exists():
        return
    for number, line in enumerate(output.read_text().splitlines(), 1):
        try:
            row = jsonlib.loads(line)
        except ValueError as error:
            raise DataError(f"{output}, line {number} is no JSON: remove the line, and it is measured again") from error
        if isinstance(row, dict):
            yield row


def _case_of(row: dict[str, Any]) -> Case | None:
    try:
        return Case(**{field.name: row[field.name] for field in fields(Case)})
    except KeyError:
        return None


def _table(rows: Sequence[dict[str, Any]], title: str) -> Table:
    caption = "milliseconds; largest and mean error of the image, worst relative error of a gradient"
    table = Table(title=title, caption=caption, box=None, pad_edge=False)
    for column in ("N", "rasterizer", "in", "forward", "both ways", "max", "mean", "gradient"):
        table.add_column(column, justify="right", no_wrap=True)
    for row in rows:
        name = row["rasterizer"] if row["device"] == "cpu" else f"{row['rasterizer']} ({row['device']})"
        times = (f"{row[key]:.2f}" for key in ("forward_ms", "forward_backward_ms"))
        errors = (f"{row[key]:.1e}" for key in ("max_error", "mean_error", "gradient_error"))
        table.add_row(f"{row['primitives']:,}", name, row["dtype"], *times, *errors)
    return table
