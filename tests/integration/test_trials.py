"""Whole runs that decide by trials how many Gaussians they keep, with which head, and for how many steps they train."""

import json
import math
from functools import cache, partial

import pytest
import torch
from nerfstudio.engine.callbacks import TrainingCallbackAttributes
from nerfstudio.utils import writer
from nerfstudio.utils.eval_utils import eval_setup
from trial_runs import LENGTH, PRUNE_AT, STEPS, records_of, same, served_views, tidy, tiny_run, tiny_scene, trials_of

from sundae_ns.core.gaussians import bytes_of
from sundae_ns.head.head import bytes_of_module
from sundae_ns.plugin import optimizer_configs
from sundae_ns.plugin.finished_runs import load_run
from sundae_ns.plugin.model import NerfstudioRun
from sundae_ns.pruning.rule import kept_count
from sundae_ns.scene.packing import contents_of
from sundae_ns.train import averaging, choice, trials
from sundae_ns.train.choice import HeldOutQuality
from sundae_ns.train.curve import read_count_curve
from sundae_ns.train.pruning import PruningConfig

VIEWS = 40  # Of a run that decides its count; one that decides its head alone has 16
WINDOW = 2  # Steps of a trial of a count, and between two measurements of a length: a fiftieth of so short a run


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    return cache(partial(tiny_scene, tmp_path_factory.mktemp("scenes")))


@pytest.fixture
def make(scenes, tmp_path):
    """Make a run that decides its head and its length."""
    yield lambda views=16, **options: tiny_run(scenes(views), tmp_path, **options)
    tidy()


@pytest.fixture
def make_counting(make):
    """Make a run that decides its count; options are those of pruning."""

    def made(head="off", views=VIEWS, **pruning):
        config = PruningConfig(**{"keep_ratio": None, "prune_at": PRUNE_AT, **pruning})
        return make(views, model={"head.mode": head, "dense_start_views": 0, "pruning": config})

    return made


def judged(monkeypatch, quality):
    """Fix the qualities of held-out views of a run; means of weights are taken in trials of few steps."""
    monkeypatch.setattr(trials, "AVERAGED_EVERY", 1)
    monkeypatch.setattr(trials, "measure_held_out", lambda run, **_: quality(run))


def after_each_step(callback, note):
    """Call a function with the run after each act of a callback."""
    act = callback.after_step

    def after_step(run):
        act(run)
        note(run)

    callback.after_step = after_step


def centers_of(model):
    return model.gauss_params["means"].detach().clone()


@pytest.fixture
def judge_counts(monkeypatch):
    """Fix what the counts lose against all Gaussians, PSNR in dB by share, and what a head gains at a tenth."""
    real = trials.measure_held_out

    def fix(losses, head=0.0):
        def quality(run):
            progress = trials_of(run.model).progress
            if progress.stage not in ("count", "tenth"):
                return real(run)
            tenth = progress.of("tenth")
            if progress.stage == "tenth":
                assert run.state.head_enabled == (len(tenth) == 1)
                assert run.source.total == kept_count(0.1, progress.full)
                decibels, similarity = 30 + head * len(tenth), 0.9
            else:
                loss = losses[trials.SHARES[len(progress.of("count"))]]
                decibels, similarity = 30 - loss, 0.9 - 0.03 * loss
            return [HeldOutQuality(100, decibels, similarity, decibels) for _ in run.held_out_views()]

        judged(monkeypatch, quality)

    return fix


def head_steps(model):
    """Steps in which the head was trained, without those that were taken back."""
    return model.state.schedule_step - model.state.head_starts_at - trials_of(model).taken_back


LEVEL = {1.0: 0.0, 0.4: 0.0, 0.2: 0.05, 0.1: 1.0, 0.05: 2.0, 0.025: 3.0}
"""Losses that level off: between a tenth and a fifth of the Gaussians are enough."""


