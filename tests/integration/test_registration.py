"""How nerfstudio finds the methods: entry points, help, configurations, and an import path that is light."""

import re
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import pytest
import yaml
from nerfstudio.plugins.types import MethodSpecification

from sundae_ns.head.head import HeadConfig
from sundae_ns.plugin.datamanager import SundaeDatamanager
from sundae_ns.plugin.model import SundaeModel
from sundae_ns.plugin.trainer import SundaeTrainer

METHODS = {"sundae": None, **{f"sundae-{percent}": percent / 100 for percent in (1, 30, 50, 80, 100)}}
METHODS |= {"sundae-continuous": 0.5, "sundae-fast": 0.1, "sundae-paper": 0.1, "sundae-tiny": 0.25}


def ours():
    group = entry_points(group="nerfstudio.method_configs")
    return {point.name: point.load() for point in group if point.value.startswith("sundae_ns.")}


def test_every_method_is_registered_under_its_own_name():
    from nerfstudio.configs.method_configs import all_descriptions, all_methods

    assert set(ours()) == set(METHODS) == set(METHODS) & set(all_methods) & set(all_descriptions)


RULE = ("score", "selection", "redistribution", "edges", "signal")


@pytest.mark.parametrize("name", METHODS)
def test_configuration(name):
    method = ours()[name]
    config = method.config
    assert isinstance(method, MethodSpecification)
    assert method.description
    assert config.method_name == name
    assert config._target is SundaeTrainer
    assert config.viewer.quit_on_train_completion
    model, paper = config.pipeline.model, name == "sundae-paper"
    assert model._target is SundaeModel
    assert config.pipeline.datamanager._target is SundaeDatamanager
    model.pruning.validate()
    model.head.validate()
    assert model.pruning.keep_ratio == METHODS[name]
    if model.pruning.mode == "one-shot":
        assert model.pruning.prune_at < config.max_num_iterations
    rule = tuple(getattr(model.pruning, option) for option in RULE)
    default = ("detail-contribution", "systematic", "merge", "appearance", "attributes")
    assert rule == (("response", "band", "none", "centres", "positions") if paper else default)
    modes = {"sundae-paper": "features", "sundae-tiny": "residual"}
    assert model.head.mode == modes.get(name, HeadConfig().mode)
    assert model.exposure_compensation == ("off" if paper else "auto")
    assert model.drop_rate == (0 if paper or name == "sundae-tiny" else None)
    groups = {"means", "scales", "quats", "features_dc", "features_rest", "opacities", "features", "compensation"}
    assert groups <= set(config.optimizers)
    assert yaml.load(yaml.dump(config), Loader=yaml.Loader) == config
    promised = (Path(__file__).parents[2] / "docs" / "formats.md").read_text().partition("## What is promised")[2]
    names = re.findall(r"sundae_ns\.[\w.]*\.(\w+)", yaml.dump(config))
    assert [name for name in names if f"{name}`" not in promised and f"{name[:-6]}`" not in promised] == []


def test_methods_share_no_objects():
    def parts(value):
        inner = vars(value) if hasattr(value, "__dataclass_fields__") and not isinstance(value, type) else value
        own = set() if inner is value else {id(value)}
        return own.union(*map(parts, inner.values())) if isinstance(inner, dict) else own

    found = [parts(specification.config) for specification in ours().values()]
    assert len(set().union(*found)) == sum(map(len, found)) > 100


def test_import_is_light_and_errors_of_ns_train_are_one_line():
    masked = ("open3d", "torchmetrics", "wandb", "comet_ml", "tinycudann")
    # An import error here would break every ns-* command, and so would importing what imports the entry points.
    code = f"""
import sys
sys.argv = ["/usr/bin/ns-train"]
for name in {masked!r}: sys.modules[name] = None
import sundae_ns.method_configs as configs
assert configs.sundae.config.method_name == "sundae"
assert "nerfstudio.configs.method_configs" not in sys.modules
from sundae_ns.core.errors import DataError
raise DataError("the cause; the mend")
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr.splitlines()[-1]) == (1, "sundae: the cause; the mend"), result.stderr
    assert "Traceback" not in result.stderr
