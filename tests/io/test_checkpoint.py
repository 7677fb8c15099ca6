"""Checkpoints: those that load, those that are refused in one line, and those that a training replaces meanwhile."""

import pickle
import zipfile

import pytest
import torch
from command_line import run as run_command
from foreign_files import small_field, write_checkpoint
from limits import refused
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig

import sundae_ns as sn
from sundae_ns.core.errors import CheckpointError
from sundae_ns.core.gaussians import SPLAT_NAMES, sh_to_rgb
from sundae_ns.io import checkpoint
from sundae_ns.io.formats import read_gaussians

FIELD = small_field(6)
HEAD, NO_CLOCK = "networks.head.weight", "where training stopped"
OURS = {"method": "sundae", "format": checkpoint.FORMAT}


def model_state(n=6, degree=3, **extra):
    state = {f"gauss_params.{name}": value for name, value in small_field(n, degree).items()}
    state["gauss_params.features"] = torch.zeros(n, 5)
    state[HEAD] = torch.zeros(4, 4)
    running = {"densification": {"grad2d": None}, "pruning": {"pruned_at": -1}}
    about = {"step": 7, "num_features": 5, "encoding": "harmonics", "running": running}
    about |= {"extensions": {}, "head_enabled": False, "trained_focal": None}
    state["_extra_state"] = {**OURS, **about, **extra}
    return state


def check(state):
    """The checks of a checkpoint against a model of 6 Gaussians, in the order of loading."""
    checkpoint.check_extra_state(state, 5, "harmonics")
    checkpoint.check_model_state(state, model_state(6))


def _without(name):
    return {key: value for key, value in model_state().items() if key != name}


@pytest.mark.parametrize(
    ("state", "cause"),
    [
        (_without("_extra_state"), "splatfacto checkpoint.*warm-start"),
        ({"field.weight": torch.zeros(1)}, "another method.*warm-start"),
        (model_state(method="other"), "a splatfacto checkpoint.*warm-start"),
        (model_state(format=1), "format 1, this version reads 2; use the version that wrote it"),
        (model_state(format=99), "format 99"),
        (model_state(encoding="logits"), "encoding logits, the model harmonics; .*sh-degree"),
        (model_state(running=[1, 2]), NO_CLOCK),
        (model_state(running={"densification": {}}), NO_CLOCK),
        (model_state(running={"densification": [1, 2], "pruning": {}}), NO_CLOCK),
        (model_state(extensions=[]), NO_CLOCK),
        (model_state() | {"_extra_state": OURS | {"num_features": 5, "encoding": "harmonics"}}, NO_CLOCK),
        (model_state(running={"densification": {}, "pruning": {"pruned_at": "x"}}), NO_CLOCK),
        (model_state(running={"densification": {"grad2d": torch.zeros(7)}, "pruning": {}}), "grad2d has 7 rows"),
        (model_state(num_features=13), "num_features 13, the model 5; .*num-features"),
        (_without(HEAD), f"no {HEAD}"),
        (model_state() | {HEAD: torch.zeros(8, 4)}, rf"{HEAD} is \[8, 4\].*\[4, 4\].*--pipeline.model.head.size"),
        (model_state(degree=2), r"features_rest is \[6, 8, 3\].*\[6, 15, 3\]"),
        (model_state(0), r"parameters of \[0\] Gaussians"),
    ],
)
def test_a_checkpoint_that_does_not_fit_is_refused(state, cause):
    check(model_state(9))  # another number of Gaussians fits
    with pytest.raises(CheckpointError, match=f"^.*{cause}.*$"):
        check(state)


@pytest.mark.parametrize("prefix", ["_model.", "_model.module."])
def test_a_checkpoint_of_splatfacto_has_numpy_numbers(tmp_path, prefix):
    """nerfstudio's scheduler leaves one in it."""
    path, optimizer = tmp_path / "step-000000001.ckpt", torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))], lr=1e-4)
    config = ExponentialDecaySchedulerConfig(lr_final=1.6e-6, max_steps=100)
    scheduler = config.setup().get_scheduler(optimizer, lr_init=1.6e-4)
    optimizer.step()
    scheduler.step()
    state = {f"{prefix}gauss_params.{name}": value for name, value in FIELD.items()}
    write_checkpoint(path, {}, state, schedulers={"means": scheduler.state_dict()})
    read, in_model_frame = read_gaussians(path)
    assert in_model_frame
    assert tuple(read) == SPLAT_NAMES
    assert all(torch.equal(read[name], FIELD[name]) for name in SPLAT_NAMES)
    with pytest.raises(Exception, match="[Ww]eights.only"):  # numpy is allowed for one file only
        torch.load(path, weights_only=True)


@pytest.mark.parametrize(
    ("extra", "stored"),
    [
        (None, "logits"),
        ({}, "logits"),
        ({"method": "other"}, "logits"),
        ({**OURS, "encoding": "logits"}, "logits"),
        ({**OURS, "encoding": "harmonics"}, "harmonics"),
        ({**OURS, "format": 1, "logits": True}, "format 1, this version reads 2; use the version"),
        *((OURS | other, "does not say how") for other in ({}, {"encoding": "words"}, {"encoding": torch.zeros(2)})),
    ],
)
def test_a_field_of_sh_degree_0_holds_logits_or_harmonics(tmp_path, extra, stored):
    """Logits if the model was built at degree 0, harmonics if a search has lowered the degree; no others in silence."""
    field, path = {**FIELD, "features_rest": FIELD["features_rest"][:, :0]}, tmp_path / "step-000000001.ckpt"
    write_checkpoint(path, field, {} if extra is None else {"_model._extra_state": extra})
    if stored in ("logits", "harmonics"):
        colors = read_gaussians(path)[0]["features_dc"]
        torch.testing.assert_close(sh_to_rgb(colors).logit() if stored == "logits" else colors, FIELD["features_dc"])
    else:
        refused(read_gaussians, path, stored, CheckpointError)


