"""Pruning in training: options, steps around a prune, reports, warnings, and floaters."""

import re
from pathlib import Path
from types import SimpleNamespace

import prunes
import pytest
import torch
from nerfstudio.engine.callbacks import TrainingCallbackLocation
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam

from sundae_ns.core.errors import ConfigError, DataError
from sundae_ns.pruning.decision import Pruner
from sundae_ns.train.initialize import Start
from sundae_ns.train.pruning import (
    COUNT,
    PACKED_BYTES,
    UNPRUNED,
    PruningConfig,
    ScheduledPruning,
    prune_when_due,
    summary,
    usual_share,
)
from sundae_ns.train.schedules import Decay


def gaussians(n=100, seed=0):
    params = {name: Parameter(value) for name, value in prunes.gaussians(n, seed=seed).items()}
    return params, {name: Adam([value], lr=0.01) for name, value in params.items()}


def run(config, made, steps, state=None):
    """The reports of the prunes in some steps of training, and the running state."""
    state, reports = dict(UNPRUNED) if state is None else state, []

    def contribute(count):
        return made[0]["opacities"].sigmoid().squeeze(1)

    for step in steps:
        prunes.train(*made)
        reports.append(prune_when_due(config, Pruner(*made), state, step, contribute))
    return [report for report in reports if report is not None], state


@pytest.mark.parametrize(("cap", "kept"), [(None, [70, 49, 34]), (70, [70, 49, 34]), (60, [60, 42, 29])])
def test_continuous_keeps_a_share_on_schedule(cap, kept):
    options = {"start": 2, "every": 3, "stop": 9, "keep_ratio": 0.7, "num_neighbors": 4}
    reports, state = run(PruningConfig(mode="continuous", max_gaussians=cap, **options), gaussians(), range(13))
    assert [report["step"] for report in reports] == [2, 5, 8]
    assert [report["after"] for report in reports] == kept
    assert {report["peak"] for report in reports} == {100}
    assert state["num_prunes"] == 3
    assert reports[0]["sigma"] != reports[1]["sigma"]


def test_continuous_caps_a_growing_field_and_counts_the_peak():
    options = {"start": 0, "every": 2, "stop": 100, "max_gaussians": 110, "keep_ratio": 1.0}
    config, state = PruningConfig(mode="continuous", num_neighbors=4, **options), dict(UNPRUNED)
    counts, peaks, (params, optimizers) = [], [], gaussians(100)
    for step in range(6):
        grown, _ = gaussians(15, seed=step)
        params = {name: Parameter(torch.cat([params[name].detach(), grown[name].detach()])) for name in params}
        optimizers = {name: Adam([value]) for name, value in params.items()}
        run(config, (params, optimizers), range(step, step + 1), state)
        counts.append(len(params["means"]))
        peaks.append(state["peak"])
    assert counts == [110, 125, 110, 125, 110, 125]
    assert peaks == [115, 125, 140, 140, 140, 140]


@pytest.mark.parametrize("last", [60, 90])
def test_continuous_ends_at_exactly_the_target(last):
    options = {"start": 0, "every": 2, "stop": 3, "target_gaussians": 80, "max_gaussians": 120}
    config = PruningConfig(mode="continuous", num_neighbors=4, **options)
    reports, state = run(config, gaussians(), range(2))
    assert [report["after"] for report in reports] == [80]
    params, optimizers = gaussians(last)  # what densification has made of it meanwhile
    densification = {"grad2d": torch.zeros(last), "count": torch.zeros(last), "scene_scale": 1.0}
    for step in (3, 4):
        prune_when_due(config, Pruner(params, optimizers, [densification]), state, step, lambda _: torch.ones(last))
        assert {len(value) for value in params.values()} == {80}
        assert all(optimizers[name].param_groups[0]["params"] == [params[name]] for name in optimizers)
        assert {len(value) for value in densification.values() if isinstance(value, Tensor)} <= {80}
    assert state["peak"] == 100


def test_continuous_draws_anew_each_time():
    config, kept = PruningConfig(mode="continuous", start=0, every=1, keep_ratio=0.5, redistribution="none"), []
    for step in (3, 3, 4):
        made = gaussians()
        prune_when_due(config, Pruner(*made), dict(UNPRUNED), step, lambda _: torch.linspace(0.1, 1, 100))
        kept.append(made[0]["means"].detach())
    assert torch.equal(kept[0], kept[1])
    assert not torch.equal(kept[0], kept[2])


