"""``sundae train``: the options of ``ns-train`` that everyone sets, under short names, and then a packed scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from itertools import pairwise
from pathlib import Path

import torch

from sundae_ns.cli.options import Advanced, Details, File, Flag, Input, Int, Out, Plain, Rest, Wishes, word, words_of
from sundae_ns.cli.process import run_command
from sundae_ns.cli.refusals import check_folder, check_least
from sundae_ns.core.errors import STOPPED, ConfigError, DataError
from sundae_ns.core.tables import MEGABYTE
from sundae_ns.data.layouts import is_posed, no_transforms, posed_layout
from sundae_ns.io.pack.config import FINETUNE_STEPS, FINETUNED_SIZE
from sundae_ns.io.run_folder import new_name, unfinished_run

PACKED = "scene.sundae"
LENGTHS = ("--max-num-iterations", "--schedule-length", "--finetune-steps")  # options of ns-train


@dataclass(frozen=True)
class TrainOptions(Wishes):
    """Options of a training that everyone sets; without an amount it keeps as many Gaussians as the scene needs."""

    method: str = "sundae"  # one of sundae, sundae-fast, -continuous, -paper; sundae-tiny suits small images and a CPU
    steps: Int = None  # number of training steps; by default that of the method
    advanced: Advanced[Details] = Details()

    def check(self, capture: Path) -> None:
        """Raise ``DataError`` if the capture does not exist, and ``ConfigError`` for a wrong option."""
        if not capture.exists():
            raise DataError(f"{capture} does not exist; check the path")
        methods = entry_points(group="nerfstudio.method_configs", module="sundae_ns.method_configs").names
        if self.method not in methods:
            raise ConfigError(f"{self.method} is no method of sundae; use one of {', '.join(sorted(methods))}")
        self.check_wishes()
        if self.count is not None and self.cleans:
            raise ConfigError(f"a training reaches --count before {self.cleans[0]} cuts; give both to sundae pack")
        check_least(steps=(self.steps, 1), seed=(self.advanced.seed, 0))

    def words(
        self, capture: Path, out: Path, more: Sequence[str] = (), *, tunes: bool = False, masks: Path | None = None
    ) -> list[str]:
        """The command of ``ns-train``, with ``more`` options and perhaps a parser of captures among them.

        ``tunes`` says whether the pack is fine-tuned, which takes the place of the last steps of a long run; ``masks``
        is a folder of them for a capture in COLMAP's layout.
        """
        words = ["ns-train", self.method, "--data", word(capture), "--output-dir", word(out)]
        # Trials count the bytes of packs without a fine-tune. Of methods that try no counts the pack alone is limited.
        most = round((self.max_mb or 0) * MEGABYTE / (FINETUNED_SIZE if tunes else 1))
        given = {
            "--pipeline.model.pruning.keep-ratio": self.keep,
            "--pipeline.model.pruning.target-gaussians": self.count,
            "--pipeline.model.pruning.max-bytes": most or None if self.method == "sundae" else None,
            "--pipeline.model.head.mode": "off" if self.advanced.no_head else None,
            "--machine.seed": self.advanced.seed,
            "--pipeline.datamanager.train-cameras-sampling-seed": self.advanced.seed,
            "--pipeline.model.pruning.seed": self.advanced.seed,
            "--max-num-iterations": self.steps,
        }
        if tunes and not any(text.startswith(LENGTHS) for text in more):
            given["--finetune-steps"] = FINETUNE_STEPS
        words += [text for option, value in given.items() if value is not None for text in (option, str(value))]
        layout = None if any(map(_is_parser, more)) else posed_layout(capture, masks)
        if masks is not None and (layout is None or layout.words[0] != "colmap"):
            raise ConfigError(f"{capture} is not in COLMAP's layout; give frames their mask_path in transforms.json")
        # The parser and its options come last.
        return [*words, *more] if layout is None else [*words, *layout.options, *more, *layout.words]

    @property
    def pack_words(self) -> list[str]:
        """Words of ``sundae pack`` for the run."""
        return [*words_of(self, "max_mb", "crop", "remove_floaters"), *words_of(self.advanced, "up", "start_view")]


def train(
    capture: Input,
    further: Rest = (),
    out: Out = Path("outputs"),
    resume: Flag = False,
    masks: File = None,
    options: Plain[TrainOptions] = TrainOptions(),  # noqa: B008
) -> int:
    """Print a command of ns-train and run it; then pack the scene into scene.sundae in the run's folder.

    On a GPU the pack is fine-tuned, in place of the last steps of a long run.

    Args:
        capture: folder of the capture: a transforms.json, a COLMAP model (sparse/0, dense/sparse) beside its images, or
            Blender's transforms_train.json.
        further: behind --, any options of ns-train, as in sundae train CAPTURE -- --pipeline.model.sh-degree 2
        out: folder of runs.
        resume: train the remaining steps of the newest unfinished run of this method on this capture.
        masks: folder with a mask for each photo of a COLMAP capture, under its name; training leaves out what is black.
    """
    if further and not (further[0].startswith("-") or _is_parser(further[0])):
        raise ConfigError(f"{further[0]} is no option; options of ns-train follow a --")
    if resume and options.steps is not None:
        raise ConfigError("a resumed run trains its remaining steps; leave out --steps or --resume")
    options.check(capture)
    if not is_posed(capture) and not any(map(_is_parser, further)):
        raise no_transforms(capture)
    check_folder(out, reads=[], overwrite=True)
    old, step, length = unfinished_run(out, options.method, capture) or (None, 0, 0)
    more = list(further)
    split = [piece for text in further for piece in text.split("=", 1)]
    given = next((value for name, value in pairwise(split) if name == "--timestamp"), None)
    name = given or new_name()
    if resume:
        if old is None:
            raise ConfigError(f"{out} has no unfinished run of {options.method} on {capture}; leave out --resume")
        name = old.name
        more[:0] = [f"--experiment-name={old.parent.parent.name}", "--load-dir", word(old / "nerfstudio_models")]
    if resume or given is None:
        more[:0] = ["--timestamp", name]
    tunes = torch.cuda.is_available()
    # Refuses a damaged capture before runs are mentioned.
    words = options.words(capture, out, more, tunes=tunes, masks=masks)
    if not resume and old is not None and not (old / PACKED).exists():
        print(f"# {old} ended after {step:,} of {length:,} steps; this is a new run; to resume the other, add --resume")
    code = run_command(words)
    # Options of ns-train may have put the run elsewhere; then its last line names the command that packs it.
    run = next((path.parent for path in out.glob(f"*/{options.method}/{name}/config.yml")), None)
    if code or run is None:
        return code
    stale = ["--overwrite"] if (run / PACKED).exists() else []  # of the steps before a resume
    return pack_run(run, run / PACKED, *options.pack_words, *stale, finetune=tunes and not options.cleans)


def pack_run(run: Path, out: Path, *more: str, finetune: bool) -> int:
    """Pack a finished run, without the fine-tune if it fails, as where the GPU's memory is full; the exit code."""
    words = ["sundae", "pack", word(run), "-o", word(out), *more]
    if finetune:
        if not (code := run_command([*words, "--finetune", str(FINETUNE_STEPS)])) or code in STOPPED:
            return code
        print(f"# the fine-tune ended with {code}; packing without it:")
    return run_command(words)


def _is_parser(word: str) -> bool:
    """Whether a word of ns-train names a parser of captures."""
    return word in ("colmap", "minimal-parser") or (word.endswith("-data") and not word.startswith("-"))
