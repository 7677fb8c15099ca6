"""Entry point of ``sundae``: one subcommand a module, errors shown as one line."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro

from sundae_ns.cli.bench import app as bench
from sundae_ns.cli.files import export, prune
from sundae_ns.cli.packing import pack, unpack
from sundae_ns.errors import SundaeError

app = tyro.extras.SubcommandApp()
app.command(bench, name="bench", help="Measure a part of SUNDAE on this machine.")
for command in (pack, unpack, export, prune):
    app.command(command)


@app.command
def doctor(compile: bool = False) -> int:  # noqa: A002
    """Check what this machine can run, and say for each thing missing the command that mends it.

    Args:
        compile: build gsplat's CUDA kernels now if they are not built yet (minutes, needs nvcc).
    """
    from sundae_ns.cli.doctor import run_doctor

    return run_doctor(compile_kernels=compile)


@app.command
def scene(
    out: Annotated[Path, tyro.conf.Positional],
    seed: int = 0,
    train_views: int = 48,
    test_views: int = 8,
    width: int = 128,
    height: int = 128,
    points: int = 2000,
    kind: Literal["still-life", "wall"] = "still-life",
    sensor_noise: float = 0.0,
) -> int:
    """Write the embedded scene: a small ray-traced capture in nerfstudio format, with a sparse point cloud.

    Args:
        out: folder to write; it is the value for ns-train's --data.
        seed: varies everything; the same seed gives the same scene.
        train_views: training pictures.
        test_views: test pictures.
        width: pixels.
        height: pixels.
        points: size of the sparse point cloud.
        kind: the still life, or one flat painted wall, which needs next to nothing.
        sensor_noise: standard deviation of the noise of each pixel, in [0, 1].
    """
    from rich.progress import Progress

    from sundae_ns.data import write_scene

    with Progress(transient=True) as progress:
        task = progress.add_task("Ray tracing", total=train_views + test_views)
        write_scene(
            out,
            seed=seed,
            train_views=train_views,
            test_views=test_views,
            width=width,
            height=height,
            points=points,
            kind=kind,
            sensor_noise=sensor_noise,
            progress=lambda done, total: progress.update(task, completed=done, total=total),
        )
    print(f"wrote {train_views} training and {test_views} test views to {out}")
    return 0


@app.command
def demo(out: Annotated[Path, tyro.conf.Positional] = Path(".demo"), steps: int | None = None) -> int:
    """Make the embedded scene, train it with ns-train, evaluate it with ns-eval, and show what came out.

    Args:
        out: folder for the scene, the run and the pictures.
        steps: length of the training instead of sundae-tiny's own.
    """
    from sundae_ns.cli.demo import run_demo

    return run_demo(out, steps=steps)


@app.command
def report(
    runs: Annotated[list[Path], tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    data: Path | None = None,
    lpips_net: Literal["alex", "vgg", "squeeze"] = "alex",
    warmup: int = 3,
    repeats: int = 5,
) -> int:
    """Evaluate finished runs on their test views, speed beside error: tables, plots, curves over training.

    Args:
        runs: folders of runs of sundae and splatfacto, or their config.yml, which is read and not run; and packed
            scenes.
        out: folder to write.
        data: where the capture is, if it is not where the runs say; packed scenes do not say.
        lpips_net: net of LPIPS, which is taken where its weights are at hand; values of different nets do not compare.
        warmup: untimed renderings of each picture.
        repeats: timed renderings of each picture; 0 takes no times.
    """
    from sundae_ns.cli.report import run_report

    return run_report(runs, out, data=data, lpips_net=lpips_net, warmup=warmup, repeats=repeats)


@app.command
def bands(
    run: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    keep_ratio: tuple[float, ...] = (0.01, 0.1, 0.3),
    signal: Literal["positions", "attributes"] = "positions",
    gamma: float = 0.5,
    neighbors: int = 16,
    bandwidth: Literal["robust", "literal"] = "robust",
    view: int | None = None,
) -> int:
    """Show what the high-pass, the low-pass and the combined rule keep of a field: point clouds, pictures and figures.

    Args:
        run: a run of sundae or splatfacto (its folder, config.yml or a checkpoint), or a 3DGS .ply.
        out: folder to write to; made if need be.
        keep_ratio: shares of the primitives to keep, each in (0, 1].
        signal: graph signal that is filtered: the paper's positions, or position, colour, opacity and size.
        gamma: share that the combined rule takes from the high end.
        neighbors: most neighbours of a primitive in the graph.
        bandwidth: how reach and width of the graph's edges are found; literal is the paper's.
        view: training view to look through; by default the one that sees most of the field.
    """
    from sundae_ns.cli.bands import run_bands
    from sundae_ns.pruning import PruningConfig

    config = PruningConfig(signal=signal, gamma=gamma, num_neighbors=neighbors, bandwidth=bandwidth)
    return run_bands(run, out, keep_ratios=keep_ratio, config=config, view=view)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run ``sundae``; exits with 2 and one line on an error of ours."""
    try:
        with warnings.catch_warnings():
            # nerfstudio's own, at its import: a user of ours can do nothing about them.
            warnings.filterwarnings("ignore", category=FutureWarning, module="nerfstudio")
            code = app.cli(prog="sundae", description="SUNDAE for nerfstudio.", args=arguments)
    except SundaeError as error:
        print(f"sundae: {error}", file=sys.stderr)
        sys.exit(2)
    sys.exit(code or 0)
