"""Branches of ``benchmarks/rules.py`` that are trained by one step for all come out as each does by itself."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from sundae_ns.data.scene_folder import write_scene
from sundae_ns.rasterization import GsplatBackend
from sundae_ns.rendering.render import Style, render
from sundae_ns.rendering.views import View

FOLDER = Path(__file__).parents[1] / "benchmarks"
RULES = ["random", "contribution", "detail-merge"]


@pytest.fixture(params=["", "--pipeline.model.num-downscales 2"])
def bench(request: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Branches of 6 steps after a warm-up of 10 on a small made scene, with pictures as they are or at a quarter."""
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.setenv("BENCHMARK_COMMIT", "none")
    import rules

    write_scene(tmp_path / "scene", train_views=6, test_views=2, width=40, height=32, points=120)
    options = ["--scene", "made", "--data", str(tmp_path / "scene"), "--method", "sundae-tiny", "--warmup", "10"]
    options += ["--steps", "6", "--keep", "0.5", "--rules", *RULES, "--parser", "nerfstudio-data", "--rows", "-"]
    options += ["--extra", request.param] if request.param else []
    options += ["--out", str(tmp_path / "out"), "--results", str(tmp_path / "rules.jsonl")]
    monkeypatch.setattr(sys, "argv", ["rules.py", *options])
    parsed = rules.parse()
    return rules.Bench(parsed), rules.branches(parsed)


def test_each_is_as_it_would_be_alone(bench: Any) -> None:
    machine, branches = bench
    alone = [line for branch in branches for line in machine.branch([branch])]
    together = machine.branch(branches)
    assert [line["rule"] for line in together] == RULES
    assert all(line["psnr"] != line["psnr_pruned"] for line in together)
    assert len({line["psnr"] for line in together}) == len(RULES)
    for one, other in zip(alone, together, strict=True):
        assert other["abreast"] == len(RULES)
        for name in ("primitives", "psnr_pruned", "psnr", "ssim"):
            assert other[name] == one[name], name


def test_rounds_and_other_budgets_are_trained_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(FOLDER))
    import rules

    def named(rule: str, keep: float) -> Any:
        return rules.Branch(rule, keep, 0, rules.RULES[rule])

    wanted = [named(rule, keep) for keep in (0.1, 0.3) for rule in (*RULES, "detail-rounds", "detail-merge-rounds")]
    found = [[(b.rule, b.keep) for b in group] for group in rules.groups(wanted, 2)]
    first = [
        [("random", 0.1), ("contribution", 0.1)],
        [("detail-merge", 0.1)],
        [("detail-rounds", 0.1)],
        [("detail-merge-rounds", 0.1)],
    ]
    assert found[:4] == first
    assert sum(found, []) == [(b.rule, b.keep) for b in wanted]


@pytest.mark.gpu
@pytest.mark.parametrize("antialiased", [False, True])
def test_pictures_and_gradients_drawn_at_once(monkeypatch: pytest.MonkeyPatch, antialiased: bool) -> None:
    monkeypatch.syspath_prepend(str(FOLDER))
    import abreast

    n, count = 400, 3
    shapes = {
        "means": (3,),
        "quats": (4,),
        "scales": (3,),
        "opacities": (1,),
        "features_dc": (3,),
        "features_rest": (15, 3),
    }
    fields = {name: torch.randn(count, n, *shape, device="cuda") for name, shape in shapes.items()}
    fields["means"][..., 2] += 4
    fields["scales"] -= 3
    view = View(torch.eye(4).cuda(), torch.tensor([[90.0, 0, 50], [0, 90, 35], [0, 0, 1]]).cuda(), 101, 70, 90.0)
    background, style = torch.rand(3).cuda(), Style(GsplatBackend(), antialiased=antialiased, training=True)
    weights = torch.rand(count, 70, 101, 3).cuda()

    def pictures_and_gradients(draw: Any) -> tuple[torch.Tensor, list[torch.Tensor]]:
        leaves = {name: value.clone().requires_grad_() for name, value in fields.items()}
        pictures = torch.stack(list(draw(leaves)))
        return pictures, list(torch.autograd.grad((weights * pictures).sum(), list(leaves.values())))

    def one_by_one(leaves: dict[str, torch.Tensor]) -> list[torch.Tensor]:
        each = [{name: value[i] for name, value in leaves.items()} for i in range(count)]
        return [render(field, view, background, style, depth=False)[0]["base_rgb"] for field in each]

    found, slopes = pictures_and_gradients(lambda leaves: abreast.draw(leaves, view, background, style))
    expected, expected_slopes = pictures_and_gradients(one_by_one)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)
    for slope, truth in zip(slopes, expected_slopes, strict=True):
        assert (slope - truth).norm() < 1e-4 * truth.norm()
