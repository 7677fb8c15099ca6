"""Checkpoints: those that load, those that are refused in one line, and fields from files of other programs."""

import pickle
import re
import zipfile

import pytest
import torch
from foreign_files import small_field
from limits import verdict
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig

from sundae_ns.core import gaussians as core_gaussians
from sundae_ns.core.errors import CheckpointError
from sundae_ns.core.gaussians import SPLAT_NAMES, finite_mask, sh_to_rgb
from sundae_ns.io import checkpoint
from sundae_ns.io.formats import read_gaussians
from sundae_ns.io.ply import MODEL_FRAME, write_ply


def model_state(n=6, degree=3, **extra):
    state = {f"gauss_params.{name}": value for name, value in small_field(n, degree).items()}
    state["gauss_params.features"] = torch.zeros(n, 5)
    state["networks.head.weight"] = torch.zeros(4, 4)
    about = checkpoint.extra_state(
        step=7,
        num_features=5,
        encoding="harmonics",
        running={"densification": {"grad2d": None}, "pruning": {"pruned_at": -1}},
        extensions={},
        head_enabled=False,
        trained_focal=None,
    )
    state["_extra_state"] = {**about, **extra}
    return state


def check(state):
    """The checks of a checkpoint against a model of 6 Gaussians, in the order of loading."""
    checkpoint.check_extra_state(state, 5, "harmonics")
    checkpoint.check_model_state(state, model_state(6))


def stock_checkpoint(path, prefix="_model.", n=6):
    """A checkpoint of splatfacto by nerfstudio's trainer, whose scheduler leaves a numpy number in it."""
    params = small_field(n)
    optimizer = torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))], lr=1.6e-4)
    config = ExponentialDecaySchedulerConfig(lr_final=1.6e-6, max_steps=100)
    scheduler = config.setup().get_scheduler(optimizer, lr_init=1.6e-4)
    optimizer.step()
    scheduler.step()
    torch.save(
        {
            "step": 1,
            "pipeline": {f"{prefix}gauss_params.{name}": value for name, value in params.items()},
            "optimizers": {"means": optimizer.state_dict()},
            "schedulers": {"means": scheduler.state_dict()},
            "scalers": {},
        },
        path,
    )
    return params


def one_line(error):
    return isinstance(error, ValueError) and "\n" not in str(error)


def test_another_number_of_primitives_fits_but_not_none():
    check(model_state(9))
    with pytest.raises(CheckpointError, match=r"parameters of \[0\] Gaussians"):
        check(model_state(0))


def _without(name):
    return {key: value for key, value in model_state().items() if key != name}


@pytest.mark.parametrize(
    ("state", "cause"),
    [
        (_without("_extra_state"), "splatfacto checkpoint.*warm-start"),
        ({"field.weight": torch.zeros(1)}, "another method.*warm-start"),
        (model_state(method="other"), "not one of sundae"),
        (model_state(format=1), "format 1, this version reads 2; use the version that wrote it"),
        (model_state(format=99), "format 99"),
        (model_state(encoding="logits"), "encoding logits, the model harmonics; .*sh-degree"),
        (model_state(running=None), "where training stopped"),
        (model_state(extensions=[]), "where training stopped"),
        (
            {
                **model_state(),
                "_extra_state": {"method": "sundae", "format": 2, "num_features": 5, "encoding": "harmonics"},
            },
            "where training stopped",
        ),
        (model_state(running={"densification": {}, "pruning": {"pruned_at": "x"}}), "where training stopped"),
        (model_state(running={"densification": {"grad2d": torch.zeros(7)}, "pruning": {}}), "grad2d has 7 rows"),
        (model_state(num_features=13), "num_features 13, the model 5; .*num-features"),
        (_without("networks.head.weight"), "no networks.head.weight"),
        (
            {**model_state(), "networks.head.weight": torch.zeros(8, 4)},
            r"networks.head.weight is \[8, 4\].*\[4, 4\].*--pipeline.model.head.size",
        ),
        (model_state(degree=2), r"features_rest is \[6, 8, 3\].*\[6, 15, 3\]"),
    ],
)
def test_a_checkpoint_that_does_not_fit_is_refused(state, cause):
    with pytest.raises(CheckpointError, match=cause) as caught:
        check(state)
    assert one_line(caught.value)