def test_broken_gaussians_are_dropped_before_the_contribution_and_counted():
    params, optimizers = gaussians()
    params["means"].data[5], params["means"].data[9] = torch.nan, torch.inf
    params["opacities"].data[[5, 11]] = torch.inf  # an opacity of 1 has a meaning
    asked = []

    def contribute(count):
        asked.append((count, len(params["means"])))
        return torch.ones(len(params["means"]))

    config = PruningConfig(prune_at=0, keep_ratio=0.5)
    report = prune_when_due(config, Pruner(params, optimizers), dict(UNPRUNED), 0, contribute)
    assert asked == [(49, 98)]
    assert (report["before"], report["dropped_nonfinite"], report["after"]) == (100, 2, 49)
    assert all(value.isfinite().all() for value in params.values())


@pytest.mark.parametrize(
    ("n", "seen", "opacity", "foreign", "words"),
    [
        (10, 9, 0.0, False, r"contribution has shape \[9\] for 10 Gaussians"),
        (10, 10, 0.0, True, "optimizer of 'means'"),
        (0, 0, 0.0, False, "no Gaussian is left: all became transparent"),
        (10, 10, torch.nan, False, "none of 10 Gaussians is finite: the training has diverged"),
    ],
)
def test_a_failed_prune_names_the_cause_and_changes_nothing(n, seen, opacity, foreign, words):
    (params, optimizers), state = gaussians(n), dict(UNPRUNED)
    params["opacities"].data[:] = opacity
    if foreign:
        params = {**params, "means": Parameter(torch.zeros(n, 3))}
    with pytest.raises(DataError, match=words):
        prune_when_due(PruningConfig(prune_at=0), Pruner(params, optimizers), state, 0, lambda _: torch.ones(seen))
    assert len(params["means"]) == n
    assert state["pruned_at"] == -1


def test_a_report_says_in_one_line_what_happened_and_leaves_out_what_did_not():
    (report,), _ = run(PruningConfig(prune_at=0), gaussians(), range(1))
    assert all(type(value) in (int, float) for value in report.values())
    assert summary(report).startswith("step 0: kept 10 of 100 Gaussians in ")
    (unscored,), _ = run(PruningConfig(prune_at=0, redistribution="none"), gaussians(), range(1))
    assert "sigma" not in summary(unscored)
    plain = {"step": 15000, "before": 1_234_567, "after": 123_456, "dropped_nonfinite": 0, "peak": 2_000_000}
    plain |= {"seconds": 1.26, "sigma": None}
    assert summary(plain) == "step 15000: kept 123,456 of 1,234,567 Gaussians in 1.3 s; peak 2,000,000"
    odd = {**plain, "dropped_nonfinite": 1200, "tau": 0.0090, "sigma": 0.0316227, "isolated": 1500}
    assert summary(odd).endswith("2,000,000; sigma 0.0316, tau 0.009, 1,500 isolated")


def test_continuous_prunes_a_step_once_and_above_the_cap_also_afterwards_and_off_never():
    assert run(PruningConfig(mode="off", prune_at=0, start=0), gaussians(), range(4)) == ([], {**UNPRUNED, "peak": 100})
    config = PruningConfig(mode="continuous", start=0, stop=10, every=20, max_gaussians=100)
    assert [config.due(UNPRUNED, step, 101) for step in (9, 10, 30)] == [False, True, True]
    assert not config.due(UNPRUNED, 30, 100)
    config = PruningConfig(mode="continuous", start=0, stop=10, every=1)
    assert [config.due({**UNPRUNED, "pruned_at": 5}, step, 100) for step in (5, 6)] == [False, True]


