"""nerfstudio's own commands on a finished run."""

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from sundae_ns.core.errors import DataError
from sundae_ns.core.gaussians import SPLAT_NAMES
from sundae_ns.io.ply import ply_marks, read_ply


def test_ns_eval(tiny, call_here, tmp_path):
    call_here("ns-eval", "--load-config", tiny.config, "--output-path", tmp_path / "eval.json")
    result = json.loads((tmp_path / "eval.json").read_text())
    assert result["method_name"] == "sundae-tiny"
    assert result["checkpoint"].endswith(f"step-{tiny.steps - 1:09d}.ckpt")
    found = result["results"]
    for name in ("psnr", "psnr_base"):
        assert 10 < found[name] < 60
    for name in ("ssim", "ssim_base"):
        assert 0 < found[name] < 1
    assert found["psnr"] != found["psnr_base"]
    (prune,) = json.loads((tiny.folder / "prune.json").read_text())
    assert found["gaussian_count"] == prune["after"]
    assert found["psnr"] > prune["pruned"]["psnr"]


def test_a_copied_run_is_evaluated_by_its_own_checkpoint(tiny, call_here, tmp_path):
    """The original is still there, with another checkpoint."""
    copy = Path(shutil.copytree(tiny.folder, tmp_path / "copy"))
    for path in (copy / "nerfstudio_models").iterdir():
        if path.name != f"step-{2 * tiny.save_every:09d}.ckpt":
            path.unlink()
    (kept,) = (copy / "nerfstudio_models").iterdir()
    call_here("ns-eval", "--load-config", copy / "config.yml", "--output-path", tmp_path / "eval.json")
    result = json.loads((tmp_path / "eval.json").read_text())
    assert Path(result["checkpoint"]) == kept
    call_here("sundae", "report", copy, "-o", tmp_path / "ours", "--repeats", 0)
    (ours,) = json.loads((tmp_path / "ours" / "report.json").read_text())
    assert ours["configurations"][0]["mean"]["psnr"] == pytest.approx(result["results"]["psnr"], abs=1e-5)


def pictures(folder):
    return [np.asarray(Image.open(path)) for path in sorted(folder.glob("*.png"))]


def test_ns_render_interpolate(tiny, call_here, tmp_path):
    names = ("rgb", "base_rgb", "depth", "accumulation", "features", "response", "background")
    call_here(
        *("ns-render", "interpolate", "--load-config", tiny.config, "--output-path", tmp_path / "out"),
        *("--output-format", "images", "--image-format", "png", "--interpolation-steps", 2),
        *("--rendered-output-names", *names),
    )
    frames = pictures(tmp_path / "out")
    assert len(frames) == 4
    assert all(frame.shape == (48, len(names) * 48, 3) for frame in frames)
    rgb = frames[0][:, :48].astype(float)
    assert rgb.std() > 5
    assert np.abs(rgb - frames[-1][:, :48]).mean() > 1
    # The head changes the picture a little, not the scene.
    assert 0 < np.abs(rgb - frames[0][:, 48:96]).mean() < 30


def test_ns_render_camera_path(tiny, call_here, tmp_path):
    pose = torch.eye(4)
    pose[2, 3] = 1.0
    turned = pose.clone()
    turned[:2, :2] = torch.tensor([[math.cos(0.3), -math.sin(0.3)], [math.sin(0.3), math.cos(0.3)]])
    path = {
        "camera_type": "perspective",
        "render_height": 31,
        "render_width": 45,
        "seconds": 1,
        "camera_path": [{"camera_to_world": m.flatten().tolist(), "fov": 70, "aspect": 1} for m in (pose, turned)],
    }
    (tmp_path / "path.json").write_text(json.dumps(path))
    call_here(
        *("ns-render", "camera-path", "--load-config", tiny.config, "--output-path", tmp_path / "out"),
        *("--output-format", "images", "--image-format", "png", "--camera-path-filename", tmp_path / "path.json"),
    )
    frames = pictures(tmp_path / "out")
    assert [frame.shape for frame in frames] == [(31, 45, 3)] * 2
    assert not np.array_equal(*frames)


@pytest.mark.parametrize("kind", ["equirectangular", "fisheye", "vr180", "omnidirectional"])
def test_other_projections_of_a_camera_path_are_refused(tiny, call_here, tmp_path, kind):
    pose = torch.eye(4).flatten().tolist()
    path = {
        **{"camera_type": kind, "render_height": 32, "render_width": 64, "seconds": 1},
        "camera_path": [{"camera_to_world": pose, "fov": 70, "aspect": 1}],
    }
    (tmp_path / "path.json").write_text(json.dumps(path))
    with pytest.raises(DataError, match="only perspective images can be drawn; set camera_type to perspective"):
        call_here(
            *("ns-render", "camera-path", "--load-config", tiny.config, "--output-path", tmp_path / "out"),
            *("--output-format", "images", "--camera-path-filename", tmp_path / "path.json"),
        )
    assert not list((tmp_path / "out").glob("*.jpg"))


def test_ns_export(tiny, exported):
    assert ply_marks(exported).in_model_frame
    found = read_ply(exported)
    state = torch.load(tiny.checkpoint(tiny.steps - 1), map_location="cpu")["pipeline"]
    for name in SPLAT_NAMES:
        assert torch.equal(found[name], state[f"_model.gauss_params.{name}"]), name
