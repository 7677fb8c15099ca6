"""Runs as packed scenes: what is stored, what is not, and captures with false claims."""

import copy
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml
from fields import random_field
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.scene_box import SceneBox
from packed_scenes import full_scene

from sundae_ns.core.errors import CheckpointError, DataError, PackError
from sundae_ns.head.head import CompensationHead, HeadConfig
from sundae_ns.io import checkpoint
from sundae_ns.plugin.datamanager import SundaeDatamanagerConfig
from sundae_ns.plugin.finished_runs import (
    datamanager_of,
    describe_capture,
    kept_and_seconds,
    load_run,
    model_of,
    stated_capture,
)
from sundae_ns.scene.packing import contents_of, scene_of


def head():
    torch.manual_seed(1)
    state = CompensationHead(HeadConfig(size="tiny", num_features=5)).state_dict()
    return {name: value + 0.05 * torch.randn_like(value) for name, value in state.items()}


def scene():
    meta = {
        "source": {"method": "sundae", "step": 30000},
        "model": {
            "sh_degree": 2,
            "rasterize_mode": "antialiased",
            "background_color": "white",
            "head": {"mode": "residual", "size": "tiny", "pixel_unshuffle": 2, "num_features": 5, "precision": "bf16"},
            "trained_focal": [40.0, 41.0],
        },
        "frame": {"transform": torch.eye(4)[:3].tolist(), "scale": 0.5},
        "capture": {"parser": "colmap", "options": {"colmap_path": "sparse/0"}, "scale": 1.0},
    }
    return replace(full_scene(60, degree=1, meta=meta), head=head())


def test_a_packed_scene_becomes_a_model():
    truth = scene()
    model = model_of(scene_of(truth))
    found = {name: value.detach() for name, value in model.gauss_params.items()}
    assert torch.equal(found.pop("features_rest")[:, :3], truth.gaussians["features_rest"])
    assert all(torch.equal(value, truth.gaussians[name]) for name, value in found.items())
    assert all(torch.equal(value, truth.head[name]) for name, value in model.head.state_dict().items())
    assert model.state.head_enabled
    assert model.state.trained_focal == (40.0, 41.0)
    assert (model.config.rasterize_mode, model.config.background_color) == ("antialiased", "white")


@pytest.mark.parametrize(
    "parser",
    [
        ColmapDataParserConfig(colmap_path=Path("sparse/0"), downscale_factor=2, eval_mode="interval", eval_interval=5),
        NerfstudioDataParserConfig(auto_scale_poses=False, scale_factor=0.5, center_method="focus"),
        BlenderDataParserConfig(scale_factor=0.5),
        BlenderDataParserConfig(alpha_color=None),
    ],
)
def test_the_options_of_a_capture_survive(parser):
    if hasattr(parser, "load_3D_points"):
        parser.load_3D_points = False
    manager = SundaeDatamanagerConfig(dataparser=parser, camera_res_scale_factor=0.5)
    found, scale = stated_capture(describe_capture(manager))
    assert scale == 0.5
    assert type(found) is type(parser)
    assert vars(found) == vars(parser)


def test_captures_that_are_not_described_or_gone(tmp_path):
    with pytest.raises(DataError, match=str(tmp_path / "gone")):
        datamanager_of(scene_of(scene()), tmp_path / "gone")
    elsewhere = ColmapDataParserConfig(images_path=Path("/elsewhere/images"))
    for parser in (BlenderDataParserConfig(alpha_color="pink"), elsewhere):
        assert describe_capture(SundaeDatamanagerConfig(dataparser=parser)) is None
    for stated in (None, {}, {"parser": "dnerf-data", "options": {}}, {"parser": "colmap", "options": None}):
        with pytest.raises(PackError, match="how its capture is read"):
            stated_capture(stated)
    for scale in (0, 2, "1", None, float("nan")):
        with pytest.raises(PackError, match="an impossible scale"):
            stated_capture({"parser": "colmap", "options": {}, "scale": scale})


@pytest.mark.parametrize(
    ("parser", "name", "values"),
    [
        ("colmap", "images_path", ["../../home", "/etc", "$(touch x)", "a;b", "a\n", 3]),
        ("colmap", "eval_mode", ["whatever", ["all"]]),
        ("colmap", "downscale_factor", [0, True]),
        ("colmap", "scale_factor", [float("nan"), "1"]),
        ("colmap", "auto_scale_poses", [1]),
        ("colmap", "eval_interval", [2.5]),
        ("colmap", "_target", ["os.system"]),
        ("colmap", "data", ["/etc"]),
        ("colmap", "masks_path", [None]),
        ("blender-data", "alpha_color", ["pink", ["white"]]),
        ("blender-data", "ply_path", ["a.ply"]),
    ],
)
def test_impossible_options_of_a_capture(parser, name, values):
    for value in values:
        with pytest.raises(PackError, match="an impossible option"):
            stated_capture({"parser": parser, "options": {name: value}, "scale": 1.0})


