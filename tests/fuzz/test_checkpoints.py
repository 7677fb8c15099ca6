"""Bad checkpoints: damaged files, odd contents, and pickles that would run code."""

import io
import os
import zipfile
from functools import cache
from types import SimpleNamespace

import pytest
import torch
from damage import INSIDE
from documents import GONE, put
from limits import refused, verdict
from models import _build
from nerfstudio.engine.optimizers import Optimizers
from torch.amp import GradScaler

from sundae_ns.core.errors import SundaeError
from sundae_ns.io.formats import read_gaussians
from sundae_ns.plugin.distributed import Ranks
from sundae_ns.plugin.optimizer_configs import FusedAdamConfig
from sundae_ns.plugin.trainer import SundaeTrainer


class Pipeline(torch.nn.Module):
    """The part of nerfstudio's pipeline that a checkpoint uses."""

    def __init__(self):
        super().__init__()
        self._model = _build(n=30)
        outputs = SimpleNamespace(dataparser_transform=torch.eye(4)[:3], dataparser_scale=1.0)
        self.datamanager = SimpleNamespace(train_dataparser_outputs=outputs)

    model = property(lambda self: self._model)

    def load_pipeline(self, state, step):
        self._model.load_state_dict({name.removeprefix("_model."): value for name, value in state.items()})


@cache
def trainer():
    """A trainer with only the attributes that saving and resuming use; shared, because every case loads its state."""
    made = SundaeTrainer.__new__(SundaeTrainer)
    made.ranks = Ranks()
    made.pipeline = Pipeline()
    groups = made.pipeline._model.get_param_groups()
    made.optimizers = Optimizers({n: {"optimizer": FusedAdamConfig(), "scheduler": None} for n in groups}, groups)
    made.grad_scaler = GradScaler(enabled=False)
    made.config = SimpleNamespace(**dict.fromkeys(("load_dir", "load_step", "load_checkpoint")))
    vars(made.config).update(load_scheduler=True, save_only_latest_checkpoint=True, machine=SimpleNamespace(seed=0))
    return made


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    made = trainer()
    made.checkpoint_dir = tmp_path_factory.mktemp("good")
    made.save_checkpoint(7)
    return (made.checkpoint_dir / "step-000000007.ckpt").read_bytes()


def resume(path):
    made = trainer()
    made.config.load_checkpoint = path
    made._load_checkpoint()


def test_a_valid_checkpoint_is_read(good, tmp_path):
    path = tmp_path / "a.ckpt"
    path.write_bytes(good)
    assert verdict(lambda: resume(path), len(good)) is None
    assert verdict(lambda: read_gaussians(path), len(good)) is None
    # Tensors without their bytes are refused.
    sizes = [entry.file_size for entry in zipfile.ZipFile(io.BytesIO(good)).infolist()]
    path.write_bytes(INSIDE[".ckpt"](good, lambda _: b"", sizes.index(max(sizes))))
    refused(resume, path, kind=SundaeError)


@pytest.fixture
def folder(good, tmp_path):
    """The trainer's folder with two checkpoints; the newer one is truncated."""
    (tmp_path / "step-000000007.ckpt").write_bytes(good)
    (tmp_path / "step-000000008.ckpt").write_bytes(good[:-1000])
    made = trainer()
    made.config.load_dir, made.config.load_checkpoint = tmp_path, None
    yield tmp_path
    made.config.load_dir = made.config.load_step = None


def test_training_resumes_from_the_newest_complete_checkpoint(folder, capsys):
    made = trainer()
    assert verdict(made._load_checkpoint, 10**6) is None
    assert made._start_step == 8
    assert "skipped a damaged checkpoint: step-000000008.ckpt is not whole" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("step", [8, 9])
def test_a_requested_step_is_not_replaced(folder, step):
    made = trainer()
    made.config.load_step = step
    assert f"step-{step:09d}.ckpt" in str(verdict(made._load_checkpoint, 10**6))


EXTRA, PARAMETERS = "pipeline/_model._extra_state", "pipeline/_model.gauss_params"
MEANS = f"{PARAMETERS}.means"
ODD = {
    "no optimizers": {"optimizers": GONE},
    "optimizers of another field": {"optimizers/means/param_groups": lambda groups: [*groups, {"lr": 1.0}]},
    "generators that are numbers": {"random": {"python": 1, "numpy": 2, "torch": 3, "cuda": 4}},
    "no step of the model": {f"{EXTRA}/step": GONE},
    "no focal lengths": {f"{EXTRA}/trained_focal": GONE},
    "focal lengths of words": {f"{EXTRA}/trained_focal": ["near", "far"]},
    "one focal length": {f"{EXTRA}/trained_focal": [1.0]},
    "no Gaussians": {f"{PARAMETERS}.{name}": lambda value: value[:0] for name in ("means", "scales")},
    "fewer centres than sizes": {MEANS: lambda value: value[:5]},
    "a flat centre": {MEANS: lambda value: value.flatten()},
    "a centre that is a number": {MEANS: torch.tensor(1.0)},
    "a centre that is a word": {MEANS: "here"},
    "two dimensions": {MEANS: lambda value: value[:, :2]},
    "colours of no degree": {f"{PARAMETERS}.features_rest": torch.zeros(30, 7, 3)},
    "sparse centres": {MEANS: lambda value: value.to_sparse()},
    "quantized centres": {MEANS: lambda value: torch.quantize_per_tensor(value, 0.1, 0, torch.quint8)},
    "centres without values": {MEANS: lambda value: value.to("meta")},
    "a billion Gaussians in 12 bytes": {MEANS: torch.zeros(1, 3).expand(10**9, 3)},
}


@pytest.mark.parametrize("kind", ODD)
def test_odd_contents_are_refused(good, tmp_path, kind):
    state = torch.load(io.BytesIO(good), weights_only=True)
    put(state, ODD[kind])
    torch.save(state, path := tmp_path / "a.ckpt")
    refused(resume, path, kind=SundaeError)
    verdict(lambda: read_gaussians(path), path.stat().st_size)


class MakesFolder(str):
    """A path that becomes a folder when it is unpickled."""

    def __reduce__(self):
        return os.mkdir, (str(self),)


@pytest.mark.parametrize("place", ["pipeline", "optimizers", "random", "schedulers", "scalers"])
def test_nothing_in_a_checkpoint_is_run(good, tmp_path, place):
    folder, path = tmp_path / "folder", tmp_path / "a.ckpt"
    state = torch.load(io.BytesIO(good), weights_only=True)
    state[place] = {**state[place], "extra": MakesFolder(folder)}
    torch.save(state, path)
    torch.load(path, weights_only=False)
    assert folder.exists(), "unpickling does not make the folder, so this test could not fail"
    folder.rmdir()
    for read in (resume, read_gaussians):
        refused(read, path, kind=SundaeError)
    assert not folder.exists()
