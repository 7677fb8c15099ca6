"""Train, prune, save, resume: the tiny run, and runs that resume it."""

import gc
import json
import re
import signal
import tracemalloc

import pytest
import torch
import yaml
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.utils import writer
from nerfstudio.utils.eval_utils import eval_setup
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import Tensor
from trial_runs import served_views

from sundae_ns.core.errors import CheckpointError, MemoryExhaustedError
from sundae_ns.core.gaussians import SPLAT_NAMES
from sundae_ns.io.ply import MODEL_FRAME, write_ply
from sundae_ns.method_configs import sundae_tiny
from sundae_ns.plugin.datamanager import SundaeDatamanager
from sundae_ns.plugin.model import SundaeModel


def load(path):
    """With plain ``torch.load``, as nerfstudio does it."""
    return torch.load(path, map_location="cpu")


def gaussians(state):
    prefix = "_model.gauss_params."
    return {name[len(prefix) :]: value for name, value in state["pipeline"].items() if name.startswith(prefix)}


def report(tiny):
    (only,) = json.loads((tiny.folder / "prune.json").read_text())
    return only


@pytest.fixture(scope="module")
def scalars(tiny):
    events = EventAccumulator(str(tiny.folder), size_guidance={"scalars": 0}).Reload()
    return {tag: {e.step: e.value for e in events.Scalars(tag)} for tag in events.Tags()["scalars"]}


def test_prune_keeps_exactly_the_share(tiny):
    found = report(tiny)
    assert found["step"] == tiny.prune_at
    assert found["before"] > tiny.points, "densification added nothing"
    assert found["after"] == round(tiny.keep_ratio * found["before"])
    assert found["peak"] >= found["before"]  # densification also drops some
    assert found["seconds"] > 0
    assert found["sigma"] > 0
    counts = {step: len(gaussians(load(tiny.checkpoint(step)))["means"]) for step in (30, 60, 90, 119)}
    assert found["before"] <= counts.pop(30) <= found["peak"]
    assert counts == {60: found["after"], 90: found["after"], 119: found["after"]}
    assert f"kept {found['after']:,} of {found['before']:,} Gaussians" in " ".join(tiny.output.split())


