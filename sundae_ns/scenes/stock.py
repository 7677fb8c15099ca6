"""Runs of stock splatfacto as configurations of sundae, so that one code path renders and measures all methods."""

from __future__ import annotations

from dataclasses import fields
from typing import cast

from nerfstudio.data.datamanagers.base_datamanager import DataManagerConfig
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.models.splatfacto import SplatfactoModelConfig

from sundae_ns.compensation import HeadConfig
from sundae_ns.datamanager import SundaeDatamanagerConfig
from sundae_ns.model import SundaeModelConfig
from sundae_ns.training.pruning_config import PruningConfig


def model_config(stock: SplatfactoModelConfig) -> SundaeModelConfig:
    """A model of ours that renders a field of splatfacto as splatfacto does: without pruning and without a head."""
    options = {known.name: getattr(stock, known.name) for known in fields(SplatfactoModelConfig) if known.init}
    options.pop("_target")
    # The grid corrects training images only; test views are rendered without it.
    options["use_bilateral_grid"] = False
    return SundaeModelConfig(**options, pruning=PruningConfig(mode="off"), head=HeadConfig(mode="off"))


def datamanager_config(stock: DataManagerConfig) -> SundaeDatamanagerConfig:
    """A datamanager of ours, which also works without CUDA, for the same views; ours is returned as it is."""
    if isinstance(stock, SundaeDatamanagerConfig):
        return stock
    full = cast(FullImageDatamanagerConfig, stock)
    options = {known.name: getattr(full, known.name) for known in fields(FullImageDatamanagerConfig) if known.init}
    options.pop("_target")
    options["train_cameras_sampling_strategy"] = "random"
    return SundaeDatamanagerConfig(**options)
