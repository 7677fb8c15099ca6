"""Runs of stock splatfacto as configurations of sundae, so that one code path renders and measures all methods."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any, cast

from nerfstudio.data.datamanagers.base_datamanager import DataManagerConfig
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.models.splatfacto import SplatfactoModelConfig

from sundae_ns.compensation import HeadConfig
from sundae_ns.datamanager import SundaeDatamanagerConfig
from sundae_ns.errors import CheckpointError
from sundae_ns.model import SundaeModelConfig
from sundae_ns.storage.runs.config_file import load_config
from sundae_ns.training.pruning_config import PruningConfig


def config_with_field(path: Path) -> tuple[TrainerConfig, SplatfactoModelConfig]:
    """Configuration of a run of sundae or splatfacto and of its model, from its ``config.yml``, which is not run.

    Raises:
        CheckpointError: the file is not a run's configuration, or of another method.
    """
    config = load_config(path)
    model = getattr(getattr(config, "pipeline", None), "model", None)
    if not isinstance(config, TrainerConfig) or not isinstance(model, SplatfactoModelConfig):
        raise CheckpointError(f"{path} is of a method without Gaussians; give a run of sundae or splatfacto")
    return config, model


def model_config(stock: SplatfactoModelConfig) -> SundaeModelConfig:
    """A model of ours that renders a field of splatfacto as splatfacto does: without pruning and without a head."""
    # The grid corrects training images only; test views are rendered without it.
    options = {**_options(stock, SplatfactoModelConfig), "use_bilateral_grid": False}
    return SundaeModelConfig(**options, pruning=PruningConfig(mode="off"), head=HeadConfig(mode="off"))


def datamanager_config(stock: DataManagerConfig) -> SundaeDatamanagerConfig:
    """A datamanager of ours, which also works without CUDA, for the same views; ours is returned unchanged."""
    if isinstance(stock, SundaeDatamanagerConfig):
        return stock
    options = _options(cast(FullImageDatamanagerConfig, stock), FullImageDatamanagerConfig)
    return SundaeDatamanagerConfig(**{**options, "train_cameras_sampling_strategy": "random"})


def _options(config: Any, kind: type[Any]) -> dict[str, Any]:
    return {known.name: getattr(config, known.name) for known in fields(kind) if known.init and known.name != "_target"}
