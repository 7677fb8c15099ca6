"""``sundae pack --finetune`` on a finished run: the gain, what is stored, and what does not change."""

import copy
import hashlib
import shutil
from types import SimpleNamespace

import pytest
import torch
import yaml
from nerfstudio.configs.method_configs import all_methods

from sundae_ns.cli import main
from sundae_ns.cli.pack import pack
from sundae_ns.core.errors import CheckpointError, ConfigError, MemoryExhaustedError
from sundae_ns.core.metrics import psnr
from sundae_ns.io import checkpoint
from sundae_ns.io.pack.config import FINETUNED, PackConfig
from sundae_ns.io.pack.container import read_header
from sundae_ns.io.pack.packed_scene import fit_scene, read_scene, write_fitted
from sundae_ns.plugin import tuned_packs
from sundae_ns.plugin.finished_runs import load_model, load_run
from sundae_ns.plugin.tuned_packs import RoundedTraining, finetune
from sundae_ns.scene.optimise import rate_factor
from sundae_ns.scene.packing import contents_of

COARSE = PackConfig(
    position_bits=12,
    scale_step=0.3,
    rotation_step=0.08,
    color_step=0.9,
    opacity_step=0.5,
    harmonics_step=1.0,
    feature_step=0.3,
    head_step=0.1,
)


def digests(folder):
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def quality(run, file):
    """Mean PSNR of a packed scene on the test views, dB."""
    pipeline = load_model(file, data=run.scene)
    with torch.no_grad():
        values = [
            float(psnr(pipeline.model.get_outputs_for_camera(camera)["rgb"], truth))
            for camera, truth in zip(pipeline.cameras, pipeline.truths, strict=True)
        ]
    return sum(values) / len(values)


def test_training_makes_up_for_the_rounding(tiny, tmp_path, monkeypatch):
    # Ten times the rates for a twentieth of the steps.
    monkeypatch.setattr(tuned_packs, "RATES", {name: 10 * rate for name, rate in tuned_packs.RATES.items()})
    seen = []
    train = RoundedTraining.step

    def watched(training, *arguments):
        result = train(training, *arguments)
        seen.append({name: value.detach().clone() for name, value in training._model.named_parameters()})
        return result

    before = digests(tiny.folder)
    scene = contents_of(load_run(tiny.folder))
    losses = []
    with monkeypatch.context() as patch:
        patch.setattr(RoundedTraining, "step", watched)
        trained, codecs = finetune(tiny.folder, scene, COARSE, 60, progress=losses.append)
    assert digests(tiny.folder) == before
    assert len(losses) == len(seen) == 60
    # Images are made of rounded values: rounding them again changes nothing.
    assert codecs.head is not None
    for state in (seen[0], seen[1], seen[-1]):
        shown = codecs.rounded({name: state[f"gauss_params.{name}"] for name in codecs.gaussians})
        assert all(torch.equal(shown[name], state[f"gauss_params.{name}"]) for name in ("scales", "features_dc"))
        for name in trained.head:
            value = state[f"networks.head.{name}"]
            assert torch.equal(codecs.head.rounded(name, value), value)
    assert not torch.equal(seen[0]["gauss_params.scales"], seen[-1]["gauss_params.scales"])
    assert trained.meta["source"] == {**scene.meta["source"], "finetuned": 60}
    # The positions are those of a pack without it, and everything else has moved.
    fitted, _ = fit_scene(scene, COARSE)
    assert torch.equal(trained.gaussians["means"], fitted.gaussians["means"])
    for name in codecs.gaussians:
        assert not torch.equal(trained.gaussians[name], fitted.gaussians[name]), name
    for name, value in trained.head.items():
        assert not torch.equal(value, fitted.head[name]), name

    write_fitted(tmp_path / "a.sundae", trained, codecs)
    found = read_scene(tmp_path / "a.sundae")
    shown = codecs.rounded(trained.gaussians)
    assert all(torch.equal(found.gaussians[name], shown[name]) for name in codecs.gaussians)
    write_fitted(tmp_path / "b.sundae", *fit_scene(scene, COARSE))
    plain = quality(tiny, tmp_path / "b.sundae")
    # As many steps without coarse rounding in the loop.
    blind, _ = finetune(tiny.folder, scene, PackConfig(), 60)
    write_fitted(tmp_path / "c.sundae", *fit_scene(blind, COARSE))
    surprised = quality(tiny, tmp_path / "c.sundae")
    tuned = quality(tiny, tmp_path / "a.sundae")
    assert tuned > plain + 0.1
    assert tuned > surprised + 0.01
    assert (tmp_path / "a.sundae").stat().st_size < 1.05 * (tmp_path / "b.sundae").stat().st_size


def test_the_command(tiny, tmp_path, capsys):
    """On a run whose capture has moved."""
    run, file = tmp_path / "run", tmp_path / "a.sundae"
    shutil.copytree(tiny.folder, run)
    text = (run / "config.yml").read_text()
    (run / "config.yml").write_text(text.replace(f"- {tiny.scene.name}\n", "- elsewhere\n"))
    plain = PackConfig().color_step  # counts although it is that of a pack without a fine-tune
    words = ["pack", str(run), "-o", str(file), "--finetune", "3", "--feature-step", "0.01", "--color-step", str(plain)]
    with pytest.raises(SystemExit, match="2"):
        main(words)
    assert "elsewhere does not exist" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="0"):
        main([*words, "--data", str(tiny.scene)])
    assert f"{file}: " in capsys.readouterr().out
    meta = read_header(file).meta
    assert meta["source"]["finetuned"] == 3
    stored = meta["attributes"]
    config = PackConfig(**{**FINETUNED, "feature_step": 0.01, "color_step": plain})
    _, codecs = fit_scene(contents_of(load_run(run, data=tiny.scene)), config)
    for name in codecs.gaussians:
        assert stored[name]["step"] == codecs.gaussians[name].step, name
    assert stored["scales"]["step"] == FINETUNED["scale_step"]
    assert 0.01 <= stored["features"]["step"] < 0.01 / 0.02**0.5