def test_the_schedule_follows_the_number_of_steps(tiny):
    """A tenth of the method's own steps; what the command sets stays."""
    config = yaml.load(tiny.config.read_text(), Loader=yaml.Loader)
    model, rates = config.pipeline.model, config.optimizers["compensation"]["scheduler"]
    assert config.schedule_length == tiny.steps == sundae_tiny.config.max_num_iterations // 10
    assert model.stop_split_at == sundae_tiny.config.pipeline.model.stop_split_at // 10
    assert (rates.max_steps, rates.warmup_steps) == (tiny.steps, tiny.steps // 12)
    assert (model.pruning.prune_at, model.refine_every) == (tiny.prune_at, 15)
    assert f"{tiny.steps} steps" in tiny.output
    assert re.search(rf"prune .* after {tiny.prune_at}", tiny.output)


def test_a_finished_training_says_what_it_made(tiny):
    """Quality, size and the next command."""
    n = report(tiny)["after"]
    found = re.search(r"trained: PSNR (\d+\.\d\d) dB, SSIM 0\.\d{4} on 3 test views\n(.*)\nnext: (.*)\n", tiny.output)
    assert found is not None, tiny.output
    assert 5 < float(found[1]) < 60
    assert re.fullmatch(rf"{n:,} Gaussians, with a head: 0\.\d\d MB before packing", found[2])
    assert found[3] == f"sundae pack {tiny.folder} -o scene.sundae"


def test_prune_costs_quality_and_training_brings_it_back(tiny):
    found = report(tiny)
    assert found["pruned"]["psnr"] < found["warm_up"]["psnr"]
    _, pipeline, _, _ = eval_setup(tiny.config, test_mode="test")
    after = pipeline.get_average_eval_image_metrics()
    assert after["psnr"] > found["pruned"]["psnr"] + 0.5
    assert after["psnr_base"] > found["pruned"]["psnr"]
    assert after["gaussian_count"] == found["after"]


def test_tensorboard_has_counts_and_both_psnrs(scalars, tiny):
    found = report(tiny)
    counts = scalars["Train Metrics Dict/gaussian_count"]
    assert counts[tiny.prune_at] == found["before"]
    assert counts[tiny.prune_at + 5] == found["after"]
    assert scalars["Prune/before"] == {tiny.prune_at: found["before"]}
    assert scalars["Prune/after"] == {tiny.prune_at: found["after"]}
    for tag in ("Train Metrics Dict/psnr", "Train Metrics Dict/psnr_base"):
        assert len(scalars[tag]) == tiny.steps / 5
    evaluated = {tag: values for tag, values in scalars.items() if tag.startswith("Eval Images Metrics")}
    for name in ("psnr", "psnr_base", "ssim", "ssim_base"):
        assert any(tag.endswith("/" + name) and set(values) == {50, 100} for tag, values in evaluated.items()), name


def test_checkpoints_are_plain_and_hold_no_lpips(tiny):
    for step in (30, 119):
        state = load(tiny.checkpoint(step))
        assert not [name for name in state["pipeline"] if "lpips" in name]
        assert state["pipeline"]["_model._extra_state"]["step"] == step
        for name, value in gaussians(state).items():
            (moments,) = state["optimizers"][name]["state"].values()
            # Features have no gradient, and so no moments, before the head is enabled.
            assert (moments == {}) if (name, step) == ("features", 30) else moments["exp_avg"].shape == value.shape
    for step, pruned_at in ((30, -1), (119, tiny.prune_at)):
        extra = load(tiny.checkpoint(step))["pipeline"]["_model._extra_state"]
        assert (extra["format"], extra["running"]["pruning"]["pruned_at"]) == (2, pruned_at)


def assert_live(trainer):
    """Model, optimizers and nerfstudio's own list hold the same tensors, with moments of their shape."""
    optimizers = trainer.optimizers
    for name, value in trainer.pipeline.model.gauss_params.items():
        (held,) = optimizers.optimizers[name].param_groups[0]["params"]
        assert held is value
        assert optimizers.parameters[name] == [value]
        assert optimizers.optimizers[name].state[value]["exp_avg"].shape == value.shape


@pytest.mark.parametrize("start", [30, 60], ids=["before the prune", "after the prune"])
def test_a_resumed_run_ends_like_one_that_never_stopped(tiny, trainer_of, start):
    def change(config):
        config.load_dir, config.load_step, config.max_num_iterations = tiny.checkpoints, start, tiny.save_every

    trainer = trainer_of(change)
    served = served_views(trainer)
    before = {name: value.detach().clone() for name, value in trainer.pipeline.model.gauss_params.items()}
    trainer.train()

    end = start + tiny.save_every
    # The views that an uninterrupted run sees at these steps.
    fresh = trainer.config.pipeline.datamanager.setup(device="cpu", test_mode="val")
    assert served == [fresh.view_of_step(step) for step in range(start + 1, end + 1)]

    model = trainer.pipeline.model
    assert model.num_points == report(tiny)["after"]
    assert model.state.pruning["num_prunes"] == 1
    assert model.state.pruning["pruned_at"] == tiny.prune_at
    # The record of a prune before the checkpoint comes from the folder of the run that is resumed.
    records = [json.loads((folder / "prune.json").read_text()) for folder in (tiny.folder, trainer.base_dir)]
    facts = [{name: record[name] for name in ("step", "before", "after", "peak")} for (record,) in records]
    assert facts[0] == facts[1]
    assert_live(trainer)
    if start > tiny.prune_at:
        assert all((value.detach() - before[name]).abs().max() > 0 for name, value in model.gauss_params.items())

    assert_same(load(tiny.checkpoint(end)), load(trainer.checkpoint_dir / f"step-{end:09d}.ckpt"))


def test_a_signal_saves_and_the_resumed_run_ends_like_one_that_never_stopped(tiny, trainer_of, capsys):
    def to_step_60(config):
        config.load_dir, config.load_step, config.max_num_iterations = tiny.checkpoints, 30, 30

    trainer = trainer_of(to_step_60)
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

    def onwards(config):
        config.load_dir, config.max_num_iterations = trainer.checkpoint_dir.parent, 10  # the run's folder

    again = trainer_of(onwards)
    assert writer.GLOBAL_BUFFER["max_iter"] == 61, "progress counts the steps before"
    again.train()
    assert_same(load(tiny.checkpoint(60)), load(again.checkpoint_dir / "step-000000060.ckpt"))


def test_a_signal_before_the_first_step_saves_nothing(tiny, trainer_of, monkeypatch):
    def stop(*_, **__):
        # To this thread; os.kill may reach another one, and then the handler runs a little later.
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(SundaeDatamanager, "create_train_dataset", stop)
    # A shell starts background jobs with this signal ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(SystemExit) as end:
            trainer_of(lambda config: None)
    finally:
        signal.signal(signal.SIGINT, before)
    assert end.value.code == 130


def assert_same(whole, resumed):
    """Tensors, moments, rates and random state of two checkpoints: bit for bit on a CPU; CUDA sums in any order."""
    tolerance = {"atol": 0.02, "rtol": 0.02} if torch.cuda.is_available() else {"atol": 0.0, "rtol": 0.0}
    for name, value in whole["pipeline"].items():
        if isinstance(value, Tensor):
            torch.testing.assert_close(resumed["pipeline"][name], value, **tolerance, msg=lambda m, n=name: f"{n}: {m}")
    for name, state in whole["optimizers"].items():
        for key, moments in state["state"].items():
            for kind, value in moments.items():
                torch.testing.assert_close(resumed["optimizers"][name]["state"][key][kind], value, **tolerance)
    for name, state in whole["schedulers"].items():
        assert resumed["schedulers"][name]["_last_lr"] == pytest.approx(state["_last_lr"])
        assert resumed["schedulers"][name]["last_epoch"] == state["last_epoch"]
    assert torch.equal(whole["random"]["torch"], resumed["random"]["torch"])


def test_memory_does_not_grow_past_the_prune(tiny, trainer_of):
    steps, settled = 60, 20

    def change(config):
        config.load_dir, config.load_step, config.max_num_iterations = tiny.checkpoints, 60, steps
        config.pipeline.model.average_share = 1.0  # from the first step on

    trainer = trainer_of(change)
    seen = []
    iterate = trainer.train_iteration

    def watched(step):
        if step - 60 in (settled, steps):
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
    (tensors, before), (tensors_later, after) = seen
    assert tensors_later <= tensors
    # Bytes of Python and numpy; loggers keep a few hundred a step, one image of the scene has 27,648.
    assert (after - before) / (steps - settled) < 2000


def test_full_memory_in_the_backward_pass(tiny, trainer_of, monkeypatch):
    def change(config):
        config.load_dir, config.load_step, config.max_num_iterations = tiny.checkpoints, 60, 5

    def full(*_, **__):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 300.00 MiB.")

    trainer = trainer_of(change)
    monkeypatch.setattr(Tensor, "backward", full)
    count = trainer.pipeline.model.num_points
    with pytest.raises(MemoryExhaustedError, match=rf"cannot allocate 300\.00 MiB more with {count:,} Gaussians"):
        trainer.train()


def warm(trainer_of, path):
    """The field as it was read, and the trainer after three steps."""

    def change(config):
        config.pipeline.model.warm_start, config.max_num_iterations = path, 3

    trainer = trainer_of(change)
    start = {name: value.detach().clone() for name, value in trainer.pipeline.model.gauss_params.items()}
    trainer.train()
    return start, trainer


def check_warm(tiny, params, start, trainer):
    for name in SPLAT_NAMES:
        assert torch.equal(start[name].cpu(), params[name]), name
    (found,) = json.loads((trainer.base_dir / "prune.json").read_text())
    kept = round(tiny.keep_ratio * found["before"])  # the last refinement may drop some before
    assert 0.95 * len(params["means"]) < found["before"] <= len(params["means"])
    assert found["after"] == kept
    assert trainer.pipeline.model.num_points == kept
    assert trainer.pipeline.model.state.pruning["num_prunes"] == 1
    assert trainer.pipeline.model.state.head_enabled
    assert_live(trainer)
    assert load(trainer.checkpoint_dir / "step-000000002.ckpt")["step"] == 2


@pytest.mark.parametrize("source", ["checkpoint", "ply", "exported"])
def test_warm_start(tiny, trainer_of, tmp_path, source, request):
    params = gaussians(load(tiny.checkpoint(119)))
    params = {name: value for name, value in params.items() if name in SPLAT_NAMES}
    path = tiny.checkpoints
    if source == "exported":
        path = request.getfixturevalue("exported")
    elif source == "ply":
        path = tmp_path / "a.ply"
        write_ply(path, params, comments=[MODEL_FRAME])
    check_warm(tiny, params, *warm(trainer_of, path))


def test_warm_start_from_a_stock_checkpoint(tiny, trainer_of, tmp_path):
    params = {name: value for name, value in gaussians(load(tiny.checkpoint(30))).items() if name in SPLAT_NAMES}
    optimizer = torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))], lr=1.6e-4)
    config = ExponentialDecaySchedulerConfig(lr_final=1.6e-6, max_steps=100)
    scheduler = config.setup().get_scheduler(optimizer, lr_init=1.6e-4)
    optimizer.step()
    scheduler.step()
    path = tmp_path / "step-000029999.ckpt"
    pipeline = {f"_model.gauss_params.{name}": value for name, value in params.items()}
    torch.save({"step": 29999, "pipeline": pipeline, "schedulers": {"means": scheduler.state_dict()}}, path)
    with pytest.raises(Exception, match="[Ww]eights.only"):
        load(path)
    check_warm(tiny, params, *warm(trainer_of, path))


