"""Fingerprints of runs: equal wherever a method is trained, different for every option that decides a result."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

import pytest
import yaml

from harness.job import parse
from sundae_ns.storage.config_file import load_config
from sundae_ns.storage.fingerprint import LEFT_OUT, LENGTH, fingerprint

SUNDAE = ("sundae", "--data", "bonsai")
COLMAP = ("colmap", "--colmap-path", "sparse/0", "--eval-mode", "interval")


class Kind(Enum):
    ONE = "one"


@dataclass
class Part:
    _target: type = Path
    rate: float = 1e-15
    sizes: tuple[int, ...] = (3, 64)
    kind: Kind = Kind.ONE
    limit: int | None = None


@dataclass
class Options:
    """Stands for a configuration; the golden value below depends on no default of ours."""

    part: Part = field(default_factory=Part)
    groups: dict[str, Any] = field(default_factory=lambda: {"b": {"lr": 0.1}, "a": Part(rate=2.0)})
    recorded: bool = True
    place: Path = Path("x")
    machine: str = "this one"


@dataclass
class LaterOptions(Options):
    bolder: bool = False
    budget: int | None = None


def of(*words: str, base: tuple[str, ...] = SUNDAE, parser: tuple[str, ...] = ()) -> str:
    return fingerprint(parse((*base, *words, *parser)))


def test_it_is_the_same_on_every_machine_and_python() -> None:
    assert fingerprint(Options()) == "jhiljaia"
    assert len(fingerprint(Options())) == LENGTH
    assert fingerprint(Options(machine="another", place=Path("y"))) == fingerprint(Options())
    assert fingerprint(Options(groups={"a": Part(rate=2), "b": {"lr": 0.1}})) == fingerprint(Options())


def test_a_new_option_that_is_off_changes_nothing() -> None:
    before = Options()
    LaterOptions.__name__, name = Options.__name__, LaterOptions.__name__
    try:
        assert fingerprint(LaterOptions()) == fingerprint(before)
        assert fingerprint(LaterOptions(budget=0)) != fingerprint(before)
        assert fingerprint(LaterOptions(bolder=True)) != fingerprint(before)
    finally:
        LaterOptions.__name__ = name


def test_a_decision_by_the_capture_counts_as_the_option_before_it() -> None:
    """Rows of captures on which it decides against the option stay those of today."""
    before: Any = parse(SUNDAE)
    before.pipeline.model.photo_gains = None
    auto, on, off = (of("--pipeline.model.photo-gains", mode) for mode in ("auto", "on", "off"))
    assert fingerprint(before) == auto
    assert len({auto, on, off}) == 3


@pytest.mark.parametrize(
    "other",
    [
        Options(part=Part(rate=1e-14)),
        Options(part=Part(sizes=(64, 3))),
        Options(part=Part(limit=0)),
        Options(groups={"a": Part(rate=2.0)}),
        Options(recorded=False),
    ],
)
def test_every_value_counts(other: Options) -> None:
    assert fingerprint(other) != fingerprint(Options())


@pytest.mark.parametrize(
    "words",
    [
        "--machine.seed 7 --pipeline.model.pruning.seed 7 --pipeline.datamanager.train-cameras-sampling-seed 7",
        "--output-dir elsewhere --experiment-name other --timestamp now --vis tensorboard --viewer.websocket-port 9",
        "--steps-per-save 7 --steps-per-eval-all-images 7 --logging.steps-per-log 7 "
        "--pipeline.model.evaluate-prune False",
        "--pipeline.datamanager.cache-images cpu --max-num-iterations 30000 --pipeline.model.pruning.gamma 0.5",
    ],
)
def test_seeds_paths_logs_and_defaults_in_words_change_nothing(words: str) -> None:
    assert of(*words.split()) == of()


def test_the_capture_changes_nothing() -> None:
    assert of(base=("sundae", "--data", "fox"), parser=COLMAP) == of()


@pytest.mark.parametrize(
    "words",
    [
        "--pipeline.model.head.mode residual",
        "--pipeline.model.head.num-features 5",
        "--pipeline.model.pruning.keep-ratio 0.3",
        "--pipeline.model.pruning.max-primitives 20",
        "--pipeline.model.base-loss-weight 0.3",
        "--pipeline.model.sh-degree 2",
        "--pipeline.model.warm-start field.ply",
        "--pipeline.datamanager.camera-res-scale-factor 0.5",
        "--optimizers.means.optimizer.lr 1e-4",
        "--optimizers.compensation.scheduler.shape exponential",
        "--max-num-iterations 7000",
        "--schedule-length 60000",
    ],
)
def test_options_that_decide_a_result_change_it(words: str) -> None:
    assert of(*words.split()) != of()


@pytest.mark.parametrize("method", ["sundae", "splatfacto"])
def test_a_saved_configuration_keeps_it(tmp_path: Path, method: str) -> None:
    config = parse((method, "--data", str(tmp_path)))
    path = tmp_path / "config.yml"
    path.write_text(yaml.dump(config), encoding="utf-8")
    assert fingerprint(load_config(path)) == fingerprint(config)


def test_methods_differ() -> None:
    found = [of(base=(method, "--data", "x")) for method in ("sundae", "sundae-30", "sundae-fast", "splatfacto")]
    assert len(set(found)) == len(found)


def test_options_that_are_left_out_exist() -> None:
    config = parse(SUNDAE)
    for name in LEFT_OUT:
        owner: Any = config
        for part in name.split("."):
            assert hasattr(owner, part), name
            owner = getattr(owner, part)
