"""Image metrics in named variants, synchronised timing, comparison images, plots and tables."""

from sundae_ns.evaluation import display
from sundae_ns.evaluation.comparison_image import ComparisonRow, comparison_sheet
from sundae_ns.evaluation.document import COLUMNS, csv_text, report_text
from sundae_ns.evaluation.lpips import Lpips, lpips_weights_available, lpips_weights_path, lpips_weights_url
from sundae_ns.evaluation.measured import HEAD_OFF, HEAD_ON, Configuration, Measured, ViewQuality, without_nan
from sundae_ns.evaluation.metrics import fitted_psnr, flip, flip_available, psnr, ssim
from sundae_ns.evaluation.quality import quality_of
from sundae_ns.evaluation.timing import median_ms, peak_memory

__all__ = [
    "COLUMNS",
    "HEAD_OFF",
    "HEAD_ON",
    "ComparisonRow",
    "Configuration",
    "Lpips",
    "Measured",
    "ViewQuality",
    "comparison_sheet",
    "csv_text",
    "display",
    "fitted_psnr",
    "flip",
    "flip_available",
    "lpips_weights_available",
    "lpips_weights_path",
    "lpips_weights_url",
    "median_ms",
    "peak_memory",
    "psnr",
    "quality_of",
    "report_text",
    "ssim",
    "without_nan",
]
