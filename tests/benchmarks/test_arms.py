"""Arms of a comparison: read from a file, checked before anything is trained, and made into commands."""

from pathlib import Path

import pytest

from harness.arms import DEFAULT_FILE, Entry, choose_arms, read_entries
from harness.job import configure
from harness.plan import plan_scene
from sundae_ns.core.errors import ConfigError

DEFAULTS = "sundae sundae-with-head band sundae-no-head sundae-no-head-bytes band-no-head sundae-fast sundae-auto"
DEFAULTS = [*DEFAULTS.split(), "splatfacto", "splatfacto-7k"]
MINE = """
- name: gentle  # a comment
  method: sundae
  options:
    pipeline.model.pruning.keep-ratio: 0.3
    pipeline.model.head.mode: off
- name: listed
  options:
    pipeline.model.pruning.score: response
    --pipeline.model.use_scale_regularization: true
- name: stock
  method: splatfacto
  options: {max-num-iterations: 1000, pipeline.model.sh-degree: 2}
- name: steady
  method: sundae-continuous
  options:
    pipeline.model.pruning.keep-ratio: 0.4
"""


def written(folder, text):
    path = folder / "mine.yaml"
    if text is not None:
        path.write_text(text, errors="surrogateescape")
    return path


def chosen(path, scale=1.0):
    return {arm.name: arm for arm in choose_arms([str(path)], "sundae", scale)}


def test_a_file_of_arms(tmp_path):
    gentle, listed, stock, steady = read_entries(written(tmp_path, MINE))
    assert gentle.method == "sundae"
    off = ("off",)  # a word, not YAML's False
    assert gentle.options == {"pipeline.model.pruning.keep-ratio": ("0.3",), "pipeline.model.head.mode": off}
    scale = "pipeline.model.use-scale-regularization"
    assert listed == Entry("listed", None, {"pipeline.model.pruning.score": ("response",), scale: ("True",)})
    assert (stock.method, stock.options["max-num-iterations"]) == ("splatfacto", ("1000",))
    assert steady.method == "sundae-continuous"


def test_the_default_arms_are_a_file_like_any_other():
    assert [entry.name for entry in read_entries(DEFAULT_FILE)] == DEFAULTS
    arms = choose_arms([], "sundae")
    assert [arm.name for arm in arms] == DEFAULTS
    assert {arm.method for arm in arms} == {"sundae", "sundae-fast", "splatfacto"}
    tiny = choose_arms(["band"], "sundae-tiny")
    assert [(arm.name, arm.kind, arm.method) for arm in tiny] == [("band", "branch", "sundae-tiny")]


def test_default_arms_and_those_of_a_file_together(tmp_path):
    path = str(written(tmp_path, "- name: stock\n  method: splatfacto"))
    assert [arm.name for arm in choose_arms(["band", path], "sundae")] == ["band", "stock"]
    with pytest.raises(ConfigError, match="--arms has band twice; give each once"):
        choose_arms(["band", "band"], "sundae")
    with pytest.raises(ConfigError, match=r"best is no arm; use some of sundae, .*, or a file of arms \(.yaml\)"):
        choose_arms(["best"], "sundae")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("name: a", r"mine.yaml, \$: .* is not of type 'array'; arms.yaml is an example"),
        *((text, "mine.yaml cannot be read .*; give a file of arms") for text in ("- name: [a", "\udcff", None)),
        ("- name: a\n- method: sundae", r"\$\[1\]: 'name' is a required property"),
        ("- {name: a, colour: red}", r"\('colour' was unexpected\)"),
        ("- name: a b", "'a b' does not match"),
        ("- name: sundae-warm-up", "'sundae-warm-up' does not match"),
        ("- {name: a, method: [sundae]}", r"\$\[0\].method"),
        ("- name: a\n- name: a", "mine.yaml has a twice; give each once"),
        ("- {name: a, options: [b 1]}", r"\$\[0\].options"),
        ("- {name: a, options: {b: []}}", r"\$\[0\].options.b"),
        ("- {name: a, options: {machine.seed: 1}}", "sets machine.seed, which the command sets itself; remove it"),
        ("- {name: a, method: splatfact}", "arm a: ns-train has no method 'splatfact'; use splatfacto"),
        ("- {name: a, method: nerfacto}", "arm a: nerfacto has no Gaussians; use splatfacto or a method of"),
        ("- {name: a, options: {P.prunning.score: response}}", "arm a: ns-train sundae refuses its options"),
        ("- {name: a, options: {P.pruning.keep-ratio: 3}}", r"arm a: keep_ratio is 3.0: use a share"),
        ("- {name: a, options: {P.head.num-features: 0}}", "arm a: head.num-features is 0; set at least 1"),
    ],
)
def test_arms_are_refused_in_one_line_before_anything_is_trained(tmp_path, text, said):
    """``P`` is ``pipeline.model``."""
    with pytest.raises(ConfigError, match=f"^.*{said}.*$"):
        chosen(written(tmp_path, text and text.replace("P.", "pipeline.model.")))


def test_lengths_come_from_the_method_times_a_factor(tmp_path):
    path, branch, whole = written(tmp_path, MINE), (12_000, 18_000), (0, 30_000)
    lengths = {"gentle": branch, "listed": branch, "stock": (0, 1000), "steady": whole}
    for scale in (1.0, 0.5):
        found = {name: (arm.warmup, arm.steps) for name, arm in chosen(path, scale).items()}
        assert found == {name: tuple(scale * steps for steps in length) for name, length in lengths.items()}
    kinds = {name: arm.kind for name, arm in chosen(path).items()}
    assert kinds == {"gentle": "branch", "listed": "branch", "stock": "whole", "steady": "whole"}
    for method, scale in (("nerfacto", 1.0), ("sundae-continuous", 1.0), ("sundae", 0.0)):
        with pytest.raises(ConfigError):
            choose_arms(["sundae"], method, scale)


def test_arms_of_a_file_become_commands_of_ns_train(tmp_path):
    arms = list(chosen(written(tmp_path, MINE)).values())
    planned = plan_scene(Path("fox"), (), arms, keep_ratios=[0.1], seeds=[42], repeat_at=[])
    jobs = {job.arm: job for job in planned}
    assert set(jobs) == {"sundae-warm-up", "gentle", "listed", "stock", "steady"}
    assert (jobs["gentle"].keep_ratio, jobs["listed"].keep_ratio, jobs["stock"].keep_ratio) == (0.3, 0.1, None)
    assert jobs["gentle"].key == "fox-gentle-30pct-s42"
    assert jobs["gentle"].needs == jobs["listed"].needs == "fox-sundae-warm-up-s42"
    stock, command = configure(jobs["stock"], tmp_path / "out")
    options = "--data fox --machine.seed 42 --max-num-iterations 1000 --pipeline.model.sh-degree 2"
    assert command == f"ns-train splatfacto {options}"
    assert (stock.max_num_iterations, stock.pipeline.model.sh_degree) == (1000, 2)
    steady, _ = configure(jobs["steady"], tmp_path / "out")
    pruning = steady.pipeline.model.pruning
    assert (steady.max_num_iterations, pruning.mode, pruning.keep_ratio) == (30_000, "continuous", 0.4)
    assert not steady.pipeline.model.evaluate_prune
