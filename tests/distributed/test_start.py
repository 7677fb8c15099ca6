"""What several ranks check, change and say around a run; no rank is started."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import forked
import pytest
import torch

from sundae_ns import distributed
from sundae_ns.distributed.batches import shorten
from sundae_ns.distributed.start import without_viewer
from sundae_ns.errors import ConfigError, rank_ended
from sundae_ns.method_configs import sundae_tiny

STEPS, PRUNE_AT = 40, 32


@pytest.fixture
def config(tmp_path: Path) -> Any:
    """Of a short run of two ranks on a CPU."""
    config: Any = copy.deepcopy(sundae_tiny.config)
    config.machine.device_type, config.machine.num_devices = "cpu", 2
    config.output_dir, config.experiment_name, config.timestamp = tmp_path, "run", "now"
    config.max_num_iterations = STEPS
    config.pipeline.model.pruning.prune_at, config.pipeline.model.refine_every = PRUNE_AT, 6
    return config


def test_an_error_of_sundae_in_a_rank_keeps_its_message() -> None:
    class Raised(Exception):
        error_index = 1

    text = "\n\n-- Process 1 terminated with the following error:\n"
    text += "Traceback ...\nsundae_ns.errors.DataError: cause; mend\n"
    assert str(rank_ended(Raised(text))) == "rank 1: cause; mend"
    assert "rank 1 ended (ValueError: odd)" in str(rank_ended(Raised("Traceback ...\nValueError: odd")))


def test_nerfstudios_command_ends_with_one_line(tmp_path: Path) -> None:
    code = """
import sys
sys.argv = ["/usr/bin/ns-train"]
from torch.multiprocessing.spawn import ProcessExitedException
from sundae_ns.errors import show_in_one_line
show_in_one_line()
raise ProcessExitedException("process 1 terminated with signal SIGKILL", 1, 7, -9, "SIGKILL")
"""
    (tmp_path / "program").write_text(code)
    found, printed = forked.run(tmp_path / "program")
    assert found == 1
    (line,) = printed.splitlines()
    assert line.startswith("sundae: rank 1 ended (killed by SIGKILL)")


@pytest.mark.parametrize(("option", "value"), [("camera_optimizer.mode", "SO3xR3")])
def test_options_that_several_ranks_cannot_use_are_refused(config: Any, option: str, value: str) -> None:
    *owners, name = option.split(".")
    owner: Any = config.pipeline.model
    for part in owners:
        owner = getattr(owner, part)
    setattr(owner, name, value)
    with pytest.raises(ConfigError, match="several GPUs"):
        distributed.check_options(config)


def test_more_ranks_than_gpus_are_refused_before_anything_is_written(
    config: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ConfigError, match="needs GPUs.*device-type is cpu"):
        config.save_config()
    config.machine.device_type = "cuda"
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    with pytest.raises(ConfigError, match="is 2 and there are 1 GPUs; give --machine.num-devices 1"):
        config.save_config()
    assert not config.get_base_dir().exists()
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    config.save_config()
    assert (config.get_base_dir() / "config.yml").exists()


def test_shortened_runs_see_as_many_images(config: Any) -> None:
    config.schedule_length = 2 * STEPS
    short = shorten(config, 2)
    assert (short.max_num_iterations, config.max_num_iterations) == (STEPS // 2, STEPS)
    assert (short.schedule_length, config.schedule_length) == (STEPS, 2 * STEPS)
    assert short.pipeline.model.pruning.prune_at == PRUNE_AT // 2
    assert short.pipeline.model.refine_every == 3
    full = config.optimizers["means"]["scheduler"].max_steps
    assert short.optimizers["means"]["scheduler"].max_steps == full // 2


def test_loggers_stay_when_the_viewer_goes() -> None:
    found = [without_viewer(vis) for vis in ("viewer", "viewer+wandb", "comet")]
    assert found == ["tensorboard", "wandb", "comet"]
