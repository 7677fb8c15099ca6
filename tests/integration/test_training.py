"""Train, prune, save, resume, start warm: the tiny run, and runs that resume it."""

import gc
import json
import re
import signal
import sys
import tracemalloc
from unittest.mock import Mock

import kill_and_resume
import numpy as np
import pytest
import torch
from models import Training
from nerfstudio.utils import writer
from nerfstudio.utils.eval_utils import eval_setup
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import Tensor
from trial_runs import same, served_views

from sundae_ns.core.errors import BackendError, DataError, MemoryExhaustedError
from sundae_ns.core.gaussians import SPLAT_NAMES
from sundae_ns.io import checkpoint
from sundae_ns.io.ply import MODEL_FRAME, write_ply
from sundae_ns.plugin.datamanager import SundaeDatamanager
from sundae_ns.plugin.model import SundaeModel
from sundae_ns.train import initialize
from sundae_ns.train.graphed_step import RecordedStep


def load(path):
    """With plain ``torch.load``, as nerfstudio does it."""
    return torch.load(path, map_location="cpu")


def gaussians(state):
    prefix = "_model.gauss_params."
    return {name[len(prefix) :]: value for name, value in state["pipeline"].items() if name.startswith(prefix)}


@pytest.fixture(scope="module")
def report(tiny):
    (only,) = json.loads((tiny.folder / "prune.json").read_text())
    return only


def test_prune_keeps_exactly_the_share(tiny, report):
    assert report["step"] == tiny.prune_at
    assert report["before"] > tiny.points, "densification added nothing"
    assert report["after"] == round(tiny.keep_ratio * report["before"])
    assert report["peak"] >= report["before"]  # densification also drops some
    assert report["seconds"] > 0
    assert report["sigma"] > 0
    counts = {step: len(gaussians(load(tiny.checkpoint(step)))["means"]) for step in (30, 60, 90, 119)}
    assert report["before"] <= counts.pop(30) <= report["peak"]
    assert counts == {60: report["after"], 90: report["after"], 119: report["after"]}
    assert f"kept {report['after']:,} of {report['before']:,} Gaussians" in " ".join(tiny.output.split())


def test_a_finished_training_says_what_it_made(tiny, report):
    """The schedule first; then quality, size and the next command."""
    assert re.search(rf"prune .* after {tiny.prune_at}", tiny.output)
    found = re.search(r"trained: PSNR (\d+\.\d\d) dB, SSIM 0\.\d{4} on 3 test views\n(.*)\nnext: (.*)\n", tiny.output)
    assert 5 < float(found[1]) < 60
    assert re.fullmatch(rf"{report['after']:,} Gaussians, with a head: 0\.\d\d MB before packing", found[2])
    assert found[3] == f"sundae pack {tiny.folder} -o scene.sundae"


def test_a_finished_run_is_opened_and_its_training_has_made_up_for_the_prune(tiny, report):
    assert report["pruned"]["psnr"] < report["warm_up"]["psnr"]
    config, pipeline, _, step = eval_setup(tiny.config, test_mode="test")
    assert step == tiny.steps - 1
    assert isinstance(pipeline.model, SundaeModel)
    assert config.pipeline.model.pruning.prune_at == tiny.prune_at
    after = pipeline.get_average_eval_image_metrics()
    assert after["psnr"] > report["pruned"]["psnr"] + 0.5
    assert after["psnr_base"] > report["pruned"]["psnr"]
    assert after["gaussian_count"] == report["after"]


