"""Entry point of ``sundae``: one module per subcommand, errors on one line."""

from __future__ import annotations

import atexit
import gc
import os
import sys
import warnings
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated, Literal

import tyro

from sundae_ns.cli.bench import app as bench
from sundae_ns.cli.files import export, prune
from sundae_ns.cli.outputs import Overwrite, check_file, check_folder
from sundae_ns.cli.packing import pack, unpack
from sundae_ns.cli.render import render
from sundae_ns.cli.run import run
from sundae_ns.cli.train import train
from sundae_ns.cli.view import view
from sundae_ns.errors import ConfigError, SundaeError, writing

ENVIRONMENT = {
    # Where another program takes one of two cores, threads that spin while they wait make a training step on a CPU ten
    # times as long.
    "OMP_WAIT_POLICY": "PASSIVE",
    # glibc would return the memory of a step's images to the system and fetch it again, a thousand pages a step.
    "MALLOC_MMAP_THRESHOLD_": str(2**25),
    "MALLOC_TRIM_THRESHOLD_": str(2**28),
}
"""Variables of threads and memory; those that the user has set stay."""

app = tyro.extras.SubcommandApp()
app.command(bench, name="bench", help="Benchmark SUNDAE on this machine.")
for command in (run, train, pack, unpack, export, view, render, prune):
    app.command(command)


def _loading() -> AbstractContextManager[object]:
    """Shows that a command imports its modules, which takes seconds."""
    from rich.console import Console

    return Console(stderr=True).status("Loading")


@app.command
def doctor(compile: bool = False) -> int:  # noqa: A002
    """Check this machine, and print the command that installs or repairs each missing part.

    Args:
        compile: build gsplat's CUDA kernels if they are not built yet; this takes minutes and needs nvcc.
    """
    with _loading():
        from sundae_ns.cli.doctor import run_doctor

    return run_doctor(compile_kernels=compile)


@app.command
def demo(
    out: Annotated[Path, tyro.conf.Positional] = Path(".demo"),
    steps: int | None = None,
    overwrite: Overwrite = False,
) -> int:
    """Train a small scene with ns-train, evaluate it with ns-eval, and print the results.

    Args:
        out: folder for the capture, the run and the images.
        steps: number of training steps; by default that of sundae-tiny.
        overwrite: replace an earlier demo in the folder.
    """
    check_folder(out, reads=[], overwrite=overwrite)
    with _loading():
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
    video: Path | None = None,
    overwrite: Overwrite = False,
) -> int:
    """Measure quality, speed and size of finished runs on their test views; write tables, plots and training curves.

    Args:
        runs: runs of sundae or splatfacto (their folders or config.yml), and packed scenes. No code in them is executed.
        out: folder to write.
        data: folder of the capture, if it moved; packed scenes need it, because they do not record it.
        lpips_net: net of LPIPS, which is measured if its weights are on disk; values of different nets do not compare.
        warmup: untimed renderings of each view before timing.
        repeats: timed renderings of each view; 0 measures no times.
        video: .mp4 to write of one scene: base colours, compensated image and photograph of every view, side by side.
        overwrite: replace the files of an earlier report in the folder.
    """
    check_folder(out, reads=[*runs, data], overwrite=overwrite)
    if video is not None:
        if video.suffix.lower() != ".mp4":
            raise ConfigError(f"{video} does not end in .mp4, the only format of videos; rename it")
        if video.resolve().parent != out.resolve():  # the report's folder was checked
            check_file(video, reads=[*runs, data], overwrite=overwrite)
    with _loading():
        from sundae_ns.cli.report import run_report

    return run_report(runs, out, data=data, lpips_net=lpips_net, warmup=warmup, repeats=repeats, video=video)


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
    overwrite: Overwrite = False,
) -> int:
    """Show the primitives that the high-pass, low-pass and combined rules keep: point clouds, images and statistics.

    Args:
        run: a run of sundae or splatfacto (its folder, config.yml or a checkpoint), or a 3DGS .ply file.
        out: folder to write; created if missing.
        keep_ratio: shares of the primitives to keep, each in (0, 1].
        signal: graph signal to filter: positions, as in the paper, or position, colour, opacity and size.
        gamma: share of the kept primitives that the combined rule takes from the largest responses.
        neighbors: maximum number of neighbours of a primitive in the graph.
        bandwidth: rule that sets radius and width of the graph's edge weights; literal is the paper's.
        view: index of the training view to draw; by default the one with the most primitives.
        overwrite: replace the files of an earlier command in the folder.
    """
    check_folder(out, reads=[run], overwrite=overwrite)
    with _loading():
        from sundae_ns.cli.bands import run_bands
        from sundae_ns.pruning import PruneRule

    rule = PruneRule(signal=signal, gamma=gamma, num_neighbors=neighbors, bandwidth=bandwidth)
    return run_bands(run, out, shares=keep_ratio, rule=rule, view=view)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run ``sundae``; a :class:`SundaeError` is printed on one line, and the exit code is 2."""
    words = sys.argv[1:] if arguments is None else arguments
    # Before torch is loaded, and for the commands that these run.
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    if arguments is None:  # the process is the command's own
        # Imports make a million objects that stay. To look for garbage among them takes a sixth of the start, and 0.6 s of
        # the end.
        gc.set_threshold(100_000)
        atexit.register(gc.freeze)
    try:
        # Commands name the file that they cannot write; this covers the rest, such as a full disk behind stdout.
        with warnings.catch_warnings(), writing(f"{' '.join(words[:1])} ended early"):
            # Warnings of nerfstudio's imports, which users of sundae cannot fix.
            warnings.filterwarnings("ignore", category=FutureWarning, module="nerfstudio")
            code = app.cli(prog="sundae", description="SUNDAE for nerfstudio.", args=words)
            sys.stdout.flush()
    except SundaeError as error:
        if os.environ.get("SUNDAE_TRACEBACK"):
            raise
        print(f"sundae: {error}", file=sys.stderr)
        sys.exit(2)
    except BrokenPipeError:  # the reader of stdout has left, as head does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
    except KeyboardInterrupt:
        print("sundae: interrupted", file=sys.stderr)
        sys.exit(130)
    sys.exit(code or 0)