UNTRIED = "is set, and trials do not decide .*: set keep_ratio to None"
CONTINUOUS = {"mode": "continuous"}
IMPOSSIBLE = [
    *(({"keep_ratio": share}, "keep_ratio") for share in (0.0, 1.01, float("nan"))),
    *(({"gamma": share}, "gamma") for share in (-0.1, 1.1)),
    *(({name: "best"}, name) for name in ("mode", "selection", "signal")),
    ({"score": "opacity"}, "score is 'opacity': use one of detail-c"),
    *(({name: 0}, f"{name} is 0: use at least 1") for name in ("num_neighbors", "every", "max_gaussians", "max_bytes")),
    ({"target_gaussians": 0}, "target_gaussians is 0: use at least 1"),
    ({"prune_at": -1}, "prune_at"),
    ({**CONTINUOUS, "start": 5, "stop": 4}, "start"),
    ({"keep_ratio": None, "max_drop": 0.0}, "max_drop is 0.0"),
    ({"max_bytes": 5}, f"max_bytes {UNTRIED}"),
    ({"keep_ratio": None, "target_gaussians": 5, "max_drop": 0.1}, f"max_drop {UNTRIED}"),
    ({**CONTINUOUS, "max_drop": 0.1}, f"max_drop {UNTRIED}"),
    ({**CONTINUOUS, "keep_ratio": None}, "keep_ratio is None and mode is continuous"),
    ({"mode": "off", "max_gaussians": 4}, "mode is off and prunes nothing"),
    ({**CONTINUOUS, "max_gaussians": 4, "target_gaussians": 5}, "is more than max_gaussians"),
]


@pytest.mark.parametrize(("options", "words"), IMPOSSIBLE)
def test_impossible_options_are_refused_in_one_line(options, words):
    with pytest.raises(ConfigError, match=f"^.*{words}.*$"):
        PruningConfig(**options).validate()


@pytest.mark.parametrize(
    ("options", "of_60", "of_10"),
    [
        ({"keep_ratio": 0.2}, 12, 2),
        ({"keep_ratio": 0.01}, 1, 1),
        ({"max_gaussians": 5}, 5, 1),
        ({"keep_ratio": None, "target_gaussians": 30}, 30, 10),
        ({**CONTINUOUS, "target_gaussians": 30}, 30, 10),
        ({**CONTINUOUS, "max_gaussians": 30, "keep_ratio": 0.6}, 30, 6),
    ],
)
def test_the_options_decide_how_many_stay(options, of_60, of_10):
    config = PruningConfig(**options)
    assert (config.target(60, {}), config.target(10, {})) == (of_60, of_10)


def test_trials_decide_how_many_stay_and_the_prune_waits_for_them():
    config = PruningConfig(keep_ratio=None, prune_at=3, max_gaussians=40)
    assert not config.due(UNPRUNED, 3, 60)
    for chosen, kept in ((7, 7), (50, 40), (0, 6)):  # 0 for the usual share
        decided = {**UNPRUNED, COUNT: chosen}
        assert config.due(decided, 3, 60)
        assert config.target(60, decided) == kept
    assert (config.target(5, {**UNPRUNED, COUNT: 7}), config.target(60, UNPRUNED)) == (5, 6)
    # Without trials the bytes of a Gaussian are those of other captures.
    limited = PruningConfig(keep_ratio=None, max_bytes=4 * PACKED_BYTES)
    assert [limited.target(60, {**UNPRUNED, COUNT: chosen}) for chosen in (7, 0)] == [7, 4]
    shares = [usual_share(views) for views in (1, 7, 16, 17, 24, 31, 32, 99)]
    assert shares == pytest.approx([0.1, 0.1, 0.1, 0.17 / 1.6, 0.15, 0.31 / 1.6, 0.1, 0.1])


def test_a_prune_in_one_shot_adds_none_that_lack_and_a_cap_may_be_the_target():
    made = gaussians(9)
    PruningConfig(**CONTINUOUS, max_gaussians=9, target_gaussians=9).validate()
    run(PruningConfig(target_gaussians=12, prune_at=1, stop=0, num_neighbors=4), made, range(3))
    assert len(made[0]["means"]) == 9
    assert not ScheduledPruning(PruningConfig(**CONTINUOUS), evaluate=True).evaluate


SPAN = {"mode": "continuous", "start": 4, "stop": 21, "every": 5}


@pytest.mark.parametrize(
    ("options", "last", "settled"),
    [
        ({"prune_at": 7}, 7, 7),
        ({"mode": "off", "prune_at": 7}, 7, 7),
        (SPAN, 19, 21),
        ({**SPAN, "stop": 24}, 24, 24),
        ({**SPAN, "target_gaussians": 9}, 21, 21),
        ({**SPAN, "max_gaussians": 9}, 21, 21),
    ],
)
def test_steps_of_the_prunes(options, last, settled):
    config = PruningConfig(**options)
    assert (config.last_due, config.settled_at) == (last, settled)


N = 60  # Gaussians of a model that is built without a count


def trainer_of(folder=None):
    """What a run of three steps asks of its trainer."""
    config = SimpleNamespace(schedule_length=None, load_dir=None, load_checkpoint=None)
    return SimpleNamespace(last_step=2, base_dir=folder, config=config)