def test_a_splatfacto_checkpoint_is_refused(tiny, trainer_of, tmp_path):
    state = load(tiny.checkpoint(30))
    stock = [name for name in state["pipeline"] if name.startswith("_model.gauss_params.") and "features" not in name]
    state["pipeline"] = {name: state["pipeline"][name] for name in stock}
    torch.save(state, tmp_path / "step-000000030.ckpt")

    def change(config):
        config.load_checkpoint = tmp_path / "step-000000030.ckpt"

    with pytest.raises(ValueError, match="warm-start"):
        trainer_of(change)


def test_a_checkpoint_of_format_1_is_refused_in_one_line(tiny, trainer_of, tmp_path):
    state = load(tiny.checkpoint(30))
    state["pipeline"]["_model._extra_state"] = {"method": "sundae", "format": 1, "step": 30, "num_features": 5}
    torch.save(state, tmp_path / "step-000000030.ckpt")

    def resume(config):
        config.load_dir = tmp_path

    def start_warm(config):
        config.pipeline.model.warm_start = tmp_path

    for change in (resume, start_warm):
        with pytest.raises(
            CheckpointError, match="format 1, this version reads 2; use the version that wrote"
        ) as raised:
            trainer_of(change)
        assert "\n" not in str(raised.value)


def test_saved_config_is_read_back_the_same(tiny):
    config, pipeline, _, step = eval_setup(tiny.config, test_mode="inference")
    assert step == tiny.steps - 1
    assert isinstance(pipeline.model, SundaeModel)
    assert config.pipeline.model.pruning.prune_at == tiny.prune_at
