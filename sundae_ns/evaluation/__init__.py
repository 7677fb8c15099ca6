"""Image metrics in named variants, synchronised timing, the table of measured runs, and its web page."""

from sundae_ns.evaluation import display
from sundae_ns.evaluation.measured import COLUMNS, HEAD_OFF, HEAD_ON, Configuration, Measured, csv_text, without_nan
from sundae_ns.evaluation.metrics import (
    Lpips,
    ViewQuality,
    fitted_psnr,
    flip,
    flip_available,
    lpips_weights,
    psnr,
    quality_of,
    ssim,
)
from sundae_ns.evaluation.timing import median_ms, peak_memory

__all__ = [
    "COLUMNS",
    "HEAD_OFF",
    "HEAD_ON",
    "Configuration",
    "Lpips",
    "Measured",
    "ViewQuality",
    "csv_text",
    "display",
    "fitted_psnr",
    "flip",
    "flip_available",
    "lpips_weights",
    "median_ms",
    "peak_memory",
    "psnr",
    "quality_of",
    "ssim",
    "without_nan",
]