@pytest.mark.parametrize("prefix", ["_model.", "_model.module."])
def test_stock_checkpoint_with_numpy_numbers(tmp_path, prefix):
    params = stock_checkpoint(tmp_path / "step-000000001.ckpt", prefix)
    read, in_model_frame = read_gaussians(tmp_path / "step-000000001.ckpt")
    assert in_model_frame
    assert tuple(read) == SPLAT_NAMES
    assert all(torch.equal(read[name], params[name]) for name in SPLAT_NAMES)
    with pytest.raises(Exception, match="[Ww]eights.only"):  # numpy is allowed for one file only
        torch.load(tmp_path / "step-000000001.ckpt", weights_only=True)


SUNDAE = {"method": "sundae", "format": checkpoint.FORMAT}


def save_without_harmonics(folder, extra):
    """A checkpoint of SH degree 0, with the state of a model beside its tensors if any is given."""
    state = {f"_model.gauss_params.{name}": value for name, value in small_field(6).items()}
    state["_model.gauss_params.features_rest"] = state["_model.gauss_params.features_rest"][:, :0]
    if extra is not None:
        state["_model._extra_state"] = extra
    torch.save({"step": 1, "pipeline": state}, folder / "step-000000001.ckpt")


@pytest.mark.parametrize(
    ("extra", "logits"),
    [
        (None, True),
        ({}, True),
        ({"method": "other"}, True),
        ({**SUNDAE, "encoding": "logits"}, True),
        ({**SUNDAE, "encoding": "harmonics"}, False),
    ],
)
def test_a_field_of_sh_degree_0_holds_logits_or_harmonics(tmp_path, extra, logits):
    """Logits if the model was built at degree 0, harmonics if a search has lowered the degree."""
    save_without_harmonics(tmp_path, extra)
    read, _ = read_gaussians(tmp_path)
    stored = small_field(6)["features_dc"]
    expected = sh_to_rgb(read["features_dc"]).logit() if logits else read["features_dc"]
    torch.testing.assert_close(expected, stored)


@pytest.mark.parametrize(
    ("extra", "cause"),
    [
        (
            {"method": "sundae", "format": 1, "logits": True},
            "format 1, this version reads 2; use the version that wrote",
        ),
        (SUNDAE, "does not say how it stores colours"),
        ({**SUNDAE, "encoding": "words"}, "does not say how it stores colours"),
        ({**SUNDAE, "encoding": torch.zeros(2)}, "does not say how it stores colours"),
    ],
)
def test_a_field_of_another_format_is_refused(tmp_path, extra, cause):
    """Its colours could be misread silently."""
    save_without_harmonics(tmp_path, extra)
    with pytest.raises(CheckpointError, match=cause) as caught:
        read_gaussians(tmp_path)
    assert one_line(caught.value)


def test_a_field_is_mended_once_and_one_without_a_meaning_is_refused(tmp_path, monkeypatch):
    sanitised = []

    def count(params):
        sanitised.append(len(params["means"]))
        return finite_mask(params)

    monkeypatch.setattr(core_gaussians, "finite_mask", count)
    stored = stock_checkpoint(tmp_path / "step-000000001.ckpt", n=4)
    assert torch.equal(read_gaussians(tmp_path)[0]["means"], stored["means"])
    assert sanitised == [4]
    loaded = checkpoint.read(tmp_path / "step-000000001.ckpt")
    loaded["pipeline"]["_model.gauss_params.means"].fill_(torch.nan)
    torch.save(loaded, tmp_path / "step-000000002.ckpt")
    with pytest.raises(CheckpointError, match=r"has 4 Gaussians, and none is finite"):
        read_gaussians(tmp_path)


@pytest.mark.parametrize("inside", [".", "nerfstudio_models"])
def test_newest_of_a_folder(tmp_path, inside):
    (tmp_path / inside).mkdir(exist_ok=True)
    stock_checkpoint(tmp_path / inside / "step-000000999.ckpt", n=3)
    newest = stock_checkpoint(tmp_path / inside / "step-000029999.ckpt", n=4)
    assert torch.equal(read_gaussians(tmp_path)[0]["means"], newest["means"])