def test_trials_choose_the_count_and_leave_nothing_else_behind(make_counting, judge_counts):
    judge_counts(LEVEL, 0.2)
    trainer = make_counting(head="auto")
    served, model, fields = served_views(trainer), trainer.pipeline.model, {}
    deciding, pruning = trials_of(model), next(one for one in model.train_callbacks if one.name == "pruning")
    begin, prune = deciding._begin_counts, pruning.after_step

    def began(run):
        fields["before"] = centers_of(model)
        begin(run)

    def pruned(run):
        if run.state.schedule_step >= PRUNE_AT and "count" in deciding.progress.chosen and "after" not in fields:
            fields["after"] = centers_of(model)
        prune(run)

    deciding._begin_counts, pruning.after_step = began, pruned
    trainer.train()
    record = records_of(trainer)["count"]
    full, chosen, held = record["full"], record["chosen"], set(record["held_out_views"])
    assert full / 10 < chosen <= full / 5
    assert model.num_points == chosen
    # A count that loses a decibel is clearly too few, so smaller ones are not tried.
    assert [round(one["count"] / full, 2) for one in record["curve"]] == [1.0, 0.4, 0.2, 0.1]
    assert record["step"] == PRUNE_AT + 4 * WINDOW + 2 * LENGTH
    assert [len(one["measured"]) for one in record["curve"]] == [len(held)] * 4
    assert all(one["bytes"] > 0 for one in record["curve"])
    assert torch.equal(fields["before"], fields["after"])
    # Held out from the first step.
    assert len(held) == VIEWS // 8
    assert not held & set(served[: PRUNE_AT + 4 * WINDOW])
    assert held & set(served[record["step"] + 1 :])
    points = read_count_curve(trainer.base_dir).points
    assert [point.count for point in points] == [one["count"] for one in record["curve"]]
    (prune,) = json.loads((trainer.base_dir / "prune.json").read_text())
    assert (prune["before"], prune["after"], prune["step"]) == (full, chosen, record["step"])
    # The head gains too little for its bytes, which are several times those of these Gaussians.
    assert not record["head"]["pays"]
    assert records_of(trainer)["head"]["decision"] == "plain"
    assert model.state.head is None


def test_a_head_that_gains_at_a_tenth_is_kept_with_more(make_counting, judge_counts):
    judge_counts(LEVEL, 4.0)
    trainer = make_counting(head="auto")
    model, settled = trainer.pipeline.model, {}
    fresh = {name: value.clone() for name, value in model.state.head.state_dict().items()}
    deciding = trials_of(model)
    settle = deciding._finish_with

    def finish_with(*words):
        settled.update({name: value.clone() for name, value in model.state.head.state_dict().items()})
        settle(*words)

    deciding._finish_with = finish_with
    trainer.train()
    record, verdict = records_of(trainer)["count"], records_of(trainer)["head"]
    assert record["head"]["pays"]
    assert record["head"]["head"]["psnr"] - record["head"]["plain"]["psnr"] == pytest.approx(4.0)
    assert (verdict["decision"], verdict["step"]) == ("head", record["step"])
    # What the head learnt on a tenth does not fit the chosen Gaussians.
    same(fresh, settled)
    assert any(not torch.equal(fresh[name], value) for name, value in model.state.head.state_dict().items())
    assert head_steps(model) == STEPS - 1 - record["step"]
    assert not model.state.provisional


def test_where_a_tenth_is_kept_the_head_has_its_usual_trials(make_counting, judge_counts):
    judge_counts(dict.fromkeys(trials.SHARES, 0.0), 0.2)
    trainer = make_counting(head="auto")
    trainer.train()
    record, verdict = records_of(trainer)["count"], records_of(trainer)["head"]
    assert record["chosen"] <= record["full"] / 10
    assert "head" not in record
    assert verdict["step"] > record["step"]
    assert not set(record["held_out_views"]) & set(verdict["held_out_views"])


def test_a_head_in_any_case_rests_during_the_trials_and_counts_its_own_steps(make_counting, judge_counts):
    """Within a budget, which works on the same curve."""
    judge_counts(LEVEL)
    trainer = make_counting(head="residual", max_gaussians=9)
    model, enabled = trainer.pipeline.model, []
    after_each_step(model.train_callbacks[-1], lambda run: enabled.append(run.state.head_enabled))
    trainer.train()
    record = records_of(trainer)["count"]
    assert model.num_points == record["chosen"] == 9
    assert not any(enabled[: record["step"]])
    assert all(enabled[record["step"] + 1 :])
    assert head_steps(model) == STEPS - 1 - record["step"]
    assert not model.state.provisional


