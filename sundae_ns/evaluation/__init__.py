"""Measuring: image metrics in named variants, synchronised times, comparisons, tables, and records of runs. Floor 2."""

from sundae_ns.evaluation import display
from sundae_ns.evaluation.flicker import Change, Frame, change
from sundae_ns.evaluation.flip import flip, flip_available
from sundae_ns.evaluation.lpips import Lpips, lpips_weights_available, lpips_weights_path, lpips_weights_url
from sundae_ns.evaluation.measured import HEAD_OFF, HEAD_ON, Configuration, Measured, ViewQuality, without_nan
from sundae_ns.evaluation.memory import peak_memory
from sundae_ns.evaluation.metrics import psnr, ssim
from sundae_ns.evaluation.picture import ComparisonRow, comparison_sheet, save_comparison, side_by_side
from sundae_ns.evaluation.points import (
    Look,
    draw_points,
    look_along_axes,
    look_through,
    points_sheet,
    response_histogram,
)
from sundae_ns.evaluation.records import COLUMNS, RunRow, append_row, read_rows
from sundae_ns.evaluation.report import Quality, RunFigures, report_tables, report_text
from sundae_ns.evaluation.timing import Timing, median_ms

__all__ = [
    "COLUMNS",
    "HEAD_OFF",
    "HEAD_ON",
    "Change",
    "ComparisonRow",
    "Configuration",
    "Frame",
    "Look",
    "Lpips",
    "Measured",
    "Quality",
    "RunFigures",
    "RunRow",
    "Timing",
    "ViewQuality",
    "append_row",
    "change",
    "comparison_sheet",
    "display",
    "draw_points",
    "flip",
    "flip_available",
    "look_along_axes",
    "look_through",
    "lpips_weights_available",
    "lpips_weights_path",
    "lpips_weights_url",
    "median_ms",
    "peak_memory",
    "points_sheet",
    "psnr",
    "read_rows",
    "report_tables",
    "report_text",
    "response_histogram",
    "save_comparison",
    "side_by_side",
    "ssim",
    "without_nan",
]
