"""Image metrics in named variants, synchronised timing, comparison images, plots and tables."""

from sundae_ns.evaluation import display
from sundae_ns.evaluation.comparison_image import ComparisonRow, comparison_sheet, save_comparison
from sundae_ns.evaluation.flip import flip, flip_available
from sundae_ns.evaluation.lpips import Lpips, lpips_weights_available, lpips_weights_path, lpips_weights_url
from sundae_ns.evaluation.measured import HEAD_OFF, HEAD_ON, Configuration, Measured, ViewQuality, without_nan
from sundae_ns.evaluation.memory import peak_memory
from sundae_ns.evaluation.metrics import psnr, ssim
from sundae_ns.evaluation.points import (
    Projection,
    draw_points,
    points_sheet,
    project_along_axes,
    project_through_camera,
    response_histogram,
)
from sundae_ns.evaluation.records import COLUMNS, csv_text
from sundae_ns.evaluation.report import report_text
from sundae_ns.evaluation.timing import median_ms

__all__ = [
    "COLUMNS",
    "HEAD_OFF",
    "HEAD_ON",
    "ComparisonRow",
    "Configuration",
    "Lpips",
    "Measured",
    "Projection",
    "ViewQuality",
    "comparison_sheet",
    "csv_text",
    "display",
    "draw_points",
    "flip",
    "flip_available",
    "lpips_weights_available",
    "lpips_weights_path",
    "lpips_weights_url",
    "median_ms",
    "peak_memory",
    "points_sheet",
    "project_along_axes",
    "project_through_camera",
    "psnr",
    "report_text",
    "response_histogram",
    "save_comparison",
    "ssim",
    "without_nan",
]