@pytest.mark.parametrize(
    ("options", "kept", "said"),
    [
        ({"prune_at": 75}, 20, "10% of the Gaussians: the steps after the prune are too few"),
        ({"views": 16}, 20, "10% of the Gaussians: 16 training views are too few"),
    ],
)
def test_where_trials_cannot_decide_a_share_is_kept_and_one_line_says_so(make_counting, options, kept, said, capsys):
    trainer = make_counting(**options)
    trainer.train()
    assert trainer.pipeline.model.num_points == kept
    assert " ".join(capsys.readouterr().out.split()).count(f"pruning keeps {said}") == 1
    assert "count" not in records_of(trainer)


@pytest.fixture
def judge_heads(monkeypatch):
    """Fix what the candidates gain on every held-out view: PSNR in dB, SSIM. Bytes of tiny Gaussians do not count."""
    monkeypatch.setattr(choice, "GAIN_PER_DOUBLING", 0.0)
    monkeypatch.setattr(trials, "MEAN_SHARE", 0.6)
    real = trials.measure_held_out

    def fix(head=(0.0, 0.0), features=(0.0, 0.0)):
        def quality(run):
            width, gain = run.state.gaussians["features"].shape[1], (0.0, 0.0)
            if run.state.head_enabled:
                assert run.state.head.config.num_features == width
                gain = features if width == 29 else head
            # With a trace of what was measured, so that other weights have other figures.
            return [HeldOutQuality(view.pixels, 20 + gain[0] + 1e-4 * view.psnr, 0.5 + gain[1]) for view in real(run)]

        judged(monkeypatch, quality)

    return fix


