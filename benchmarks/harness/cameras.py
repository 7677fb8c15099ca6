"""Training cameras of a run, without opening the run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

from sundae_ns.errors import DataError, SundaeError
from sundae_ns.parsing import check_capture, set_parser
from sundae_ns.storage.config_file import load_config


def training_cameras(config: Path) -> Cameras:
    """Training cameras of a run in the coordinates of its field, on the CPU.

    Args:
        config: ``config.yml`` of a run on a capture in nerfstudio's or COLMAP's layout. No code of it runs.

    Raises:
        CheckpointError: the file is not a run's configuration.
        DataError: the capture is missing, has another layout, or cannot be used.
    """
    loaded: Any = load_config(config)
    manager = getattr(getattr(loaded, "pipeline", None), "datamanager", None)
    parser = getattr(manager, "dataparser", None)
    if not isinstance(parser, (ColmapDataParserConfig, NerfstudioDataParserConfig)):
        raise DataError("the capture of the run is in another layout than nerfstudio-data and colmap")
    places = (getattr(manager, "data", None), loaded.data, parser.data)
    data = next((place for place in places if isinstance(place, Path) and place != Path()), None)
    if data is None:
        raise DataError("the run does not say where its capture is")
    set_parser(parser, getattr(manager, "robust_frame", False))
    parser.data, parser.load_3D_points = data, False
    try:
        check_capture(parser, data, ("train",), images=False)
        cameras: Cameras = parser.setup().get_dataparser_outputs(split="train").cameras
    except SundaeError:
        raise
    except (Exception, EOFError) as error:  # parsers raise many kinds, assertions too; each means the same to the user
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise DataError(f"{data} cannot be parsed ({reason})") from error
    if len(cameras) == 0:
        raise DataError(f"{data} has no training views")
    return cameras