def run_folder(folder, method, step, **model):
    """The folder of a run at a step, as ns-train writes it, without the training."""
    config = copy.deepcopy(all_methods[method])
    for name, value in model.items():
        setattr(config.pipeline.model, name, value)
    truth = random_field(60, features=0 if method == "splatfacto" else 5)
    state = {f"gauss_params.{name}": value for name, value in truth.items()}
    state["device_indicator_param"] = torch.zeros(0)
    if method != "splatfacto":
        box, seeds = SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3])), (torch.rand(5, 3), torch.rand(5, 3))
        made = config.pipeline.model.setup(scene_box=box, num_train_data=0, metadata={}, seed_points=seeds)
        made.step = step
        state = made.state_dict() | state
        state["_extra_state"] = made.get_extra_state()
        state |= {name: value + 0.01 for name, value in state.items() if name.startswith("networks.head.")}
    # Stock nerfstudio saves these beside the model.
    state["lpips.net.weight"] = torch.zeros(3)
    state["camera_optimizer.pose_adjustment"] = torch.zeros(7, 6)
    folder.mkdir()
    (folder / "config.yml").write_text(yaml.dump(config))
    (folder / "nerfstudio_models").mkdir()
    saved = {"step": step, "pipeline": {f"_model.{name}": value for name, value in state.items()}}
    checkpoint.write(saved, folder / "nerfstudio_models" / f"step-{step:09d}.ckpt")
    return folder, truth


ANTIALIASED = {"sh_degree": 2, "rasterize_mode": "antialiased"}


@pytest.mark.parametrize(
    ("method", "step", "options", "head", "degree"),
    [
        ("sundae-tiny", 1100, {}, "tiny", 2),
        ("sundae-tiny", 30, {"sh_degree_interval": 20}, None, 1),  # the head and a degree wait
        ("splatfacto", 29999, ANTIALIASED, None, 2),
    ],
)
def test_a_packed_run_holds_what_its_images_need(tmp_path, method, step, options, head, degree):
    run, truth = run_folder(tmp_path / "run", method, step, **options)
    found = contents_of(load_run(run, max_cameras=0))
    truth["features_rest"] = truth["features_rest"][:, : (degree + 1) ** 2 - 1]
    assert set(found.gaussians) == truth.keys() - ({"features"} if head is None else set())
    assert all(torch.equal(value, truth[name]) for name, value in found.gaussians.items())
    assert bool(found.head) == (head is not None)
    assert found.cameras is None
    stated = found.meta["model"]
    assert (stated["head"] or {}).get("size") == head
    assert stated["rasterize_mode"] == options.get("rasterize_mode", "classic")
    assert model_of(scene_of(found)).config.sh_degree == degree
    assert found.meta["source"] == {"method": method, "step": step}
    assert str(tmp_path) not in str(found.meta), "no path of the machine that trained it"
    assert contents_of(load_run(run / "config.yml", max_cameras=0)).meta == found.meta


def test_runs_that_cannot_be_packed(tmp_path):
    (tmp_path / "config.yml").write_text(yaml.dump(all_methods["nerfacto"]))
    with pytest.raises(CheckpointError, match="without Gaussians"):
        load_run(tmp_path)
    run, _ = run_folder(tmp_path / "run", "sundae-tiny", 30)
    with pytest.raises(DataError, match="has no transforms.json"):
        load_run(run)
    (run / "nerfstudio_models" / "step-000000030.ckpt").write_bytes(b"PK")
    with pytest.raises(CheckpointError, match="no whole checkpoint"):
        load_run(run, max_cameras=0)


@pytest.mark.parametrize(
    ("prunes", "figures"),
    [
        ([{"before": 200, "after": 60, "seconds": 1}], (0.3, 1)),  # one-shot
        ([{"before": 100, "after": 50, "seconds": 1}, {"before": 80, "after": 40, "seconds": 0.5}], (0.25, 1.5)),
        ([], (None, None)),
        ([{"before": 100, "after": 50, "seconds": 1}, {"after": 40}], (None, None)),
        ([{"before": 0, "after": 0, "seconds": 1}], (None, 1)),
        ([{"before": "many", "after": 1, "seconds": "long"}], (None, None)),
        ([{"before": 1, "after": 10**400, "seconds": 10**400}], (None, None)),
    ],
)
def test_figures_are_those_of_all_prunes(prunes, figures):
    for value, expected in zip(kept_and_seconds(prunes), figures, strict=True):
        assert value == (None if expected is None else pytest.approx(expected))