@pytest.mark.parametrize(
    ("chosen", "width", "head", "features", "tried"),
    [
        ("plain", 0, (0.5, -0.001), (0.0, 0.0), 2),
        ("head", 5, (0.5, 0.01), (0.5, 0.01), 3),
        ("features", 29, (0.3, 0.01), (0.5, 0.02), 3),
    ],
)
def test_the_trials_start_alike_and_the_chosen_field_continues(make, judge_heads, chosen, width, head, features, tried):
    judge_heads(head, features)
    trainer = make()
    model, served = trainer.pipeline.model, served_views(trainer)
    trial, seen, rates, head_rates = trials_of(model), {}, {}, {}
    act = trial.after_prune

    def after_prune(run):
        act(run)
        step = run.state.step
        head_rates[step] = [group["lr"] for group in run.state.optimizers["compensation"].param_groups]
        seen[step], rates[step] = centers_of(model), run.state.schedulers["means"].lr_lambdas[0](step)

    trial.after_prune = after_prune
    trainer.train()
    starts = [PRUNE_AT + i * LENGTH for i in range(tried)]
    for step in starts[1:]:
        # All trials start from the Gaussians and the rate right after the prune.
        assert torch.equal(seen[starts[0]], seen[step])
        assert rates[starts[0]] == pytest.approx(rates[step])
        # Each head's rate rises from the first step of its trial on, and is as high as it may be well before the end.
        for lowest, highest in zip(head_rates[step], head_rates[step + LENGTH // 2], strict=True):
            assert lowest == pytest.approx(highest * 2 / (round(trials.RISE_SHARE * LENGTH) + 1), rel=0.05)
    decided, place = PRUNE_AT + tried * LENGTH, choice.HEADS.index(chosen)
    ends = [seen[step + LENGTH - 1] for step in starts]
    assert not torch.equal(ends[place], seen[PRUNE_AT])
    # The Gaussians at the end of the chosen trial are one step away from the last that were seen of it.
    distances = [(seen[decided] - end).abs().max() for end in ends]
    assert min(distances) == distances[place]
    record = records_of(trainer)["head"]
    assert (record["decision"], record["step"], len(record["arms"])) == (chosen, decided, tried)
    decibels = 20 + {"plain": 0.0, "head": head[0], "features": features[0]}[chosen]
    assert record["arms"][chosen]["psnr"] == pytest.approx(decibels, abs=0.01)
    assert record["arms"][chosen]["bytes"] == bytes_of(model.gauss_params) + bytes_of_module(model.head)
    held = set(record["held_out_views"])
    assert len(held) == 2
    assert not held & set(served[31 : decided + 1])
    assert held & set(served[:30])
    assert held & set(served[decided + 1 :])
    # A head that was chosen has trained for one trial.
    assert trial.taken_back == (tried - 1) * LENGTH
    # No head leaves nothing behind.
    saved = torch.load(next(trainer.checkpoint_dir.glob("*.ckpt")), map_location="cpu", weights_only=True)
    opened = eval_setup(trainer.base_dir / "config.yml", test_mode="test")[1].model
    camera = trainer.pipeline.datamanager.train_dataset.cameras[0:1]
    with torch.no_grad():
        shown, again = (each.eval().get_outputs_for_camera(camera) for each in (model, opened))
    assert torch.equal(shown["rgb"], again["rgb"])
    scene = contents_of(load_run(trainer.base_dir))
    assert model.gauss_params["features"].shape[1] == width
    assert scene.gaussians.get("features", torch.zeros(1, 0)).shape[1] == width
    none = [
        *(model.head is None, opened.head is None, not scene.head, torch.equal(shown["rgb"], shown["base_rgb"])),
        not [name for name in saved["pipeline"] if "head" in name],
    ]
    assert none == [chosen == "plain"] * 5


def test_with_few_views_two_are_held_out_in_turn(make, judge_heads):
    """The second one stays held out for the length: the Gaussians that go on have not seen it in their trial."""
    judge_heads(head=(0.5, 0.01))
    trainer = make(8)
    served = served_views(trainer)
    trainer.train()
    record, length = records_of(trainer)["head"], LENGTH // 2
    first, second = record["held_out_views"]
    served_by_trial = [served[PRUNE_AT + 1 + i * length : PRUNE_AT + 1 + (i + 1) * length] for i in range(6)]
    assert (record["decision"], record["steps_per_trial"]) == ("head", length)
    assert not any(first in trial for trial in served_by_trial[::2])
    assert not any(second in trial for trial in served_by_trial[1::2])
    assert trainer.pipeline.model.head.config.num_features == 5
    watch = records_of(trainer)["length"]
    assert watch["held_out_views"] == [second]
    watched = served[PRUNE_AT + 6 * length + 1 : watch["step"]]
    assert first in watched
    assert second not in watched


@pytest.mark.parametrize("views", [5, VIEWS])
def test_with_too_few_views_or_bytes_the_head_stays_off(make, capsys, views):
    limited = PruningConfig(keep_ratio=None, max_bytes=9999)
    trainer = make(views, max_num_iterations=1, model={} if views == 5 else {"pruning": limited})
    trainer.train()
    reason = "5 training views are too few to tell whether a head helps"
    reason = reason if views == 5 else "in a pack it would take a quarter of pruning.max-bytes"
    assert trainer.pipeline.model.head is None
    assert records_of(trainer)["head"] == {"decision": "plain", "reason": reason, "step": 0}
    assert f"the head is removed: {reason}" in " ".join(capsys.readouterr().out.split())


def test_masks_that_leave_no_pixel_leave_no_head(make, judge_heads, monkeypatch):
    judge_heads(head=(0.5, 0.01))
    judged(monkeypatch, lambda _: [])
    trainer = make()
    trainer.train()
    record = records_of(trainer)["head"]
    assert record["decision"] == "plain"
    assert record["reason"] == "masks leave no pixel of the held-out training views"
    assert trainer.pipeline.model.head is None
    assert trainer.pipeline.datamanager.held_out_indices == []


def test_several_gpus_train_the_head_without_trials(make, judge_heads):
    """The head of the trial that one GPU was in."""
    judge_heads(head=(0.5, 0.05))
    stop = PRUNE_AT + 2 * LENGTH + 2
    whole = make(name="whole", steps_per_save=stop)
    whole.train()
    resumed = make(name="resumed", load_dir=whole.checkpoint_dir, load_step=stop, max_num_iterations=3)
    model = resumed.pipeline.model
    deciding = trials_of(model)
    assert "start" in deciding.kept
    resumed.ranks.count = 2
    attributes = TrainingCallbackAttributes(resumed.optimizers, resumed.grad_scaler, resumed.pipeline, resumed)
    deciding.before_training(NerfstudioRun(model, attributes))
    resumed.ranks.count = 1
    resumed.train()
    assert records_of(resumed)["head"]["reason"] == "trials need a single GPU"
    assert model.state.head_enabled
    assert model.gauss_params["features"].shape[1] == 29
    assert resumed.pipeline.datamanager.held_out_indices == []
    assert deciding.kept == {}


DECIDED = PRUNE_AT + 2 * LENGTH  # Step of the decision about the length, after trials of no head and of a head


@pytest.fixture
def curve(monkeypatch):
    """Fix the PSNR of the held-out views at a step; trials end without a head."""
    monkeypatch.setattr(choice, "best_head", lambda tried, folds: "plain")

    def fix(decibels):
        def quality(run):
            assert len(list(run.held_out_views())) == 2
            return [HeldOutQuality(576, decibels(run.state.step), 0.5)]

        judged(monkeypatch, quality)

    return fix


def trained(trainer):
    """Train; the training views that are served, and the centres and their rate after the callbacks of each step."""
    model, centers, rates, served = trainer.pipeline.model, {}, {}, served_views(trainer)

    def note(run):
        centers[run.state.step] = centers_of(model)
        rates[run.state.step] = run.state.schedulers["means"].lr_lambdas[0](run.state.step)

    after_each_step(model.train_callbacks[-1], note)
    trainer.train()
    return served, centers, rates


@pytest.mark.parametrize("best", [2, 10])
def test_the_field_goes_back_trains_as_long_as_was_best_and_pauses(make, curve, monkeypatch, best):
    """In windows; with ten the pause is in the last steps, whose mean leaves out the weights before it."""
    monkeypatch.setattr(averaging, "AVERAGED_EVERY", 1)
    curve(lambda step: 20 - 0.08 * abs(step - DECIDED - best * WINDOW) / WINDOW)
    trainer = make()
    served, centers, rates = trained(trainer)
    # 0.08 dB below the best are 0.4% of the loss and noise, 0.16 are not.
    back, rest = DECIDED + (best + 2) * WINDOW, DECIDED + (2 * best + 2) * WINDOW
    record = records_of(trainer)["length"]
    held = set(record["held_out_views"])
    assert record["steps_per_measurement"] == WINDOW
    decibels = [20 - 0.08 * abs(window + 1 - best) for window in range(best + 2)]
    assert [one["psnr"] for one in record["measured"]] == pytest.approx(decibels)
    assert record["measured"][best - 1]["loss"] == pytest.approx(0.8 * 0.1 + 0.2 * 0.5)
    assert record["steps_on_all_views"] == best * WINDOW
    assert torch.equal(centers[back], centers[DECIDED])
    assert not torch.equal(centers[back - 1], centers[DECIDED])
    # The rate has gone back too; it decays by 0.0006 in a window of this length.
    assert rates[back] == pytest.approx(rates[DECIDED], rel=1e-5)
    assert rates[back - 1] < (1 - 5e-4) * rates[DECIDED]
    assert len(held) == 2
    assert not held & set(served[DECIDED + 1 : back + 1])
    assert len(served) == rest + 1
    # The mean of the last window stays: the own weights of its last step have moved on.
    assert all(torch.equal(centers[rest], centers[step]) for step in range(rest, STEPS))
    assert not torch.equal(centers[rest], centers[rest - 1])
    assert list(trainer.checkpoint_dir.glob("*.ckpt")) == [trainer.checkpoint_dir / f"step-{STEPS - 1:09d}.ckpt"]


def test_a_field_that_loses_nothing_trains_to_the_end_on_all_views(make, curve):
    curve(lambda _: math.nan)
    trainer = make()
    served, centers, _ = trained(trainer)
    record, end = records_of(trainer)["length"], DECIDED + (STEPS - DECIDED) // 2
    assert len(record["measured"]) == (end - DECIDED) // WINDOW
    assert record["steps_on_all_views"] is None
    assert not set(record["held_out_views"]) & set(served[DECIDED + 1 : end + 1])
    assert set(record["held_out_views"]) & set(served[end + 1 :])
    assert len(served) == STEPS
    assert not torch.equal(centers[STEPS - 1], centers[STEPS - 2])


def test_a_warm_start_is_not_watched(make, curve):
    """Its Gaussians know the views that would be held out."""
    curve(lambda step: 20 - step)
    trainer = make()
    trainer.pipeline.model.state.offset = PRUNE_AT
    served, *_ = trained(trainer)
    assert records_of(trainer).keys() == {"head"}
    assert len(served) == STEPS


def test_a_paused_run_is_resumed_with_figures_and_trains_again_after_its_schedule(make, curve, monkeypatch, capsys):
    curve(lambda step: 20 - step)
    stop, losses, put_scalar = STEPS - 25, [], writer.put_scalar
    whole = make(name="whole", steps_per_save=stop)
    whole.train()
    assert len(trained(make(name="longer", load_dir=whole.checkpoint_dir, max_num_iterations=5))[0]) == 5

    def noted(name, scalar, step):
        losses.extend([float(scalar)] if name == "Train Loss" else [])
        put_scalar(name, scalar, step)

    monkeypatch.setattr(writer, "put_scalar", noted)
    monkeypatch.setattr(optimizer_configs, "LINE_EVERY", 0.0)
    resumed = make(name="resumed", load_dir=whole.checkpoint_dir, load_step=stop, max_num_iterations=STEPS - stop - 1)
    capsys.readouterr()
    served, centers, _ = trained(resumed)
    assert len(served) == 1, "one image is measured, and none is trained on"
    assert all(torch.equal(centers[stop + 1], center) for center in centers.values())
    assert len(losses) == 2
    assert all(0 < loss < 1 for loss in losses)
    assert "PSNR" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("views", "keep_ratio", "stages", "stops"),
    [
        # Before, in trials of counts and of a head on a tenth, and after the decision.
        (40, None, {"count", "tenth"}, (11, 45, 57, 68)),
        # Before the prune and right after it, in trials of heads, in those of the length, on all views, and paused.
        (16, 0.1, {"head", "length", "repeat", "paused"}, (37, 40, 43, 52, 61, 68, 85)),
    ],
)
def test_a_run_resumed_at_any_step_is_the_run(make, monkeypatch, views, keep_ratio, stages, stops):
    """By figures of which a fifth of the Gaussians is enough, heads pay, and later training harms."""
    monkeypatch.setattr(choice, "GAIN_PER_DOUBLING", 0.0)
    losses, found_stages = (0.0, 0.0, 0.05, 0.45, 0.65, 0.8), set()

    def quality(run):
        progress = trials_of(run.model).progress
        n = len(progress.of(progress.stage))
        gain = {"count": -losses[n % 6], "tenth": 0.3 * n, "head": 0.5 * n, "length": -0.1 * abs(n - 3)}
        # With a trace of the weights, so that other weights have other figures.
        figure = 25 + gain[progress.stage] + 1e-6 * float(run.state.gaussians["means"].detach().abs().mean())
        return [HeldOutQuality(100, figure, 0.5 + figure / 100, figure) for _ in run.held_out_views()]

    judged(monkeypatch, quality)

    def run(name, start, end, **options):
        pruning = PruningConfig(keep_ratio=keep_ratio, prune_at=PRUNE_AT)
        length = {"max_num_iterations": end - start, "schedule_length": STEPS}
        trainer = make(views, name=name, model={"dense_start_views": 0, "pruning": pruning}, **length, **options)
        found_stages.add(trials_of(trainer.model).progress.stage)
        trainer.train()
        return trainer

    def saved(trainer, step):
        path = trainer.checkpoint_dir / f"step-{step:09d}.ckpt"
        return torch.load(path, map_location="cpu", weights_only=True)

    last = STEPS - 1
    whole = run("whole", 0, STEPS, steps_per_save=1)
    # From each stop to the next one; and while weights are averaged, whose mean ends a part too.
    for start, end in [*zip(stops, (*stops[1:], last), strict=True), (95, last)]:
        part = run(f"from {start}", start, end, load_dir=whole.checkpoint_dir, load_step=start)
        expected, found = saved(whole, end), saved(part, end)
        for part_of_state in ("pipeline", "optimizers", "schedulers"):
            same(expected[part_of_state], found[part_of_state])
    assert records_of(part) == records_of(whole)
    assert found_stages >= stages
