"""Exported files of a finished run: read back by another program, they show the run's base colours."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from sundae_ns.core.gaussians import Gaussians
from sundae_ns.core.metrics import psnr
from sundae_ns.io.ply import read_ply
from sundae_ns.plugin.finished_runs import load_model
from sundae_ns.scene.render import GaussianSource, render_view

PROGRAM = shutil.which("splat-transform")


@pytest.mark.skipif(
    PROGRAM is None, reason="splat-transform is not in PATH: npm install -g @playcanvas/splat-transform (node 22)"
)
def test_exported_files_show_the_base_colours(tiny: Any, call: Any, tmp_path: Path) -> None:
    run = load_model(tiny.config)
    background = run.model._get_background_color()

    settings = run.model.render_settings(training=False).without_head()

    def images(gaussians: dict[str, Tensor]) -> list[Tensor]:
        cameras = [run.model.camera_of(ns_camera) for ns_camera in run.cameras]
        with torch.no_grad():
            return [
                render_view(GaussianSource(Gaussians(gaussians)), camera, background, settings)[0]["base_rgb"]
                for camera in cameras
            ]

    own = images(dict(run.model.gauss_params))
    # The worst seen: 50.2 and 63.0 dB.
    for kind, least in (("ply", None), ("spz", 46.0), ("sog", 55.0)):
        file, back = tmp_path / f"tiny.{kind}", tmp_path / f"{kind}.ply"
        call("sundae", "export", tiny.folder, "-o", file)
        subprocess.run([str(PROGRAM), "--quiet", str(file), str(back)], check=True, capture_output=True, timeout=120)
        for found, expected in zip(images(read_ply(back)), own, strict=True):
            if least is None:
                assert torch.equal(found, expected)
            else:
                assert float(psnr(found, expected)) > least, kind