def test_an_interrupt_leaves_nothing(tiny, tmp_path, monkeypatch):
    def interrupted(step, steps):
        if step == 2:
            raise KeyboardInterrupt
        return 1.0

    monkeypatch.setattr(tuned_packs, "rate_factor", interrupted)
    before = digests(tiny.folder)
    with pytest.raises(KeyboardInterrupt):
        pack(tiny.folder, tmp_path / "a.sundae", finetune=5)
    assert not list(tmp_path.iterdir())
    (tmp_path / "a.sundae").write_text("the one of yesterday")
    with pytest.raises(KeyboardInterrupt):
        pack(tiny.folder, tmp_path / "a.sundae", finetune=5, overwrite=True)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["the one of yesterday"]
    assert digests(tiny.folder) == before


def test_full_memory_is_one_line(tiny, monkeypatch):
    def full(*_, **__):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 300.00 MiB.")

    scene = contents_of(load_run(tiny.folder, max_cameras=0))
    monkeypatch.setattr(torch.autograd, "grad", full)
    count = len(scene.gaussians["means"])
    with pytest.raises(MemoryExhaustedError, match=rf"cannot allocate 300\.00 MiB more with {count:,} Gaussians"):
        finetune(tiny.folder, scene, PackConfig(), 1)


def test_a_run_of_splatfacto(tiny, tmp_path):
    config = copy.deepcopy(all_methods["splatfacto"])
    config.data = config.pipeline.datamanager.data = tiny.scene
    config.pipeline.model.sh_degree = 2
    gaussians = contents_of(load_run(tiny.folder, max_cameras=0)).gaussians
    rest = 0.1 * torch.randn(len(gaussians["means"]), 8, 3)
    rest[::2] = 0  # these colours stay view-independent
    state = {f"_model.gauss_params.{name}": value for name, value in gaussians.items() if name != "features"}
    state |= {"_model.gauss_params.features_rest": rest, "_model.device_indicator_param": torch.zeros(0)}
    checkpoint.write({"step": 29999, "pipeline": state}, tmp_path / "nerfstudio_models" / "step-000029999.ckpt")
    (tmp_path / "config.yml").write_text(yaml.dump(config))
    scene = contents_of(load_run(tmp_path, max_cameras=0))
    trained, codecs = finetune(tmp_path, scene, PackConfig(), 3)
    assert codecs.head is None
    assert trained.head == {}
    fitted, _ = fit_scene(scene)
    flat = [~scene.gaussians["features_rest"].flatten(1).any(dim=1) for scene in (fitted, trained)]
    assert 0 < int(flat[0].sum()) < len(rest)
    assert torch.equal(*flat)
    assert not torch.equal(trained.gaussians["features_rest"], fitted.gaussians["features_rest"])


def test_runs_that_cannot_be_fine_tuned(tiny, tmp_path):
    run = tmp_path / "run"
    (run / "nerfstudio_models").mkdir(parents=True)
    shutil.copy(tiny.config, run)
    shutil.copy(tiny.checkpoint(30), run / "nerfstudio_models")
    scene = contents_of(load_run(run))
    with pytest.raises(CheckpointError, match="was saved during densification"):
        finetune(run, scene, PackConfig(), 3)
    with pytest.raises(ConfigError, match="changes nothing"):
        finetune(run, scene, PackConfig(), 0)


def test_rates_rise_and_fall_to_nothing():
    for steps in (1, 2, 10, 1000):
        factors = [rate_factor(step, steps) for step in range(steps)]
        assert all(0 < factor <= 1 for factor in factors)
        top = factors.index(max(factors))
        assert factors == sorted(factors[:top]) + sorted(factors[top:], reverse=True)
    assert factors[-1] < 1e-4
    assert factors[0] < 0.05


def test_gradients_follow_a_quaternion_to_its_negative():
    exact = torch.nn.functional.normalize(torch.tensor([[-1.0, 0.2, 0.3, 0.1], [1.0, 0.2, 0.3, 0.1]]))
    training = SimpleNamespace(exact={"quats": exact}, rounded={"quats": exact * torch.tensor([[-1.0], [1.0]])})
    RoundedTraining.set_gradient(training, "quats", torch.ones(2, 4), None)
    assert exact.grad is not None
    assert torch.equal(exact.grad, torch.tensor([[-1.0], [1.0]]).expand(2, 4))


@pytest.mark.gpu
def test_replayed_steps_train_the_same_scene(tiny, monkeypatch):
    """One training kernel by kernel, one by recordings: the same losses up to the order of sums."""
    scene = contents_of(load_run(tiny.folder))
    steps = []
    train = RoundedTraining.step

    def watched(training, *arguments):
        steps.append(training)
        return train(training, *arguments)

    def losses():
        found = []
        finetune(tiny.folder, scene, COARSE, 30, progress=lambda loss: found.append(loss.item()))
        return found

    monkeypatch.setattr(RoundedTraining, "step", watched)
    recorded = losses()
    assert len(steps) == 30
    assert steps[-1]._can_record
    assert steps[-1]._recordings._recordings
    monkeypatch.setattr(RoundedTraining, "step", lambda training, *arguments: training._run(*arguments, None))
    assert recorded == pytest.approx(losses(), rel=0.05)
