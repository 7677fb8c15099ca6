"""nerfstudio's own commands and viewer on a finished run."""

import importlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from models import as_the_viewer
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.utils import colormaps
from nerfstudio.utils.eval_utils import eval_setup
from nerfstudio.viewer.utils import parse_object
from nerfstudio.viewer.viewer_elements import ViewerCheckbox, ViewerElement
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
    for suffix in ("", "_base"):
        assert 10 < found[f"psnr{suffix}"] < 60
        assert 0 < found[f"ssim{suffix}"] < 1
    assert found["psnr"] != found["psnr_base"]
    (prune,) = json.loads((tiny.folder / "prune.json").read_text())
    assert found["gaussian_count"] == prune["after"]
    assert found["psnr"] > prune["pruned"]["psnr"]


def test_a_copied_run_is_evaluated_by_its_own_checkpoint(tiny, call_here, tmp_path):
    """The original is still there, with another checkpoint."""
    copy = shutil.copytree(tiny.folder, tmp_path / "copy")
    for path in (copy / "nerfstudio_models").iterdir():
        if path.name != f"step-{2 * tiny.save_every:09d}.ckpt":
            path.unlink()
    (kept,) = (copy / "nerfstudio_models").iterdir()
    call_here("ns-eval", "--load-config", copy / "config.yml", "--output-path", tmp_path / "eval.json")
    result = json.loads((tmp_path / "eval.json").read_text())
    assert Path(result["checkpoint"]) == kept
    call_here("sundae", "compare", copy, "-o", tmp_path / "ours", "--repeats", 0)
    (ours,) = json.loads((tmp_path / "ours" / "report.json").read_text())
    for way, suffix in zip(ours["configurations"], ("", "_base"), strict=True):
        for name in ("psnr", "ssim"):
            assert way["mean"][name] == pytest.approx(result["results"][name + suffix], abs=1e-5)


@pytest.fixture
def render(tiny, call_here, tmp_path):
    """Run ``ns-render``; returns its images."""

    def images(kind, *words):
        out = tmp_path / "out"
        usual = ("--load-config", tiny.config, "--output-path", out, "--output-format", "images")
        call_here("ns-render", kind, *usual, "--image-format", "png", *words)
        return [np.asarray(Image.open(path)) for path in sorted(out.glob("*.png"))]

    return images


def test_ns_render_interpolate(render):
    names = ("rgb", "base_rgb", "depth", "accumulation", "features", "response", "background")
    frames = render("interpolate", "--interpolation-steps", 2, "--rendered-output-names", *names)
    assert len(frames) == 4
    assert all(frame.shape == (48, len(names) * 48, 3) for frame in frames)
    rgb = frames[0][:, :48].astype(float)
    assert rgb.std() > 5
    assert np.abs(rgb - frames[-1][:, :48]).mean() > 1
    # The head changes the image a little, not the scene.
    assert 0 < np.abs(rgb - frames[0][:, 48:96]).mean() < 30


def test_ns_render_camera_path(render, tmp_path):
    """Of two poses; other projections are refused."""
    path = tmp_path / "path.json"
    places = torch.eye(4).repeat(2, 1, 1)
    places[:, 2, 3] = torch.tensor([1.0, 1.5])
    poses = [{"camera_to_world": m.flatten().tolist(), "fov": 70, "aspect": 1} for m in places]
    stated = {"camera_path": poses, "render_height": 31, "render_width": 45, "seconds": 1}
    path.write_text(json.dumps({**stated, "camera_type": "fisheye"}))
    with pytest.raises(DataError, match="only perspective images can be drawn; set camera_type to perspective"):
        render("camera-path", "--camera-path-filename", path)
    assert not list((tmp_path / "out").glob("*.png"))
    path.write_text(json.dumps({**stated, "camera_type": "perspective"}))
    frames = render("camera-path", "--camera-path-filename", path)
    assert [frame.shape for frame in frames] == [(31, 45, 3)] * 2
    assert not np.array_equal(*frames)


def test_ns_export(tiny, call_here, tmp_path):
    try:
        importlib.import_module("open3d")
    except (ImportError, OSError) as error:  # it loads libraries of a desktop
        pytest.skip(f"open3d does not import here: {error}")
    call_here("ns-export", "gaussian-splat", "--load-config", tiny.config, "--output-dir", tmp_path)
    assert ply_marks(tmp_path / "splat.ply").in_model_frame
    found = read_ply(tmp_path / "splat.ply")
    state = torch.load(tiny.checkpoint(tiny.steps - 1), map_location="cpu")["pipeline"]
    assert all(torch.equal(found[name], state[f"_model.gauss_params.{name}"]) for name in SPLAT_NAMES)
    with pytest.raises(DataError, match="not seen by rays; use ns-export gaussian-splat"):
        call_here("ns-export", "pointcloud", "--load-config", tiny.config, "--output-dir", tmp_path)


@pytest.fixture(scope="module")
def pipeline(tiny):
    return eval_setup(tiny.config, test_mode="inference")[1]


def camera(pipeline, height, aspect):
    """A test camera at another size, as the viewer makes it."""
    known = pipeline.datamanager.eval_dataset.cameras[0:1]
    lens = {"fx": 1.2 * height, "fy": 1.2 * height, "cx": int(height * aspect) / 2, "cy": height / 2}
    return Cameras(known.camera_to_worlds, **lens).to(pipeline.device)


@pytest.mark.parametrize(("height", "aspect"), [(30, 1.0), (31, 1.7), (75, 0.6)])
@torch.no_grad()
def test_every_output_becomes_an_image(pipeline, height, aspect):
    pipeline.model.set_background(torch.tensor([0.1, 0.2, 0.3], device=pipeline.device))
    outputs = pipeline.model.get_outputs_for_camera(camera(pipeline, height, aspect), obb_box=None)
    assert list(outputs)[0] == "rgb"
    for name, value in outputs.items():
        for normalize in (False, True):
            shown = colormaps.apply_colormap(value, colormaps.ColormapOptions(normalize=normalize))
            assert shown.shape == (height, int(height * aspect), 3), name
            assert torch.isfinite(shown).all(), name
    for name in ("rgb", "base_rgb", "features", "response", "depth"):
        assert outputs[name].std() > 0, name


@torch.no_grad()
def test_check_box_switches_the_head_off(pipeline):
    # As nerfstudio's control panel finds them.
    controls = [control for _, control in parse_object(pipeline.model, ViewerElement, "Custom Elements")]
    (box,) = [control for control in controls if isinstance(control, ViewerCheckbox) and "compensation" in control.name]
    cam = camera(pipeline, 40, 1.0)
    on = pipeline.model.get_outputs_for_camera(cam)
    box.value = False
    off = as_the_viewer(lambda: pipeline.model.get_outputs_for_camera(cam))
    evaluated = pipeline.model.get_outputs_for_camera(cam)
    box.value = True
    assert torch.equal(off["rgb"], off["base_rgb"])
    assert not torch.equal(on["rgb"], on["base_rgb"])
    assert set(on) == set(off)
    # What a viewer shows must not change what the trainer measures.
    assert torch.equal(evaluated["rgb"], on["rgb"])
