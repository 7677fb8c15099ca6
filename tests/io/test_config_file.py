"""``config.yml`` as objects: a configuration of ns-train comes back unchanged, and no code that a file names runs."""

import copy

import pytest
import yaml
from limits import refused
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.utils.writer import EventName

from sundae_ns.core.errors import CheckpointError
from sundae_ns.io import config_file
from sundae_ns.io.config_file import load_config, schedule_length
from sundae_ns.method_configs import sundae_tiny
from sundae_ns.plugin.finished_runs import load_model, load_run
from sundae_ns.scene.packing import contents_of

METHODS = sorted(name for name in all_methods if name.startswith("sundae")) + ["splatfacto", "nerfacto"]


@pytest.mark.parametrize("method", METHODS)
def test_a_saved_configuration_comes_back(tmp_path, method):
    config = copy.deepcopy(all_methods[method])
    config.data = config.pipeline.datamanager.data = tmp_path / "a capture, ünïcode"
    path = tmp_path / "config.yml"
    path.write_text(yaml.dump(config), encoding="utf-8")
    found = load_config(path)
    assert type(found) is type(config)
    assert yaml.dump(found) == yaml.dump(config)
    # One object named twice is one object again.
    assert found.pipeline.datamanager.data is found.data


def test_options_of_later_versions_have_their_defaults(tmp_path):
    path = tmp_path / "config.yml"
    path.write_text("!!python/object:nerfstudio.engine.trainer.TrainerConfig {}")
    found = load_config(path)
    assert found.machine == TrainerConfig().machine
    assert found.max_num_iterations == TrainerConfig().max_num_iterations


def test_a_run_of_an_early_python_3_11_opens(tmp_path):
    """Before 3.11.4 a member of an enumeration was saved as an attribute of its class."""
    path = tmp_path / "config.yml"
    call = "!!python/object/apply:builtins.getattr [!!python/name:nerfstudio.utils.writer.EventName '', {}]"
    path.write_text(f"!!python/object:nerfstudio.engine.trainer.TrainerConfig {{data: {call.format('ETA')}}}")
    assert load_config(path).data is EventName.ETA
    for attribute in ("__class__", "__members__", "3", "[ETA]"):
        path.write_text(f"!!python/object:nerfstudio.engine.trainer.TrainerConfig {{data: {call.format(attribute)}}}")
        refused(load_config, path, kind=CheckpointError)


def test_a_method_of_nerfstudios_variable_is_trusted(tmp_path, monkeypatch):
    path = tmp_path / "config.yml"
    path.write_text("!!python/object:a_method.Config {}")
    lines = "import dataclasses", "@dataclasses.dataclass", "class Config:", "    data: int = 7"
    (tmp_path / "a_method.py").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(config_file, "_trusted_packages", config_file._trusted_packages.__wrapped__)
    refused(load_config, path, "it names a_method.Config", CheckpointError)
    monkeypatch.setenv("NERFSTUDIO_METHOD_CONFIGS", "other=nowhere:METHOD,mine=a_method:METHOD")
    assert load_config(path).data == 7


HOSTILE = {
    "an attribute": "!!python/object/apply:builtins.getattr [!!python/name:sundae_ns.head.head.HeadConfig '', setup]",
    "an attribute of nothing": "!!python/object/apply:builtins.getattr []",
    "a call": "!!python/object/apply:os.mkdir ['{}']",
    "a new object": "!!python/object/new:os.mkdir\nargs: ['{}']",
    "a call of nerfstudio's": "!!python/object/apply:nerfstudio.utils.scripts.run_command ['mkdir {}']",
    "a call of an import": "!!python/object/apply:nerfstudio.utils.scripts.subprocess.run [[mkdir, '{}']]",
    "a call of ours": "!!python/object/apply:sundae_ns.core.files.write_text ['{}', a]",
    "a name from elsewhere": "!!python/name:os.mkdir ''",
    "a name that ours imports": "!!python/name:sundae_ns.core.files.os.mkdir ''",
    "a function for a target": (
        "!!python/object:sundae_ns.head.head.HeadConfig\n_target: !!python/name:nerfstudio.utils.scripts.run_command ''"
    ),
    "an object that is no configuration": "!!python/object:nerfstudio.engine.trainer.Trainer {{a: '{}'}}",
    "an object of no mapping": "!!python/object:nerfstudio.engine.trainer.TrainerConfig ['{}']",
    "a module": "!!python/module:this ''",
    "an import": "!!python/name:antigravity.x ''",
    "a path of numbers": "!!python/object/apply:pathlib.PosixPath [1]",
    "no member of an enumeration": "!!python/object/apply:nerfstudio.utils.writer.EventName [nothing]",
    "a class of ours that is gone": "!!python/name:sundae_ns.gone.Class ''",
    "a tag of nobody": "!unknown 3",
    "half a file": "a: [1",
    "deep lists": "[" * 1000,
    "an impossible date": "a: 2024-99-99",
    "a list as a key": "? {{a: 1}}\n: 2",
    "a merge of a number": "!!python/object:nerfstudio.engine.trainer.TrainerConfig\n<<: 3",
    "no text": "\x00",
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_no_code_that_it_names_runs(tmp_path, kind):
    mark, path = tmp_path / "ran", tmp_path / "config.yml"
    path.write_text(HOSTILE[kind].format(mark) if "{}" in HOSTILE[kind] else HOSTILE[kind])
    for read in (load_config, load_run, load_model):
        refused(read, path, kind=CheckpointError)
        assert not mark.exists()


@pytest.mark.parametrize("text", ["3", "- 1", "!!python/object:nerfstudio.engine.trainer.TrainerConfig {pipeline: 3}"])
def test_a_file_that_is_no_run_is_refused(tmp_path, text):
    path = tmp_path / "config.yml"
    path.write_text(text)
    with pytest.raises(CheckpointError):
        contents_of(load_run(path))
    refused(load_model, path, kind=CheckpointError)
    refused(load_config, tmp_path / "gone.yml", r"cannot be read \(No such file", CheckpointError)
    path.write_bytes(b"\xff\xfe\x80")
    refused(load_config, path, "codec", CheckpointError)
    refused(load_config, tmp_path, "cannot be read", CheckpointError)


def test_a_capture_that_has_moved_with_its_run_is_found_and_the_length_of_its_schedule(tmp_path):
    config = copy.deepcopy(sundae_tiny.config)
    config.output_dir, config.experiment_name, config.timestamp = tmp_path / "here" / "outputs", "e", "t"
    config.pipeline.datamanager.data = tmp_path / "here" / "capture"
    config.pipeline.datamanager.data.mkdir(parents=True)
    config.schedule_length, config.max_num_iterations = 500, 20
    config.save_config()
    assert load_config(config.get_base_dir() / "config.yml").pipeline.datamanager.data == tmp_path / "here" / "capture"
    (tmp_path / "here").rename(tmp_path / "there")
    moved = tmp_path / "there" / "outputs" / "e" / "sundae-tiny" / "t" / "config.yml"
    assert load_config(moved).pipeline.datamanager.data == tmp_path / "there" / "capture"
    (tmp_path / "there" / "capture").rmdir()
    assert load_config(moved).pipeline.datamanager.data == tmp_path / "here" / "capture", "the error names this one"
    assert schedule_length(moved) == 500
    for text in ("a: 1", "schedule_length: null", "[]"):
        moved.write_text(text)
        refused(schedule_length, moved, "states no length", CheckpointError)