def test_tensorboard_has_counts_and_both_psnrs(tiny, report):
    events = EventAccumulator(str(tiny.folder), size_guidance={"scalars": 0}).Reload()
    scalars = {tag: {e.step: e.value for e in events.Scalars(tag)} for tag in events.Tags()["scalars"]}
    counts = scalars["Train Metrics Dict/gaussian_count"]
    assert counts[tiny.prune_at] == report["before"]
    assert counts[tiny.prune_at + 5] == report["after"]
    assert scalars["Prune/before"] == {tiny.prune_at: report["before"]}
    assert scalars["Prune/after"] == {tiny.prune_at: report["after"]}
    for tag in ("Train Metrics Dict/psnr", "Train Metrics Dict/psnr_base"):
        assert len(scalars[tag]) == tiny.steps / 5
    evaluated = {tag: values for tag, values in scalars.items() if tag.startswith("Eval Images Metrics")}
    for name in ("psnr", "psnr_base", "ssim", "ssim_base"):
        assert any(tag.endswith("/" + name) and set(values) == {50, 100} for tag, values in evaluated.items()), name


@pytest.mark.parametrize(("step", "pruned_at"), [(30, -1), (119, 45)])
def test_checkpoints_are_plain_and_hold_no_lpips(tiny, step, pruned_at):
    state = load(tiny.checkpoint(step))
    extra = state["pipeline"]["_model._extra_state"]
    assert not [name for name in state["pipeline"] if "lpips" in name]
    assert (extra["format"], extra["step"], extra["running"]["pruning"]["pruned_at"]) == (2, step, pruned_at)
    for name, value in gaussians(state).items():
        (moments,) = state["optimizers"][name]["state"].values()
        # Features have no gradient, and so no moments, before the head is enabled.
        assert (moments == {}) if (name, step) == ("features", 30) else moments["exp_avg"].shape == value.shape


def assert_same(whole, resumed):
    """Field, moments, rates and random numbers of two checkpoints."""
    for part in ("pipeline", "optimizers", "schedulers"):
        same(whole[part], resumed[part], part)
    assert torch.equal(whole["random"]["torch"], resumed["random"]["torch"])


def test_a_resumed_run_ends_like_one_that_never_stopped(tiny, report, resumed):
    trainer = resumed(tiny.checkpoints, 60, tiny.save_every)
    served, model = served_views(trainer), trainer.pipeline.model
    before = {name: value.detach().clone() for name, value in model.gauss_params.items()}
    trainer.train()
    # The views that an uninterrupted run sees at these steps.
    fresh = trainer.config.pipeline.datamanager.setup(device="cpu", test_mode="val")
    assert served == [fresh.view_of_step(step) for step in range(61, 91)]
    assert (model.state.pruning["num_prunes"], model.state.pruning["pruned_at"]) == (1, tiny.prune_at)
    # The record of a prune before the checkpoint comes from the folder of the run that is resumed.
    assert json.loads((trainer.base_dir / "prune.json").read_text()) == [report]
    assert Training.live(trainer)  # that stands for a trainer
    assert all((value.detach() - before[name]).abs().max() > 0 for name, value in model.gauss_params.items())
    assert_same(load(tiny.checkpoint(90)), load(trainer.checkpoint_dir / "step-000000090.ckpt"))


def test_a_signal_saves_and_the_resumed_run_ends_like_one_that_never_stopped(tiny, report, resumed, capsys):
    """Resumed before the prune, and stopped after it."""
    trainer = resumed(tiny.checkpoints, 30, 30)
    serve = trainer.pipeline.datamanager.next_train

    def interrupted(step):
        if step == 50:
            signal.raise_signal(signal.SIGTERM)
        return serve(step)

    trainer.pipeline.datamanager.next_train = interrupted
    handler = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as end:
        trainer.train()
    assert end.value.code == 143
    assert signal.getsignal(signal.SIGTERM) is handler
    assert [path.name for path in trainer.checkpoint_dir.iterdir()] == ["step-000000050.ckpt"]
    last = capsys.readouterr().out.splitlines()[-1].split()
    assert last[:2] == ["ns-train", "sundae-tiny"]
    assert last[last.index("--load-dir") + 1] == str(trainer.checkpoint_dir)
    (prune,) = json.loads((trainer.base_dir / "prune.json").read_text())
    assert all(prune[name] == report[name] for name in ("step", "before", "after", "peak"))

    again = resumed(trainer.checkpoint_dir.parent, None, 10)  # the run's folder
    assert writer.GLOBAL_BUFFER["max_iter"] == 61, "progress counts the steps before"
    again.train()
    assert_same(load(tiny.checkpoint(60)), load(again.checkpoint_dir / "step-000000060.ckpt"))


