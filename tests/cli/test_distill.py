"""``sundae prune --distill``."""

import os
import signal

import command_line
import pytest
import torch

import sundae_ns as sn
from sundae_ns.plugin.distill import Distillation


def run(*words):
    return command_line.run("prune", *words, "--distill")


@pytest.fixture
def source(tmp_path):
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0))
    sn.save(sn.Scene.from_points(points, points), tmp_path / "a.ply")
    return tmp_path / "a.ply"


@pytest.mark.usefixtures("short_distillation")
@pytest.mark.parametrize("amount", [("--keep", "0.5"), ("--max-mb", "0.002")])
def test_an_interrupted_distillation_goes_on(source, amount, capsys, monkeypatch):
    out = source.with_name("b.spz")
    words = (source, "-o", out, *amount, "--steps", "6", "--no-head")
    train_step = Distillation._train_step

    def interrupted(self, i):
        train_step(self, i)
        if i == 3:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(Distillation, "_train_step", interrupted)
    assert run(*words) == 130
    assert "saved step 4 of 6" in capsys.readouterr().err
    assert not out.exists()
    monkeypatch.setattr(Distillation, "_train_step", train_step)
    assert run(*words) == 0
    said = capsys.readouterr()
    assert "resuming after step 4 of 6" in said.err
    assert " of 200 Gaussians, without a head" in said.out
    assert sorted(path.name for path in source.parent.iterdir()) == ["a.ply", "b.spz"]
    assert len(sn.load(out)) == 100 if amount[0] == "--keep" else 1940 <= out.stat().st_size <= 2000
