"""``sundae train``: the options of ``ns-train`` that everyone sets, under short names, and then a packed scene."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from importlib.metadata import entry_points
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import tyro

from sundae_ns.cli.process import run_in_group, word
from sundae_ns.errors import STOPPED, ConfigError, DataError

PACKED = "scene.sundae"
"""Name of the packed scene in the folder of its run."""
LENGTHS = ("--max-num-iterations", "--schedule-length", "--finetune-steps")
"""Options of ns-train that say when a training ends."""


def methods() -> list[str]:
    """Names of this package's methods in ``ns-train``."""
    points = entry_points(group="nerfstudio.method_configs")
    return sorted(point.name for point in points if point.value.startswith("sundae_ns."))


def train(
    capture: Annotated[Path, tyro.conf.Positional],
    further: Annotated[tuple[str, ...], tyro.conf.Positional] = (),
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("outputs"),
    method: str = "sundae",
    keep: float | None = None,
    steps: int | None = None,
    resume: bool = False,
) -> int:
    """Print a command of ns-train and run it; then pack the scene into scene.sundae in the run's folder.

    On a GPU the pack is fine-tuned, in place of the last steps of a long run.

    Args:
        capture: folder of the capture: a transforms.json, a COLMAP model (sparse/0, dense/sparse) beside its images, or
            Blender's transforms_train.json.
        further: behind --, any options of ns-train, as in sundae train CAPTURE -- --pipeline.model.sh-degree 2
        out: folder of runs.
        method: one of sundae, sundae-fast, -continuous, -paper; sundae-tiny suits small images and a CPU.
        keep: share of the primitives to keep, in (0, 1]; by default as many as the scene needs, or
            that of the method.
        steps: number of training steps; by default that of the method.
        resume: train the remaining steps of the newest unfinished run of this method on this capture.
    """
    from sundae_ns.storage.run_folder import new_name, unfinished_run

    if further and not (further[0].startswith("-") or _is_parser(further[0])):
        raise ConfigError(f"{further[0]} is no option; options of ns-train follow a --")
    if resume and steps is not None:
        raise ConfigError("a resumed run trains its remaining steps; leave out --steps or --resume")
    check(capture, method, keep, steps)
    unfinished, more = unfinished_run(out, method, capture), list(further)
    if resume and unfinished is None:
        raise ConfigError(f"{out} has no unfinished run of {method} on {capture}; leave out --resume")
    given = _value_of("--timestamp", more)
    name = given or new_name()
    if unfinished is not None and resume:
        folder = unfinished[0]
        name = folder.name
        more[:0] = [f"--experiment-name={folder.parent.parent.name}", "--timestamp", name]
        more[:0] = ["--load-dir", word(folder / "nerfstudio_models")]
    elif given is None:
        more[:0] = ["--timestamp", name]
    tunes = has_gpu()
    if tunes and not any(_value_of(option, further) for option in LENGTHS):
        more[:0] = finetune_words()
    words = command(capture, out, method, keep, steps, more)  # refuses a damaged capture before it speaks of runs
    if unfinished is not None and not resume and not (unfinished.folder / PACKED).exists():
        folder, done, length = unfinished
        again = ["sundae", "train", word(capture), "--resume"]
        again += ["-o", word(out)] if out != Path("outputs") else []
        again += ["--method", method] if method != "sundae" else []
        print(f"# {folder} ended after {done:,} of {length:,} steps; this is a new run. To resume the other:")
        print(f"#     {shlex.join(again)}")
    print(shlex.join(words), flush=True)
    code = run_in_group(words)
    # Options of ns-train may have put the run elsewhere; then its last line names the command that packs it.
    run = next((path.parent for path in out.glob(f"*/{method}/{name}/config.yml")), None)
    return code if code or run is None else _pack(run, tunes=tunes)


def _pack(run: Path, *, tunes: bool) -> int:
    """Pack a finished run, without a fine-tune where that fails; the exit code."""
    more = ["--overwrite"] if (run / PACKED).exists() else []  # of the steps before a resume
    for finetune in (True, False) if tunes else (False,):
        words = pack_command(run, run / PACKED, *more, finetune=finetune)
        print(shlex.join(words), flush=True)
        code = run_in_group(words, saves=False)
        if not code or code in STOPPED:
            break
    return code


def pack_command(run: Path, out: Path, *more: str, finetune: bool) -> list[str]:
    """The words of the command that packs a run, with further words, and with a fine-tune if asked for."""
    from sundae_ns.storage.pack import FINETUNE_STEPS

    words = ["sundae", "pack", word(run), "-o", word(out), *more]
    return [*words, "--finetune", str(FINETUNE_STEPS)] if finetune else words


def finetune_words() -> list[str]:
    """Words of ns-train that leave the last steps to the fine-tune of :func:`pack_command`."""
    from sundae_ns.storage.pack import FINETUNE_STEPS

    return ["--finetune-steps", str(FINETUNE_STEPS)]


def has_gpu() -> bool:
    """Whether a GPU trains; imports torch, which takes a second, so ask only where it matters."""
    import torch

    return torch.cuda.is_available()


def _value_of(option: str, words: Sequence[str]) -> str | None:
    """What follows an option of ns-train, after a space or ``=``; None without it."""
    for given, following in pairwise([*words, None]):
        if given == option:
            return following
        if given is not None and given.startswith(f"{option}="):
            return given.partition("=")[2]
    return None


def check(capture: Path, method: str, keep: float | None, steps: int | None) -> None:
    """Check the options of :func:`train`; of the capture, only that it exists.

    Raises:
        ConfigError: there is no such method, or a number is out of range.
        DataError: the capture does not exist.
    """
    if not capture.exists():
        raise DataError(f"{capture} does not exist; give the folder of a capture")
    if method not in methods():
        raise ConfigError(f"{method} is no method of sundae; use one of {', '.join(methods())}")
    if keep is not None and not 0 < keep <= 1:
        raise ConfigError(f"keep is {keep}; give a share in (0, 1]")
    if steps is not None and steps < 1:
        raise ConfigError(f"steps is {steps}; give at least 1")


def command(
    capture: Path, out: Path, method: str, keep: float | None, steps: int | None, more: Sequence[str] = ()
) -> list[str]:
    """The words of the command; options as in :func:`train`, checked by :func:`check`.

    Args:
        more: further words of ns-train; a parser of captures may stand among them.

    Raises:
        DataError: the capture is in COLMAP's or Blender's layout and damaged.
    """
    from sundae_ns.data.layouts import posed_layout

    layout = None if any(_is_parser(one) for one in more) else posed_layout(capture)
    words = ["ns-train", method, "--data", word(capture), "--output-dir", word(out)]
    if keep is not None:
        words += ["--pipeline.model.pruning.keep-ratio", f"{keep:g}"]
    if steps is not None:
        words += ["--max-num-iterations", str(steps)]
    # The parser and its options come last.
    return [*words, *more] if layout is None else [*words, *layout.options, *more, *layout.words]


def _is_parser(word: str) -> bool:
    """Whether a word of ns-train names a parser of captures."""
    return word in ("colmap", "minimal-parser") or (word.endswith("-data") and not word.startswith("-"))