def test_a_signal_before_the_first_step_saves_nothing(trainer_of, monkeypatch):
    def stop(*_, **__):
        # To this thread; os.kill may reach another one, and then the handler runs a little later.
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(SundaeDatamanager, "create_train_dataset", stop)
    # A shell starts background jobs with this signal ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(SystemExit) as end:
            trainer_of()
    finally:
        signal.signal(signal.SIGINT, before)
    assert end.value.code == 130


def test_killed_while_it_saves_it_goes_on_as_if_never_killed(monkeypatch, capsys):
    """The short version of ``benchmarks/kill_and_resume.py``, which says where the kills fall."""
    monkeypatch.setattr(sys, "argv", ["kill_and_resume.py", "--kinds", "training", "--kills", "1", "--seed", "1"])
    with pytest.raises(SystemExit, match="0"):
        kill_and_resume.main()
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    names = ("at save: half written", "killed", "one prune", "the same result", "nothing left lying")
    assert [found[name] for name in names] == [1] * 5
    assert found["same seed, same result"]


def test_memory_does_not_grow_past_the_prune(tiny, resumed):
    """Step by step: what is imported or cached once adds to one of five windows of ten steps, a leak to each."""
    seen = []
    trainer = resumed(tiny.checkpoints, 60, 70, model={"average_share": 1.0})  # from the first step on
    iterate = trainer.train_iteration

    def watched(step):
        if step >= 80 and step % 10 == 0:
            gc.collect()
            tensors = sum(isinstance(thing, Tensor) for thing in gc.get_objects())
            seen.append((tensors, tracemalloc.get_traced_memory()[0]))
        return iterate(step)

    trainer.train_iteration = watched
    tracemalloc.start()
    try:
        trainer.train()
    finally:
        tracemalloc.stop()
    tensors, size = np.diff(seen, axis=0).T
    assert len(size) == 5
    assert np.median(tensors) <= 0
    # Bytes of Python and numpy; loggers keep a few hundred a step, an image of the scene has 27,648.
    assert np.median(size) / 10 < 5_000


def test_full_memory_in_the_backward_pass(tiny, resumed, monkeypatch):
    trainer, text = resumed(tiny.checkpoints, 60, 5), "CUDA out of memory. Tried to allocate 300.00 MiB."
    monkeypatch.setattr(Tensor, "backward", Mock(side_effect=torch.cuda.OutOfMemoryError(text)))
    count = trainer.pipeline.model.num_points
    with pytest.raises(MemoryExhaustedError, match=rf"cannot allocate 300\.00 MiB more with {count:,} Gaussians"):
        trainer.train()


def test_a_diverged_field_takes_the_place_of_no_checkpoint(tiny, resumed):
    trainer = resumed(tiny.checkpoints, 60, 5)
    trainer.model.gauss_params["opacities"].data.fill_(torch.nan)
    with pytest.raises(DataError, match="the training has diverged, go back to an earlier checkpoint"):
        trainer.save_checkpoint(61)
    assert not list(trainer.checkpoint_dir.glob("*.ckpt"))