@pytest.mark.parametrize(("comments", "in_model_frame"), [((), False), ((MODEL_FRAME,), True)])
def test_ply(tmp_path, comments, in_model_frame):
    params = small_field(6)
    write_ply(tmp_path / "a.ply", params, comments=list(comments))
    read, in_frame = read_gaussians(tmp_path / "a.ply")
    assert in_frame is in_model_frame
    assert all(torch.equal(read[name], params[name]) for name in SPLAT_NAMES)
    renamed = (tmp_path / "a.ply").rename(tmp_path / "cloud")
    assert torch.equal(read_gaussians(renamed)[0]["means"], params["means"])


def _save(content):
    return lambda path: torch.save(content, path)


def _laugh(path):
    """Lists of 60 levels that hold the one below twice, and one that holds itself."""
    value = [1]
    for _ in range(60):
        value = [value, value]
    value.append(value)
    torch.save({"step": 3, "pipeline": {}, "optimizers": value}, path)


def _pickled(*operations):
    """An archive of torch whose pickle has these operations, between its frame of a dictionary."""

    def write(path):
        torch.save({}, path)
        with zipfile.ZipFile(path) as source:
            entries = {name: source.read(name) for name in source.namelist()}
        with zipfile.ZipFile(path, "w") as target:
            for name, content in entries.items():
                pickled = b"\x80\x02" + b"".join(operations) + b"."
                target.writestr(name, pickled if name.endswith("data.pkl") else content)

    return write


def _call(name, arguments):
    return b"c" + name + b"\n" + arguments + b"R"


_GIGABYTES = b"(\x8a\x05\x00\x00\x00\x00\x01t"  # the tuple of 2^32
_TEXT = b"X\x04\x00\x00\x00abcd"
_HEX = b"X\x03\x00\x00\x00hex"


def _key(levels):
    """Operations for a dictionary whose key has so many levels: its hash visits the lowest 2^levels times."""
    key = (1,)
    for _ in range(levels):
        key = (key, key)
    return b"}" + pickle.dumps(key, 2)[2:-1] + b"K\x01s"


WRONG = {
    "tuples that hold each other": (_pickled(_key(60)), "tuples in tuples"),
    "lists that hold themselves": (_laugh, "holds no Gaussians"),
    "four gigabytes of bytes": (_pickled(_call(b"builtins\nbytearray", _GIGABYTES)), "more than tensors .*bytearray"),
    "four gigabytes of numbers": (_pickled(_call(b"torch\nFloatTensor", _GIGABYTES)), "more than .*FloatTensor"),
    "a storage of four gigabytes": (_pickled(_call(b"torch.storage\nUntypedStorage", _GIGABYTES)), "UntypedStorage"),
    "bytes that double": (_pickled(_call(b"_codecs\nencode", b"(" + _TEXT + _HEX + b"t")), "the codec hex"),
    "a number of 2 GB": (
        _pickled(
            b"cnumpy.core.multiarray\nscalar\n(",
            _call(b"numpy\ndtype", b"(X\x0b\x00\x00\x00V2000000000t"),
            b"tR",
        ),
        "is not a nerfstudio checkpoint",
    ),
    "missing": (lambda path: None, "does not exist"),
    "empty folder": (lambda path: path.mkdir(), "holds no checkpoint"),
    "no checkpoint": (lambda path: path.write_text("hello"), "is not a nerfstudio checkpoint"),
    "empty file": (lambda path: path.write_bytes(b""), "is not a nerfstudio checkpoint"),
    "only tensors": (_save({"weight": torch.zeros(2)}), "it holds no model"),
    "no step": (_save({"pipeline": {"_model.field.weight": torch.zeros(2)}}), "after which step it was saved"),
    "a step of words": (_save({"step": "3", "pipeline": {}}), "after which step it was saved"),
    "a number for a name": (_save({"step": 3, "pipeline": {3: torch.zeros(2)}}), "it holds no model"),
    "a list": (_save([1, 2]), "is not a nerfstudio checkpoint"),
    "another method": (_save({"step": 3, "pipeline": {"_model.field.weight": torch.zeros(2)}}), "holds no Gaussians"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_a_file_without_a_field_is_refused(tmp_path, wrong):
    make, cause = WRONG[wrong]
    path = tmp_path / "a.ckpt"
    make(path)
    error = verdict(lambda: read_gaussians(path), path.stat().st_size if path.is_file() else 0)
    assert isinstance(error, CheckpointError)
    assert re.search(cause, str(error)), error
