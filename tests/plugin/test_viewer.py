"""The preview of a prune in the viewer: what it shows, and that it changes nothing."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import get_args

import pytest
import torch
from models import FakeDatamanager, Training, _build, _camera, _perturb, as_the_viewer
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.viewer.utils import parse_object
from nerfstudio.viewer.viewer_elements import ViewerElement
from torch import Tensor

import sundae_ns.plugin.viewer
import sundae_ns.pruning.decision
from sundae_ns.plugin.viewer import RuleName, ViewerControls, previewed_rule
from sundae_ns.pruning.decision import Pruner
from sundae_ns.pruning.scores import response
from sundae_ns.scene.render import GaussianSource, render_view
from sundae_ns.train.curve import CurvePoint, expected_change
from sundae_ns.train.pruning import UNPRUNED, prune_when_due

N = 90
RULES = get_args(RuleName)


def camera(shift=0.0):
    return _camera(32, 24, shift)


class Views(FakeDatamanager):
    """Counts how often its cameras are asked for."""

    asked = 0

    def training_views(self):
        self.asked += 1
        return super().training_views()


def build(n=N, **pruning):
    """A model whose head takes part, as a viewer has set it up."""
    model, cameras = _perturb(_build(n=n, pruning=pruning, background_color="black")), Views()
    pipeline = SimpleNamespace(model=model, datamanager=cameras)
    model.viewer_controls.control._setup(SimpleNamespace(pipeline=pipeline, viser_server=None))
    return model.eval(), cameras


def shown(model, rule, keep_ratio):
    model.viewer_controls.rule.value, model.viewer_controls.keep_ratio.value = rule, keep_ratio
    preview = as_the_viewer(model.viewer_controls.preview)
    return None if preview is None else preview.decision.mask


def picture(model):
    return model.get_outputs_for_camera(camera())


def same(a, b):
    def equal(one, other):
        return torch.equal(one, other) if isinstance(one, Tensor) else one == other

    return a.keys() == b.keys() and all(equal(a[name], b[name]) for name in a)


def test_the_viewer_finds_slider_and_menu():
    model, _ = build()
    found = dict(parse_object(SimpleNamespace(model=model), ViewerElement, "Custom Elements"))
    for name in ("keep_ratio", "rule"):
        assert found[f"Custom Elements/model/viewer_controls/{name}"] is getattr(model.viewer_controls, name)
    assert not list(model.viewer_controls.parameters())
    assert not [name for name in model.state_dict() if "viewer_controls" in name]


def test_the_slider_tells_what_fewer_primitives_lose():
    points = [CurvePoint(n, None, 30.0, 0.9, loss, loss / 40, 0.0, 0.0) for n, loss in ((N, 0.0), (N // 3, 0.6))]
    model, _ = build()
    controls = ViewerControls(model.state, model.config.pruning, model.contribution, lambda: points)
    for share, text in (
        (1.0, f"{N:,} Gaussians: +0.00 dB, SSIM +0.0000"),
        (1 / 3, f"{N // 3} Gaussians: -0.60 dB, SSIM -0.0150"),
        (0.1, f"{N // 10} Gaussians"),  # nobody has tried so few
    ):
        controls.keep_ratio.value = share
        controls._show_expected(controls.keep_ratio)
        assert controls.expected.value == text
    assert expected_change(points, N // 3, round(N / math.sqrt(3))) == pytest.approx((0.3, 0.0075), abs=0.01)
    assert model.viewer_controls._curve() == []


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("keep_ratio", [0.01, 0.37])
def test_exactly_the_share_is_shown(rule, keep_ratio):
    model, _ = build()
    mask = shown(model, rule, keep_ratio)
    assert mask.shape == (N,)
    assert int(mask.sum()) == max(1, round(keep_ratio * N))
    assert torch.equal(mask, shown(build()[0], rule, keep_ratio))


def image_of(model, source, background):
    """The base colours of a source, over a background ``[H, W, 3]`` of one colour."""
    settings = replace(model.render_settings(training=False), head=None)
    return render_view(source, model.camera_of(camera()), background[0, 0], settings)[0]["rgb"]


PRUNES = [
    {},
    {"redistribution": "none", "seed": 3},
    {"score": "response", "selection": "band", "signal": "positions", "edges": "centres", "redistribution": "none"},
]


@torch.no_grad()
@pytest.mark.parametrize("options", PRUNES)
def test_what_is_shown_is_what_the_prune_leaves(options):
    model, cameras = build(**options)
    model.viewer_controls.keep_ratio.value = 0.2
    preview = as_the_viewer(model.viewer_controls.preview)
    seen = as_the_viewer(lambda: picture(model))
    pruning, contribute = model.config.pruning, lambda count: model.contribution(cameras, count)
    pruning.keep_ratio = 0.2
    optimizers = {name: torch.optim.Adam([value], lr=1e-3) for name, value in model.gauss_params.items()}
    report = prune_when_due(pruning, Pruner(model.gauss_params, optimizers), dict(UNPRUNED), 10**6, contribute)
    assert report["after"] == int(preview.decision.mask.sum()) == 18
    assert all(torch.equal(value, preview.gaussians[name]) for name, value in model.state.gaussians.items())
    # A merge and growth show in the picture too.
    assert torch.equal(seen["rgb"], image_of(model, model.source, seen["background"]))


def test_the_rules_of_the_menu_rank_by_what_they_say():
    model, _ = build()
    known = response(model.state.gaussians, previewed_rule(model.config.pruning, "band: both"))
    masks = {rule: shown(model, rule, 0.2) for rule in RULES}
    high, low, both = (masks[rule] for rule in ("band: high", "band: low", "band: both"))
    assert known[high].min() >= known[~high].max()
    assert known[low].max() <= known[~low].min()
    assert torch.equal(both, (both & high) | (both & low))
    assert int((both & high).sum()) == int((both & low).sum()) == 9
    # The share of the slider counts, whatever budget the run had.
    for options in ({"keep_ratio": None, "max_bytes": 900}, {"mode": "continuous", "target_gaussians": 7}):
        mask = shown(build(start=20000, stop=20000, **options)[0], "as configured", 0.2)
        assert torch.equal(mask, masks["as configured"])
    # A graph of half the neighbours, which is enough for pairs, does not serve other rules.
    model, fresh = (build(selection="pairs", edges="centres")[0] for _ in range(2))
    assert shown(model, "as configured", 0.2) is not None
    assert torch.equal(shown(model, "band: high", 0.2), shown(fresh, "band: high", 0.2))


@torch.no_grad()
def test_a_crop_box_cuts_the_preview_too():
    model, _ = build()
    model.viewer_controls.keep_ratio.value = 0.5
    preview = as_the_viewer(model.viewer_controls.preview)
    half = OrientedBox(torch.eye(3), torch.tensor([1.0, 0.0, 0.0]), torch.tensor([2.0, 9.0, 9.0]))
    seen = as_the_viewer(lambda: model.get_outputs_for_camera(camera(), half))
    rows = half.within(model.means).squeeze(-1)[preview.decision.mask]
    assert 0 < int(rows.sum()) < len(rows)
    expected = image_of(model, GaussianSource(preview.gaussians.rows(rows)), seen["background"])
    assert torch.equal(seen["rgb"], expected)


@torch.no_grad()
@pytest.mark.parametrize("rule", RULES)
def test_only_the_viewer_sees_the_preview_and_only_while_it_is_on(rule):
    """On, it shows base colours; it changes neither the model nor what training and evaluation see."""
    model, cameras = build()
    controls, before = model.viewer_controls, picture(model)
    state = {name: value.clone() for name, value in model.state_dict().items() if isinstance(value, Tensor)}
    versions = [value._version for value in model.parameters()]
    controls.rule.value = rule
    assert same(as_the_viewer(lambda: picture(model)), before)
    assert cameras.asked == 0
    controls.keep_ratio.value = 0.3
    seen = as_the_viewer(lambda: picture(model))
    assert torch.equal(seen["rgb"], seen["base_rgb"])
    assert seen["response"].max() > 0
    assert not same(seen, before)
    assert same(picture(model), before)
    trained = {}
    for share in (0.3, 1.0):
        controls.keep_ratio.value = share
        trained[share] = {k: v for k, v in model.train().get_outputs_for_camera(camera()).items() if v is not None}
        model.eval()
    assert same(trained[0.3], trained[1.0])
    assert same(as_the_viewer(lambda: picture(model)), before)
    after = model.state_dict()
    assert all(torch.equal(after[name], value) for name, value in state.items())
    assert [value._version for value in model.parameters()] == versions


@pytest.fixture
def calls(monkeypatch):
    """Sizes of the fields whose graph was built, by the preview or by a decision."""
    seen = []
    original = sundae_ns.plugin.viewer.gaussian_graph

    def counted(params, rule):
        seen.append(len(params["means"]))
        return original(params, rule)

    monkeypatch.setattr(sundae_ns.plugin.viewer, "gaussian_graph", counted)
    monkeypatch.setattr(sundae_ns.pruning.decision, "gaussian_graph", counted)
    return seen


def test_graph_and_views_are_used_once_a_field(calls):
    model, cameras = build()
    for rule in RULES:
        for keep_ratio in (0.1, 0.2, 0.3):
            shown(model, rule, keep_ratio)
    # One graph with the configured edges and one with the paper's; the detail that counts depends on the share.
    assert calls == [N, N]
    assert cameras.asked == 3


def test_a_changed_field_is_scored_anew(calls):
    model, cameras = build()
    first = shown(model, "band: high", 0.2)
    with torch.no_grad():
        model.means[:45] *= 3  # the same tensor, other values
    second = shown(model, "band: high", 0.2)
    assert calls == [N, N]
    assert not torch.equal(first, second)
    other, _ = build(70)
    model.load_state_dict(other.state_dict())
    assert shown(model, "as configured", 0.2).shape == (70,)
    assert calls == [N, N, 70]
    assert cameras.asked == 1


def test_a_prune_in_training_is_seen_and_a_step_is_not(calls):
    model, _ = build()
    model.step, training, kept = 0, Training(model), []
    for step in range(5):
        training.step(step)
        model.eval()
        kept.append(int(shown(model, "band: both", 0.2).sum()))
    after = model.num_points
    assert after == 45
    assert kept == [18, 18, 18, 9, 9]
    assert calls == [N, N, after]  # the second one by the prune itself


@torch.no_grad()
def test_a_rule_that_cannot_be_applied_shows_everything_and_says_so_once(capsys):
    few, _ = build(1)  # a graph needs two
    before = picture(few)
    few.viewer_controls.rule.value, few.viewer_controls.keep_ratio.value = "band: high", 0.5
    for _ in range(2):
        assert same(as_the_viewer(lambda: picture(few)), before)
    assert capsys.readouterr().out.count("no preview of band: high") == 1
    alone, _ = build()
    del alone.viewer_controls.control.viewer
    assert shown(alone, "as configured", 0.5) is None
    assert "no training views" in " ".join(capsys.readouterr().out.split())
    assert shown(alone, "band: low", 0.5) is not None