@pytest.mark.parametrize(("source", "step"), [("nerfstudio_models", 119), ("a.ply", 119), ("step-000029999.ckpt", 30)])
def test_warm_start(tiny, trainer_of, tmp_path, source, step):
    params = {name: value for name, value in gaussians(load(tiny.checkpoint(step))).items() if name in SPLAT_NAMES}
    path = tmp_path / source
    if path.suffix == ".ply":
        write_ply(path, params, comments=[MODEL_FRAME])
    elif path.suffix == ".ckpt":
        pipeline = {f"_model.gauss_params.{name}": value for name, value in params.items()}
        schedulers = {"means": {"_last_lr": [np.float64(1e-4)]}}  # a number of numpy, as stock saves
        torch.save({"step": 29999, "pipeline": pipeline, "schedulers": schedulers}, path)
    trainer = trainer_of(model={"warm_start": path if path.suffix else tiny.checkpoints}, max_num_iterations=3)
    model = trainer.pipeline.model
    for name in SPLAT_NAMES:
        assert torch.equal(model.gauss_params[name].cpu(), params[name]), name
    trainer.train()
    (found,) = json.loads((trainer.base_dir / "prune.json").read_text())
    kept = round(tiny.keep_ratio * found["before"])  # the last refinement may drop some before
    assert 0.95 * len(params["means"]) < found["before"] <= len(params["means"])
    assert found["after"] == model.num_points == kept
    assert model.state.pruning["num_prunes"] == 1
    assert model.state.head_enabled
    assert Training.live(trainer)
    assert load(trainer.checkpoint_dir / "step-000000002.ckpt")["step"] == 2


def test_few_views_start_from_more_points_and_resume_without_looking_for_them_again(
    tiny, trainer_of, resumed, capsys, monkeypatch
):
    monkeypatch.setitem(initialize.SIDES, "cpu", 48)
    monkeypatch.setitem(initialize.FILLED, "cpu", 800)
    options = {"model": {"dense_start_views": 12}, "steps_per_save": 5, "save_only_latest_checkpoint": False}
    whole = trainer_of(max_num_iterations=10, **options)
    whole.train()
    assert whole.model.num_points == tiny.points + 500
    assert "500 points by a plane sweep beside 300 sparse ones" in " ".join(capsys.readouterr().out.split())
    monkeypatch.setattr(initialize, "Sweep", None)
    again = resumed(whole.checkpoint_dir, 5, 4, timestamp="resumed", **options)
    again.train()
    for name, value in whole.model.gauss_params.items():
        assert torch.equal(again.model.gauss_params[name], value), name


class Failing(RecordedStep):
    """Fails at its tenth step, as a GPU does whose memory does not suffice."""

    steps = 0

    def _step(self, *arguments):
        self.steps += 1
        if self.steps == 10:
            raise BackendError("no memory for a recording\nand a long story")
        return super()._step(*arguments)


@pytest.mark.parametrize("steps", [RecordedStep, Failing])
def test_a_run_by_recorded_steps_is_the_same_also_if_they_fail(trainer_of, steps, capsys):
    """Until the field grows: rounding decides about Gaussians at thresholds of densification."""
    shares, quartiles, options = torch.tensor([0.25, 0.5, 0.75]), [], {"steps_per_save": 20, "max_num_iterations": 30}
    for recorded in (False, True):
        torch.manual_seed(5)
        trainer = trainer_of(model={"background_color": "black"}, **options)  # a failed step draws a random one twice
        if recorded:
            trainer._recorded = steps(trainer.model.losses, record=False)
        trainer.train()
        fields = (trainer.model.gauss_params[name].detach() for name in ("means", "scales", "opacities", "features_dc"))
        quartiles.append(torch.cat([field.quantile(shares) for field in fields]))
    torch.testing.assert_close(*quartiles, rtol=0, atol=0.001)
    assert (trainer._recorded is None) == (steps is Failing)
    told = "without recordings, slower: no memory for a recording" in " ".join(capsys.readouterr().out.split())
    assert told == (steps is Failing)
    loaded = checkpoint.read(checkpoint.newest_whole(trainer.checkpoint_dir)[0])
    means = loaded["pipeline"]["_model.gauss_params.means"]
    assert means.untyped_storage().nbytes() == means.numel() * 4  # and not the memory beyond the Gaussians
    assert loaded["optimizers"].keys() == trainer.optimizers.optimizers.keys()
    events = [str(event["name"]) for event in writer.EVENT_STORAGE]
    assert not [name for name in events if name.startswith("learning_rate")]  # all are written


