"""Schedules that follow the length of the run, learning rates, and optimizers."""

from copy import deepcopy
from dataclasses import replace

import pytest
import torch
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from torch.optim import Adam
from torch.optim.lr_scheduler import ExponentialLR

from sundae_ns.core.errors import ConfigError
from sundae_ns.head.head import CompensationHead, HeadConfig
from sundae_ns.plugin.optimizer_configs import FusedAdamConfig, NetworkAdamConfig, PruneAwareDecayConfig
from sundae_ns.train import schedules
from sundae_ns.train.pruning import UNPRUNED
from sundae_ns.train.schedules import SPARSE, Decay, fit_to_length, given_options, notify_pruned, option

OURS = sorted(name for name in all_methods if name.startswith("sundae"))


def fitted(method, length, *words, **model):
    """A configuration of ``length`` steps; ``words`` are options that keep their value, ``model`` are new values."""
    config = deepcopy(all_methods[method])
    config.max_num_iterations = config.schedule_length = length
    for name, value in model.items():
        setattr(config.pipeline.model, name, value)
    fit_to_length(config, deepcopy(all_methods[method]), given_options(words))
    return config


@pytest.mark.parametrize("method", OURS)
def test_the_methods_own_length_changes_nothing(method):
    usual = deepcopy(all_methods[method])
    config = fitted(method, usual.max_num_iterations)
    usual.schedule_length = usual.max_num_iterations
    assert config == usual
    fitted(method, usual.max_num_iterations // 10)
    usual.schedule_length = None
    assert all_methods[method] == usual, "methods share nothing with what is scaled"


@pytest.mark.parametrize("method", OURS)
@pytest.mark.parametrize("share", [0.05, 0.4, 0.9, 2])
def test_every_option_follows_and_once_is_enough(method, share):
    usual = all_methods[method]
    config = fitted(method, round(share * usual.max_num_iterations))
    kept_apart = ("refine_every", "reset_alpha_every", "warmup_steps")
    for name in schedules.step_options(usual):
        if name.endswith(kept_apart):
            continue
        found, value = option(config, name), option(usual, name)
        assert found == (round(share * value) if value else value), name
    for parts in config.optimizers.values():
        assert getattr(parts["scheduler"], "warmup_steps", 0) <= config.max_num_iterations / 12
    again = deepcopy(config)
    fit_to_length(again, deepcopy(usual), frozenset())
    assert again == config, "as for a run that starts from its saved configuration"


def test_a_twentieth_of_the_steps():
    """The run of a user that stayed at a quarter of the resolution to its end."""
    config = fitted("sundae", 1500)
    model = config.pipeline.model
    assert (model.resolution_schedule * model.num_downscales, model.pruning.prune_at) == (300, 600)
    assert (model.stop_split_at, model.sh_degree_interval) == (600, 50)
    assert {parts["scheduler"].max_steps for parts in config.optimizers.values() if parts["scheduler"]} == {1500}
    # Densification needs images for its statistics, and opacities need time to recover.
    assert model.refine_every == schedules.LEAST_IMAGES
    assert model.reset_alpha_every * model.refine_every > model.stop_split_at
    assert dict(schedules.schedule_table(config)) == {
        "images": "1/4 until 150, 1/2 until 300, then full size",
        "densification": "25 to 600, every 50; opacities never reset",
        "SH degree": "+1 every 50 steps",
        "prune": "after 600, to as many as trials choose",
        "head": "after 600, if trials favour it",
        "learning rates": "decay until 1,500",
    }
    # Resets keep their share of a run that has time for them.
    resets = dict(schedules.schedule_table(fitted("sundae", 15000)))["densification"]
    assert resets == "250 to 6,000, every 50; opacities reset every 1,500"


def test_options_set_by_hand_keep_their_value():
    words = ("--pipeline.model.pruning.prune-at", "12000", "--optimizers.means.scheduler.max_steps=30000")
    config = fitted("sundae", 20000, *words, resolution_schedule=77)
    assert config.pipeline.model.pruning.prune_at == 12000, "also where it equals the default"
    assert config.optimizers["means"]["scheduler"].max_steps == 30000
    assert config.optimizers["compensation"]["scheduler"].max_steps == 20000
    assert config.pipeline.model.resolution_schedule == 77
    assert config.pipeline.model.stop_split_at == 8000


@pytest.mark.parametrize("length", [300, 1500, 7000, 50000])
def test_continuous_pruning_keeps_its_number_of_prunes(length):
    def prunes(config):
        return sum(config.pipeline.model.pruning.due(UNPRUNED, step, 1000) for step in range(config.max_num_iterations))

    assert prunes(fitted("sundae-continuous", length)) == prunes(fitted("sundae-continuous", 30000)) == 7


def test_a_resumed_run_keeps_its_schedule():
    run, usual = fitted("sundae", 6000), deepcopy(all_methods["sundae"])
    config = deepcopy(usual)
    config.max_num_iterations = 2000
    config.pipeline.model.sh_degree_interval = 9
    run.pipeline.model.head.size, run.pipeline.model.pruning.keep_ratio = "tiny", 0.3
    config.pipeline.model.pruning.keep_ratio = 0.2
    lines = schedules.take_options(config, run, usual, given_options(["--pipeline.model.pruning.prune-at", "4000"]))
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


MODEL = "pipeline.model."
FIXED = [MODEL + name for name in ("sh_degree", "head.size", "head.num_features", "head.pixel_unshuffle")]


@pytest.mark.parametrize("name", [*FIXED, "optimizers.means.scheduler.max_steps"])
def test_options_that_a_checkpoint_cannot_follow_are_refused(name):
    """Its shapes, and the options of its schedulers, which lie in their states."""
    run, usual = fitted("sundae", 6000), deepcopy(all_methods["sundae"])
    schedules.set_option(run, name, "tiny" if name.endswith("size") else 1)
    given = given_options([f"--{name.replace('_', '-')}"])
    with pytest.raises(ConfigError, match=r"the run to resume has (tiny|1), which cannot change; leave the option out"):
        schedules.take_options(deepcopy(usual), run, usual, given)
    schedules.take_options(deepcopy(usual), run, usual, given_options([]))


@pytest.mark.parametrize(
    ("method", "changed", "expected"),
    [
        ("sundae", {"pruning.mode": "off", "head.mode": "off"}, {"prune": "none", "head": "none"}),
        ("sundae", {"num_downscales": 0}, {"images": "full size"}),
        (
            "sundae",
            {"head.start_at": 25000, "warm_start": "field.ply"},
            {"prune": "at once", "densification": "none: warm start", "head": "after 13,000, if trials favour it"},
        ),
        ("sundae-tiny", {}, {"head": "after 600"}),
        ("sundae-continuous", {}, {"prune": "2,000 to 15,000, every 2,000"}),
    ],
)
def test_tables_of_other_kinds(method, changed, expected):
    config = deepcopy(all_methods[method])
    for name, value in changed.items():
        schedules.set_option(config, MODEL + name, value)
    assert expected.items() <= dict(schedules.schedule_table(config)).items()


def scheduler(optimizer=None, **options):
    optimizer = optimizer or Adam([torch.nn.Parameter(torch.zeros(1))], lr=1e-2)
    return PruneAwareDecayConfig(lr_final=1e-4, max_steps=100, **options).setup().get_scheduler(optimizer, lr_init=1e-2)


def rates(made, steps, prune_at=None, *, name="means", primitives=SPARSE):
    """Rate that each step uses, the scheduler stepping after it as in nerfstudio's trainer."""
    found = []
    for step in range(steps):
        found.append(made.optimizer.param_groups[0]["lr"])
        made.optimizer.step()
        made.step()
        if step == prune_at:
            notify_pruned({name: made}, step, primitives)
    return found


@pytest.mark.parametrize(
    ("shape", "middle"),
    [("exponential", {50: 1e-3}), ("cosine", {25: 1e-4 + 0.99e-2 * (1 + 0.5**0.5) / 2, 50: (1e-2 + 1e-4) / 2})],
)
def test_from_first_to_last(shape, middle):
    found = rates(scheduler(shape=shape), 130)
    for step, rate in {0: 1e-2, **middle, 100: 1e-4, 129: 1e-4}.items():
        assert found[step] == pytest.approx(rate)
    restarted = rates(scheduler(shape=shape, lr_restart=4e-3, warmup_steps=4), 130, prune_at=40)
    assert restarted[:41] == pytest.approx(found[:41])
    fallen = 1 if shape == "cosine" else (1e-4 / 4e-3) ** (2 / 60)
    assert restarted[42] == pytest.approx(3 / 5 * 4e-3 * fallen, rel=0.01)
    assert restarted[70] == pytest.approx((4e-3 + 1e-4) / 2 if shape == "cosine" else (4e-3 * 1e-4) ** 0.5)
    assert restarted[100] == pytest.approx(1e-4)


@pytest.mark.parametrize(
    ("primitives", "factor"),
    [(10 * SPARSE, 1), (SPARSE, 1), (SPARSE // 4, 2), (SPARSE // 9, 3), (1, schedules.MOST_FACTOR)],
)
def test_centres_of_few_primitives_move_faster_after_the_prune(primitives, factor):
    usual = rates(scheduler(lr_restart=4e-3), 130, prune_at=40)
    found = rates(scheduler(lr_restart=4e-3), 130, prune_at=40, primitives=primitives)
    assert found[:41] == usual[:41]
    assert found[41:] == pytest.approx([factor * rate for rate in usual[41:]], rel=1e-3)
    head = rates(scheduler(lr_restart=4e-3), 130, prune_at=40, name="compensation", primitives=primitives)
    assert head == usual
    assert rates(scheduler(), 130, prune_at=40, primitives=primitives) == rates(scheduler(), 130)


def test_a_rate_that_is_held_until_the_prune_falls_as_others_from_there_on():
    options = {"lr_restart": 1e-2, "warmup_steps": 9}
    held, usual = (rates(scheduler(hold_until_prune=hold, **options), 130, prune_at=40) for hold in (True, False))
    assert held == [*[1e-2] * 41, *usual[41:]]
    assert held[41] == pytest.approx(2 / 10 * 1e-2, rel=0.1)
    assert held[41:50] == sorted(held[41:50])


def test_only_the_first_prune_counts_and_others_are_left_alone():
    made = scheduler(lr_restart=1e-2)
    stock = ExponentialLR(Adam([torch.nn.Parameter(torch.zeros(1))]), gamma=0.9)
    notify_pruned({"means": made, "other": stock}, 10, SPARSE)
    notify_pruned({"means": made, "other": stock}, 20, SPARSE)
    (decay,) = made.lr_lambdas
    assert decay.pruned_at == 10
    assert all(type(decay(step)) is float for step in (0, 7, 200)), "and no number of numpy"
    rates(made, 5, prune_at=2)
    assert all(type(rate) is float for rate in made.get_last_lr())


def head_scheduler():
    """Of a network with weights, which decay, and biases: two groups, and torch lists a multiplier for each."""
    parameters = [torch.nn.Parameter(torch.zeros(2, 2)), torch.zeros(1)]
    optimizer = NetworkAdamConfig(lr=1e-2, weight_decay=0.1).setup(parameters)
    made = scheduler(optimizer, lr_restart=1e-2, hold_until_prune=True, warmup_steps=9, shape="cosine")
    assert len(made.lr_lambdas) == 2
    return made


def test_a_trial_that_starts_again_has_the_rates_of_the_first():
    made, trials = head_scheduler(), []
    untouched = schedules.restarts({"compensation": made})
    notify_pruned({"compensation": made}, 0, SPARSE)
    began = schedules.restarts({"compensation": made})
    for _ in range(3):
        trials.append([])
        for _ in range(12):
            trials[-1].append([group["lr"] for group in made.optimizer.param_groups])
            made.optimizer.step()
            made.step()
        schedules.put_restarts({"compensation": made}, began, 12 * len(trials))
    first, *others = ([weights for weights, _ in trial] for trial in trials)
    assert all(weights == biases for trial in trials for weights, biases in trial)
    assert first[0] == pytest.approx(1 / 10 * 1e-2)
    assert first[:10] == sorted(first[:10])
    for other in others:
        assert other[0] == pytest.approx(first[0])
        # The decay has less time left.
        assert other == pytest.approx(first, rel=0.06)
    # A field that was not pruned yet has the rates of before the prune again.
    schedules.put_restarts({"compensation": made}, untouched, 0)
    assert made.optimizer.param_groups[0]["lr"] == 1e-2


def test_the_rates_of_a_trial_decay_as_those_of_a_run():
    decay = Decay(0.01, 1000, 1.0, False, 0, pruned_at=100, ends_at=200)
    assert [decay(step) for step in (100, 150, 200, 500)] == pytest.approx([1, 0.1, 0.01, 0.01])
    assert replace(decay, ends_at=None)(1000) == pytest.approx(0.01)
    assert replace(decay, ends_at=None)(200) > 0.5


def test_the_rise_of_a_rate_is_limited_before_it_begins():
    made = head_scheduler()
    schedules.limit_rise({"compensation": made}, 20)
    schedules.limit_rise({"compensation": made}, 4)
    notify_pruned({"compensation": made}, 0, SPARSE)
    schedules.limit_rise({"compensation": made}, 1)
    assert made.optimizer.param_groups[0]["lr"] == pytest.approx(1 / 5 * 1e-2)
    assert {decay.warmup_steps for decay in made.lr_lambdas} == {4}


def trained(config, device="cpu"):
    value = torch.nn.Parameter(torch.linspace(-1, 1, 7, device=device))
    optimizer = config.setup([value])
    for _ in range(20):
        optimizer.zero_grad()
        (value - 0.3).square().sum().backward()
        optimizer.step()
    return value.detach().cpu()


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_same_steps_as_nerfstudios_adam(device):
    options = {"lr": 0.03, "eps": 1e-12, "weight_decay": 0.01}
    ours, stock = trained(FusedAdamConfig(**options), device), trained(AdamOptimizerConfig(**options))
    torch.testing.assert_close(ours, stock, atol=0 if device == "cpu" else 1e-6, rtol=0)
    optimizer = FusedAdamConfig(**options).setup(torch.nn.Linear(2, 2, device=device).parameters())  # a generator
    assert optimizer.param_groups[0]["fused"] == (device == "cuda")
    assert len(optimizer.param_groups[0]["params"]) == 2


def test_weights_of_many_inputs_have_smaller_rates():
    head = CompensationHead(HeadConfig(size="regular", pixel_unshuffle=1))
    optimizer = NetworkAdamConfig(lr=1e-3, full_rate_inputs=1152).setup(head.parameters())
    rates = {value: group["lr"] for group in optimizer.param_groups for value in group["params"]}
    assert len(rates) == len(list(head.parameters()))
    for conv in (module for module in head.modules() if isinstance(module, torch.nn.Conv2d)):
        assert rates[conv.weight] == pytest.approx(1e-3 * min(1, 1152 / (conv.in_channels * conv.kernel_size[0] ** 2)))
        assert rates[conv.bias] == 1e-3
    assert min(rates.values()) == pytest.approx(1e-3 / 6)  # 3 x 3 of 512 + 256 channels


def test_a_networks_weights_decay_by_a_share_of_the_rate_and_biases_do_not():
    net = torch.nn.Linear(2, 2)
    before = [value.detach().clone() for value in (net.weight, net.bias)]
    optimizer = NetworkAdamConfig(lr=0.1, weight_decay=0.5).setup(net.parameters())
    for value in net.parameters():
        value.grad = torch.zeros_like(value)
    optimizer.step()
    torch.testing.assert_close(net.weight.detach(), 0.95 * before[0])
    assert torch.equal(net.bias.detach(), before[1])
