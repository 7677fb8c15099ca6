"""What only a GPU can show: memory that really runs out, and resuming where sums come out in any order."""

import json
import re

import pytest
import torch

from sundae_ns.core.errors import MemoryExhaustedError
from sundae_ns.io import checkpoint

pytestmark = pytest.mark.gpu
SPREAD = 1.0
"""dB between two runs of one seed: CUDA sums in no fixed order; five such runs had a standard deviation of 0.2 dB."""
ROOM = 256 << 20
"""Bytes that training may take beyond what it has when it starts."""


@pytest.fixture
def little_memory():
    """Limits what torch may take of the GPU; all of it is free again afterwards."""

    def limit(bytes_):
        torch.cuda.set_per_process_memory_fraction(bytes_ / torch.cuda.get_device_properties(0).total_memory)

    yield limit
    torch.cuda.set_per_process_memory_fraction(1.0)
    torch.cuda.empty_cache()


def quality(trainer):
    trainer.pipeline.eval()
    found = trainer.pipeline.get_average_eval_image_metrics()
    return found


def test_memory_that_runs_out_is_named_and_training_goes_on_from_the_last_checkpoint(tiny, trainer_of, little_memory):
    """The field all but doubles every few steps, until the GPU has no more for it."""

    def growing(config):
        config.max_num_iterations, config.steps_per_save = 400, 10
        model = config.pipeline.model
        model.pruning.mode = "off"
        model.warmup_length, model.refine_every, model.stop_split_at = 4, 5, 400
        model.densify_grad_thresh, model.cull_alpha_thresh = 0.0, 0.005
        model.reset_alpha_every, model.stop_screen_size_at = 1000, 0

    trainer = trainer_of(growing)
    torch.cuda.empty_cache()
    little_memory(torch.cuda.memory_reserved() + ROOM)
    with pytest.raises(MemoryExhaustedError) as raised:
        trainer.train()
    line = str(raised.value)
    found = re.fullmatch(
        r"the GPU's memory is full: cannot allocate [\d.]+ [KMG]iB more with ([\d,]+) Gaussians; try "
        r"--pipeline\.datamanager\.cache-images cpu \(.*\), "
        r"--pipeline\.datamanager\.camera-res-scale-factor 0\.5 \(.*\), "
        r"or --pipeline\.model\.pruning\.mode continuous .*--pipeline\.model\.pruning\.max-gaussians (\d+) \(.*\); "
        r"--load-dir resumes from the last checkpoint",
        line,
    )
    assert found, line
    count = int(found[1].replace(",", ""))
    assert count > 10 * tiny.points
    assert int(found[2]) == count // 2

    saved, passed_over = checkpoint.newest_whole(trainer.checkpoint_dir)
    assert passed_over == []
    step = checkpoint.read(saved)["step"]
    assert step >= 10
    little_memory(torch.cuda.get_device_properties(0).total_memory)

    def onwards(config):
        config.load_dir, config.max_num_iterations = saved.parent, 2
        config.pipeline.model.pruning.mode, config.pipeline.model.stop_split_at = "off", 0

    again = trainer_of(onwards)
    again.train()
    assert again.step == step + 2


@pytest.mark.parametrize("start", [30, 45, 60])
def test_a_resumed_run_keeps_as_many_and_is_as_good(tiny, trainer_of, start):
    """Stopped before the warm-up's end, right at the prune, and after it; compared with the run that never stopped."""
    folder = tiny.checkpoints
    if start == tiny.prune_at:

        def to_the_prune(config):
            config.load_dir, config.load_step, config.max_num_iterations = folder, 30, tiny.prune_at - 30

        stopped = trainer_of(to_the_prune)
        stopped.train()
        folder = stopped.checkpoint_dir

    def onwards(config):
        config.load_dir, config.load_step, config.max_num_iterations = folder, start, tiny.steps - 1 - start

    resumed = trainer_of(onwards)
    resumed.train()

    def finished(config):
        config.load_dir, config.load_step = tiny.checkpoints, tiny.steps - 1

    whole = trainer_of(finished)
    (report,) = json.loads((tiny.folder / "prune.json").read_text())
    assert resumed.pipeline.model.num_points == whole.pipeline.model.num_points == report["after"]
    a, b = quality(resumed), quality(whole)
    assert a["psnr"] == pytest.approx(b["psnr"], abs=SPREAD)
    assert a["psnr_base"] == pytest.approx(b["psnr_base"], abs=SPREAD)