@pytest.mark.parametrize("score", ["detail-contribution", "response"])
def test_prune_keeps_the_count_and_training_goes_on(build, training_of, score, capsys):
    training = training_of(build(pruning={"score": score}, background_color="black"))
    losses = [training.step(step) for step in range(3)]
    assert training.model.num_points == N
    training.model.state.densification["peak"] = 77  # while it grew
    logged = {}
    training.run.log_scalars = lambda name, values: logged.update({name: values})
    training.step(3)
    assert training.model.num_points == N // 2
    assert training.live()
    assert "kept 30 of 60" in " ".join(capsys.readouterr().out.split())
    before = training.model.means.detach().clone()
    losses += [training.step(step) for step in range(4, 20)]
    assert training.model.num_points == N // 2
    assert training.live()
    assert (training.model.means.detach() - before).abs().max() > 0
    assert losses[-1]["main_loss"] < losses[3]["main_loss"] - 0.01
    assert "base_loss" in losses[-1]
    assert "base_loss" not in losses[0]
    training.run_callbacks(TrainingCallbackLocation.AFTER_TRAIN, 19)
    assert (logged["Prune"]["peak"], logged["Peak"]["gaussians"]) == (77, 77)
    assert re.search(r"peak: 77 Gaussians, \d[\d,]{2,6} MB of cpu memory", " ".join(capsys.readouterr().out.split()))


def test_a_count_beyond_the_field_is_named(build, training_of, capsys):
    training = training_of(build(pruning={"target_gaussians": N + 1}))
    for step in range(4):
        training.step(step)
    assert f"the field has only {N} Gaussians" in " ".join(capsys.readouterr().out.split())


def test_the_rate_of_a_head_that_starts_later_begins_with_it(build, training_of):
    training = training_of(build(head={"start_at": 6}))
    decays = {name: Decay(0.01, 20, 1.0, name == "compensation", 0) for name in ("means", "compensation")}
    for name, decay in decays.items():
        optimizer = training.optimizers.optimizers[name]
        training.optimizers.schedulers[name] = torch.optim.lr_scheduler.LambdaLR(optimizer, decay)
    for step in range(8):
        training.step(step)
        assert training.model.state.head_enabled == (step > 6)
    assert {name: decay.pruned_at for name, decay in decays.items()} == {"means": 3, "compensation": 6}


def said(capsys):
    return [line for line in capsys.readouterr().out.splitlines() if " needs more than " in line]


NONE = "nothing is pruned"
MORE = "more Gaussians are left than asked for"
REST = ", and the head stays disabled; train longer, or prune earlier"
LATE = "it stays disabled; train longer, or enable it earlier"
EARLY = {"mode": "continuous", "start": 1, "stop": 5}


@pytest.mark.parametrize(
    ("pruning", "head", "ending"),
    [
        ({"prune_at": 3}, {}, f"3 (pruning.prune-at): {NONE}{REST}"),
        ({"prune_at": 3}, {"mode": "off"}, f"3 (pruning.prune-at): {NONE}; train longer, or prune earlier"),
        ({"prune_at": 3}, {"start_at": 1}, f"3 (pruning.prune-at): {NONE}; train longer, or prune earlier"),
        ({"prune_at": 3}, {"start_at": 9}, f"3 (pruning.prune-at): {NONE}{REST}"),
        ({"mode": "continuous", "start": 3}, {}, f"3 (pruning.start): {NONE}{REST}"),
        ({**EARLY, "every": 3}, {}, f"4 (pruning.stop): {MORE}{REST}"),
        ({**EARLY, "every": 5}, {}, "6 (pruning.stop): it stays disabled; train longer, or prune earlier"),
        ({**EARLY, "every": 5, "max_gaussians": 40}, {}, f"5 (pruning.stop): {MORE}{REST}"),
        ({"prune_at": 1}, {"start_at": 4}, f"5 (head.start-at): {LATE}"),
        ({"prune_at": 1}, {"start_at": 2}, f"3 (head.start-at): {LATE}"),
        ({"mode": "off"}, {"start_at": 4}, f"5 (head.start-at): {LATE}"),
        ({"mode": "off"}, {}, "4 (pruning.prune-at): it stays disabled; train longer, or prune earlier"),
        ({"prune_at": 2}, {}, "3 (pruning.prune-at): it stays disabled; train longer, or prune earlier"),
    ],
)
def test_a_run_that_does_not_prune_to_the_end_says_so_in_one_line_before_and_after(
    build, training_of, capsys, pruning, head, ending, tmp_path
):
    training = training_of(build(pruning=pruning, head=head), trainer_of(tmp_path))
    (before,) = said(capsys)
    which = "first prune" if "nothing" in ending else "head" if "it stays" in ending else "last prune"
    assert before.startswith(f"Warning: training ends after 3 steps, and the {which} needs more than " + ending)
    for step in range(3):
        training.step(step)
    assert said(capsys) == []
    training.run_callbacks(TrainingCallbackLocation.AFTER_TRAIN, 2)
    assert said(capsys) == [before]