def _saved(content):
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
_2_GB = _call(b"numpy\ndtype", b"(X\x0b\x00\x00\x00V2000000000t")
_TEXTS = b"X\x04\x00\x00\x00abcdX\x03\x00\x00\x00hex"


def _key(levels):
    """Operations for a dictionary whose key has so many levels: its hash visits the lowest 2^levels times."""
    key = (1,)
    for _ in range(levels):
        key = (key, key)
    return b"}" + pickle.dumps(key, 2)[2:-1] + b"K\x01s"


WRONG = {
    "tuples that hold each other": (_pickled(_key(60)), "tuples in tuples"),
    "a long structure": (_pickled(b"]q\0(", 1_100_000 * b"h\0", b"e"), "structure has 2,200,008 bytes"),
    "lists that hold themselves": (_laugh, "holds no Gaussians"),
    "four gigabytes of bytes": (_pickled(_call(b"builtins\nbytearray", _GIGABYTES)), "more than tensors .*bytearray"),
    "four gigabytes of numbers": (_pickled(_call(b"torch\nFloatTensor", _GIGABYTES)), "more than .*FloatTensor"),
    "a storage of four gigabytes": (_pickled(_call(b"torch.storage\nUntypedStorage", _GIGABYTES)), "UntypedStorage"),
    "bytes that double": (_pickled(_call(b"_codecs\nencode", b"(" + _TEXTS + b"t")), "the codec hex"),
    "a number of 2 GB": (_pickled(b"cnumpy.core.multiarray\nscalar\n(", _2_GB, b"tR"), "not a checkpoint"),
    "missing": (lambda path: None, "does not exist"),
    "a device": (lambda path: path.symlink_to("/dev/zero"), "it is a pipe or a device, not a file"),
    "empty folder": (lambda path: path.mkdir(), "holds no whole checkpoint"),
    "no checkpoint": (lambda path: path.write_text("hello"), "is not a checkpoint"),
    "empty file": (lambda path: path.write_bytes(b""), "is not a checkpoint"),
    "only tensors": (_saved({"weight": torch.zeros(2)}), "it holds no model"),
    "a step of words": (_saved({"step": "3", "pipeline": {}}), "after which step it was saved"),
    "a number for a name": (_saved({"step": 3, "pipeline": {3: torch.zeros(2)}}), "it holds no model"),
    "a list": (_saved([1, 2]), "is not a checkpoint"),
    "only NaN": (lambda path: write_checkpoint(path, FIELD | {"means": FIELD["means"] * torch.nan}), "none is finite"),
    "another method": (_saved({"step": 3, "pipeline": {"_model.field.weight": torch.zeros(2)}}), "holds no Gaussians"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_a_file_without_a_field_is_refused(tmp_path, wrong):
    make, words = WRONG[wrong]
    make(tmp_path / "a.ckpt")
    refused(read_gaussians, tmp_path / "a.ckpt", words, CheckpointError)


def save(run, step):
    """Replace the checkpoint of a run as the trainer does it: the next one appears, then the other goes."""
    models = run / "nerfstudio_models"
    write_checkpoint(models / "partial", FIELD)
    new = (models / "partial").replace(models / f"step-{step:09d}.ckpt")
    for other in {*models.glob("step-*")} - {new}:
        other.unlink()


@pytest.fixture
def run(tmp_path):
    (tmp_path / "run" / "nerfstudio_models").mkdir(parents=True)
    (tmp_path / "run" / "config.yml").write_text("pipeline:\n  model: {}\n")
    save(tmp_path / "run", 1)
    return tmp_path / "run"


READERS = {
    "load": sn.load,
    "read_gaussians": read_gaussians,
    "export": lambda run: run_command("export", run, "-o", run.parent / "a.ply", "--overwrite"),
}


@pytest.mark.parametrize("lost", ["listed", "checked"])
@pytest.mark.parametrize("reader", READERS)
def test_a_checkpoint_may_go_between_any_two_steps_of_a_read(run, monkeypatch, reader, lost):
    module, name = {"listed": (checkpoint, "checkpoints"), "checked": (torch, "load")}[lost]
    original, steps = getattr(module, name), [3, 2]

    def replacing(*arguments, **options):
        found = original(*arguments, **options) if lost == "listed" else None
        if steps:
            save(run, steps.pop())
        return found if lost == "listed" else original(*arguments, **options)

    monkeypatch.setattr(module, name, replacing)
    assert READERS[reader](run) != 2
    assert len(steps) < 2


def test_a_run_without_a_whole_checkpoint_is_refused_at_once(run):
    (run / "nerfstudio_models" / "step-000000001.ckpt").write_bytes(b"half")
    (run / "nerfstudio_models" / "step-000000009.ckpt").symlink_to("nowhere")
    with pytest.raises(CheckpointError, match=r"step-000000009.ckpt is not whole \(No such file.*; step-000000001"):
        sn.load(run)
