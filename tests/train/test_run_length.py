"""The schedule of a run follows its length: every option that counts steps, unless it was set by hand."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import pytest
from nerfstudio.configs.method_configs import all_methods

from sundae_ns.core.errors import ConfigError
from sundae_ns.train.pruning import PruningSchedule
from sundae_ns.train.schedules import (
    LEAST_IMAGES,
    LEAST_RECOVERY,
    fit_to_length,
    given_options,
    schedule_table,
    step_options,
    take_options,
)

OURS = sorted(name for name in all_methods if name.startswith("sundae"))


def fitted(method: str, length: int, *words: str, **model: Any) -> Any:
    """A configuration of ``length`` steps; ``words`` are options that keep their value, ``model`` are new values."""
    config = deepcopy(all_methods[method])
    config.max_num_iterations = config.schedule_length = length
    for name, value in model.items():
        setattr(config.pipeline.model, name, value)
    fit_to_length(config, deepcopy(all_methods[method]), given_options(words))
    return config


def option(config: Any, name: str) -> Any:
    """The value of an option with a dotted name."""
    for part in name.split("."):
        config = config[part] if isinstance(config, dict) else getattr(config, part)
    return config


@pytest.mark.parametrize("method", OURS)
def test_the_methods_own_length_changes_nothing(method: str) -> None:
    usual = deepcopy(all_methods[method])
    config = fitted(method, usual.max_num_iterations)
    usual.schedule_length = usual.max_num_iterations
    assert config == usual
    fitted(method, usual.max_num_iterations // 10)
    usual.schedule_length = None
    assert all_methods[method] == usual, "methods share nothing with what is scaled"


@pytest.mark.parametrize("method", OURS)
@pytest.mark.parametrize("share", [0.05, 0.4, 0.9, 2])
def test_every_option_follows_and_once_is_enough(method: str, share: float) -> None:
    usual = all_methods[method]
    config = fitted(method, round(share * usual.max_num_iterations))
    kept_apart = ("refine_every", "reset_alpha_every", "warmup_steps")
    for name in step_options(usual):
        if name.endswith(kept_apart):
            continue
        found, value = option(config, name), option(usual, name)
        assert found == (round(share * value) if value else value), name
    for parts in config.optimizers.values():
        rise = getattr(parts["scheduler"], "warmup_steps", 0)
        assert rise <= config.max_num_iterations / 12
    again = deepcopy(config)
    fit_to_length(again, deepcopy(usual), frozenset())
    assert again == config, "as for a run that starts from its saved configuration"


def test_a_twentieth_of_the_steps() -> None:
    """The run of a user that stayed at a quarter of the resolution to its end."""
    config = fitted("sundae", 1500)
    model = config.pipeline.model
    assert (model.resolution_schedule * model.num_downscales, model.pruning.prune_at) == (300, 600)
    assert (model.stop_split_at, model.sh_degree_interval) == (600, 50)
    assert {parts["scheduler"].max_steps for parts in config.optimizers.values() if parts["scheduler"]} == {1500}
    # Densification needs images for its statistics, and opacities need time to recover.
    assert model.refine_every == LEAST_IMAGES
    assert model.reset_alpha_every * model.refine_every > model.stop_split_at
    assert dict(schedule_table(config)) == {
        "images": "1/4 until 150, 1/2 until 300, then full size",
        "densification": "25 to 600, every 50; opacities never reset",
        "SH degree": "+1 every 50 steps",
        "prune": "after 600, to as many as trials choose",
        "head": "after 600, if trials favour it",
        "learning rates": "decay until 1,500",
    }


def test_resets_keep_their_share_of_a_run_that_has_time_for_them() -> None:
    model = fitted("sundae", 15000).pipeline.model
    assert model.reset_alpha_every * model.refine_every == 1500 >= LEAST_RECOVERY
    resets = dict(schedule_table(fitted("sundae", 15000)))["densification"]
    assert resets == "250 to 6,000, every 50; opacities reset every 1,500"


def test_options_set_by_hand_keep_their_value() -> None:
    words = ("--pipeline.model.pruning.prune-at", "12000", "--optimizers.means.scheduler.max_steps=30000")
    config = fitted("sundae", 20000, *words, resolution_schedule=77)
    assert config.pipeline.model.pruning.prune_at == 12000, "also where it equals the default"
    assert config.optimizers["means"]["scheduler"].max_steps == 30000
    assert config.optimizers["compensation"]["scheduler"].max_steps == 20000
    assert config.pipeline.model.resolution_schedule == 77
    assert config.pipeline.model.stop_split_at == 8000


@pytest.mark.parametrize("length", [300, 1500, 7000, 50000])
def test_continuous_pruning_keeps_its_number_of_prunes(length: int) -> None:
    def prunes(config: Any) -> int:
        schedule = PruningSchedule(config.pipeline.model.pruning)
        state = schedule.initialize_state()
        return sum(schedule.due(state, step, 1000) for step in range(config.max_num_iterations))

    assert prunes(fitted("sundae-continuous", length)) == prunes(fitted("sundae-continuous", 30000)) == 7


def test_a_resumed_run_keeps_its_schedule() -> None:
    run, usual = fitted("sundae", 6000), deepcopy(all_methods["sundae"])
    config = deepcopy(usual)
    config.max_num_iterations = 2000
    config.pipeline.model.sh_degree_interval = 9
    run.pipeline.model.head.size, run.pipeline.model.pruning.keep_ratio = "tiny", 0.3
    config.pipeline.model.pruning.keep_ratio = 0.2
    lines = take_options(config, run, usual, given_options(["--pipeline.model.pruning.prune-at", "4000"]))
    assert config.pipeline.model.head.size == "tiny"
    assert lines == [
        "--pipeline.model.sh-degree-interval is 9; the run to resume has 200",
        "--pipeline.model.pruning.prune-at is 12000; the run to resume has 2400",
        "--pipeline.model.pruning.keep-ratio is 0.2; the run to resume has 0.3",
    ]
    assert config.pipeline.model.resolution_schedule == run.pipeline.model.resolution_schedule == 600
    assert config.optimizers["means"]["scheduler"].max_steps == 6000
    assert (config.pipeline.model.pruning.prune_at, config.pipeline.model.sh_degree_interval) == (12000, 9)
    assert all_methods["sundae"] == usual


def test_schedulers_of_a_checkpoint_stay() -> None:
    """Their options lie in its states, which a resumed run loads."""
    run, usual = fitted("sundae", 6000), deepcopy(all_methods["sundae"])
    with pytest.raises(ConfigError, match="the run to resume has 6000, which cannot change; leave the option out"):
        take_options(deepcopy(usual), run, usual, given_options(["--optimizers.means.scheduler.max-steps"]))


@pytest.mark.parametrize("option", ["sh_degree", "head.size", "head.num_features", "head.pixel_unshuffle"])
def test_options_that_a_checkpoint_cannot_follow_are_refused(option: str) -> None:
    run, usual = fitted("sundae", 6000), deepcopy(all_methods["sundae"])
    place, _, name = option.rpartition(".")
    setattr(run.pipeline.model.head if place else run.pipeline.model, name, "tiny" if name == "size" else 1)
    given = given_options([f"--pipeline.model.{option.replace('_', '-')}"])
    with pytest.raises(ConfigError, match=r"the run to resume has (tiny|1), which cannot change; leave the option out"):
        take_options(deepcopy(usual), run, usual, given)
    take_options(deepcopy(usual), run, usual, given_options([]))


def test_tables_of_other_kinds() -> None:
    off = deepcopy(all_methods["sundae"])
    off.pipeline.model.pruning.mode = off.pipeline.model.head.mode = "off"
    off.pipeline.model.num_downscales = 0
    rows = dict(schedule_table(off))
    assert (rows["prune"], rows["head"], rows["images"]) == ("none", "none", "full size")
    late = deepcopy(all_methods["sundae"])
    late.pipeline.model.head.start_at, late.pipeline.model.warm_start = 25000, "field.ply"
    rows = dict(schedule_table(late))
    assert (rows["prune"], rows["densification"]) == ("at once", "none: warm start")
    assert rows["head"] == "after 13,000, if trials favour it"
    assert dict(schedule_table(all_methods["sundae-tiny"]))["head"] == "after 600"
    assert dict(schedule_table(all_methods["sundae-continuous"]))["prune"] == "2,000 to 15,000, every 2,000"
    deciding = deepcopy(all_methods["sundae"])
    assert dict(schedule_table(deciding))["prune"] == "after 12,000, to as many as trials choose"
    deciding.pipeline.model.warm_start = "field.ply"
    assert dict(schedule_table(deciding))["prune"] == "at once"
