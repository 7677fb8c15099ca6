"""Which parser reads a capture."""

from __future__ import annotations

from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParser
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio

from sundae_ns.parsing.colmap import CarefulColmapParser, RobustColmapParser
from sundae_ns.parsing.nerfstudio import LightNerfstudioParser, RobustNerfstudioParser

_OURS = {
    Nerfstudio: (LightNerfstudioParser, RobustNerfstudioParser),
    ColmapDataParser: (CarefulColmapParser, RobustColmapParser),
}


def set_parser(config: DataParserConfig, robust: bool) -> None:
    """Let our parser read a capture in place of nerfstudio's; other parsers stay.

    Args:
        config: of the parser, changed in place.
        robust: see :class:`sundae_ns.parsing.placing.Placing`.
    """
    for theirs, ours in _OURS.items():
        if config._target in (theirs, *ours):
            config._target = ours[robust]