@pytest.mark.parametrize(
    "options",
    [
        {"pruning": {"prune_at": 1}},
        {"pruning": {"prune_at": 2}, "head": {"mode": "off"}},
        {"pruning": {"mode": "off"}, "head": {"mode": "off"}},
        {"pruning": {"mode": "off"}, "head": {"start_at": 1}},
        {"pruning": {"mode": "continuous", "start": 1, "stop": 1}},
        {"pruning": {"mode": "continuous", "start": 1, "every": 5, "stop": 5}, "head": {"mode": "off"}},
        {"pruning": {"prune_at": 100}, "warm_start": Path("anything")},
        {"pruning": {"prune_at": 100}, "head": {"start_at": 101}, "warm_start": Path("anything")},
    ],
)
def test_a_run_that_prunes_or_is_not_to_says_nothing(build, training_of, capsys, options):
    model = build(**options)
    model._start = Start()  # of a file that need not be there
    training = training_of(model, trainer_of())
    training.run_callbacks(TrainingCallbackLocation.BEFORE_TRAIN_ITERATION, 2)
    training.run_callbacks(TrainingCallbackLocation.AFTER_TRAIN, 2)
    assert said(capsys) == []


def test_a_warm_start_counts_from_the_prune(build, training_of, capsys):
    model = build(pruning={"prune_at": 100}, head={"start_at": 102}, warm_start=Path("anything"))
    model._start = Start()  # of a file that need not be there
    training = training_of(model, trainer_of())
    (line,) = said(capsys)
    assert f"training ends after 3 steps, and the head needs more than 3 (head.start-at): {LATE}" in line
    training.step(0)
    assert "step 0: kept 30 of 60 Gaussians" in " ".join(capsys.readouterr().out.split())


FLOATERS = [4, 50]  # Rows of a field of 60 Gaussians; the cameras are 3 away from its middle


def with_floaters(build, **options):
    model = build(pruning={"keep_ratio": 1.0, "prune_at": 4}, stop_split_at=4, **options)
    with torch.no_grad():
        model.gauss_params["means"][FLOATERS] = torch.tensor([0.5, 0.1, 2.9])  # a tenth in front of the third camera
    return model


def near(model):
    return int((model.means[:, 2] > 2).sum())


def test_floaters_go_when_growth_ends_and_training_goes_on(build, training_of, capsys):
    training = training_of(with_floaters(build))
    for step in range(3):
        training.step(step)
        assert near(training.model) == 2
    training.step(3)
    assert training.model.num_points == 58
    assert near(training.model) == 0
    assert "removed 2 floaters right in front of a camera" in " ".join(capsys.readouterr().out.split())
    assert training.live()
    training.step(4)
    assert training.model.num_points == 58


def test_a_capture_without_points_keeps_its_field(build, training_of):
    training = training_of(with_floaters(build, seed_points=None, num_random=60))
    for step in range(5):
        training.step(step)
    assert training.model.num_points == 60


@pytest.mark.parametrize(("saved_after", "left"), [(2, 0), (3, 1)])
def test_a_resumed_run_removes_them_only_if_that_was_still_due(build, training_of, saved_after, left):
    training = training_of(with_floaters(build))
    for step in range(saved_after + 1):
        training.step(step)
    saved = training.model.state_dict()
    model = build(pruning={"keep_ratio": 1.0, "prune_at": 4}, stop_split_at=4)
    model.load_state_dict(saved)
    with torch.no_grad():  # moved there since, as in a field that trains on
        model.gauss_params["means"][0] = torch.tensor([0.5, 0.1, 2.9])
    resumed = training_of(model)
    resumed.step(saved_after + 1)
    assert near(resumed.model) == left