def test_what_cannot_be_recorded_runs_as_before_under_every_default_dtype(trainer_of):
    """On a CPU there is nothing to record; on a GPU, options decide."""
    results = []
    for dtype in (torch.float32, torch.float64):
        torch.manual_seed(0)
        torch.set_default_dtype(dtype)
        trainer = trainer_of(max_num_iterations=2)
        trainer.train()
        assert torch.get_default_dtype() == dtype
        torch.set_default_dtype(torch.float32)
        assert trainer._recorded is None
        assert not trainer._recordable()
        results.append(dict(trainer.model.gauss_params))
    assert all(torch.equal(value, results[1][name]) for name, value in results[0].items())


SPREAD = 1.0
"""dB between two runs of one seed: CUDA sums in no fixed order; five such runs had a standard deviation of 0.2 dB."""
ROOM = 256 << 20  # Bytes that training may take beyond what it has when it starts


@pytest.fixture
def little_memory():
    """Limits what torch may take of the GPU; all of it is free again afterwards."""

    def limit(bytes_):
        torch.cuda.set_per_process_memory_fraction(bytes_ / torch.cuda.get_device_properties(0).total_memory)

    yield limit
    torch.cuda.set_per_process_memory_fraction(1.0)
    torch.cuda.empty_cache()


@pytest.mark.gpu
def test_full_memory_is_named_and_training_goes_on_from_the_last_save(tiny, trainer_of, resumed, little_memory):
    """Gaussians all but double every few steps, until the GPU has no more memory for them."""
    growing = {"pruning.mode": "off", "warmup_length": 4, "refine_every": 5, "stop_split_at": 400}
    growing |= {"densify_grad_thresh": 0.0, "cull_alpha_thresh": 0.005, "reset_alpha_every": 1000}
    trainer = trainer_of(max_num_iterations=400, steps_per_save=10, model={**growing, "stop_screen_size_at": 0})
    torch.cuda.empty_cache()
    little_memory(torch.cuda.memory_reserved() + ROOM)
    with pytest.raises(MemoryExhaustedError) as raised:
        trainer.train()
    words = r"the GPU's memory is full: cannot allocate [\d.]+ [KMG]iB more with ([\d,]+) Gaussians; try .* 0\.5 .*"
    found = re.fullmatch(rf"{words}max-gaussians (\d+) \(.*\); --load-dir resumes from .*", str(raised.value))
    assert found, str(raised.value)
    count = int(found[1].replace(",", ""))
    assert count > 10 * tiny.points
    assert int(found[2]) == count // 2

    newest, passed_over = checkpoint.newest_whole(trainer.checkpoint_dir)
    assert passed_over == []
    step = checkpoint.read(newest)["step"]
    assert step >= 10
    little_memory(torch.cuda.get_device_properties(0).total_memory)
    again = resumed(newest.parent, None, 2, model={"pruning.mode": "off", "stop_split_at": 0})
    again.train()
    assert again.step == step + 2


@pytest.mark.gpu
@pytest.mark.parametrize("start", [30, 45, 60])
def test_a_run_resumed_on_a_gpu_keeps_as_many_and_is_as_good(tiny, report, resumed, start):
    """Stopped before the warm-up's end, right at the prune, and after it; compared with the run that never stopped."""
    folder, qualities = tiny.checkpoints, []
    if start == tiny.prune_at:
        stopped = resumed(folder, 30, tiny.prune_at - 30)
        stopped.train()
        folder = stopped.checkpoint_dir
    again = resumed(folder, start, tiny.steps - 1 - start)
    again.train()
    for trainer in (again, resumed(tiny.checkpoints, tiny.steps - 1, tiny.steps)):
        assert trainer.pipeline.model.num_points == report["after"]
        trainer.pipeline.eval()
        qualities.append(trainer.pipeline.get_average_eval_image_metrics())
    for name in ("psnr", "psnr_base"):
        assert qualities[0][name] == pytest.approx(qualities[1][name], abs=SPREAD)
