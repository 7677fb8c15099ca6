"""Time the loss of a picture and its gradient beside their errors; append a JSON line for each way to results/loss.jsonl.

    python benchmarks/bench_loss.py [--results FILE] [--sizes 533x800 1893x1061]

Ways: the kernels of ``sundae_ns.gpu.fused_loss`` where there is CUDA, and L1 with pytorch_msssim's SSIM. Times are medians of
forward and backward, the device waited for; errors are distances from the convolutions in float64, the gradient's in
proportion to its own norm.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import run
import torch
from pytorch_msssim import SSIM
from torch import Tensor

from sundae_ns.evaluation import median_ms
from sundae_ns.training import losses

RESULTS = Path(__file__).parent / "results" / "loss.jsonl"
WEIGHT = 0.2


def by_convolutions(ssim: SSIM) -> Callable[[Tensor, Tensor], Tensor]:
    """As a GPU without the kernels does it."""
    return lambda p, t: losses.convolved_loss(p, t, ssim, WEIGHT)


def ssim_in(dtype: torch.dtype, device: str) -> SSIM:
    """With its window there, which moving a module leaves where it was."""
    ssim = SSIM(data_range=1.0, channel=3)
    ssim.win = ssim.win.to(device, dtype)
    return ssim


def graded(loss: Callable[[Tensor, Tensor], Tensor], picture: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    leaf = picture.detach().requires_grad_()
    value = loss(leaf, target)
    return value.detach(), torch.autograd.grad(value, leaf)[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sizes", nargs="+", default=["533x800", "824x1240", "1893x1061"], help="HEIGHTxWIDTH, pixels")
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args()
    device = "cuda" if torch.cuda.is_available() else "cpu"
    ways = {"convolutions": by_convolutions(ssim_in(torch.float32, device))}
    if device == "cuda":
        ways = {"fused": lambda p, t: losses.fused_loss(p, t, WEIGHT)[0], **ways}
    oracle = by_convolutions(ssim_in(torch.float64, device))
    for size in options.sizes:
        height, width = (int(side) for side in size.split("x"))
        torch.manual_seed(0)
        target = torch.rand(height, width, 3, device=device)
        picture = (target + 0.1 * torch.randn_like(target)).clamp(0, 1)
        exact, slope = graded(oracle, picture.double(), target.double())
        for name, way in ways.items():
            value, gradient = graded(way, picture, target)
            timing = median_ms(lambda way=way, p=picture, t=target: graded(way, p, t), device=device)
            line = {
                "way": name,
                "height": height,
                "width": width,
                "ms": round(timing.median_ms, 3),
                "loss_error": abs(float(value) - float(exact)),
                "gradient_rel_error": float((gradient - slope).norm() / slope.norm()),
                "device": torch.cuda.get_device_name(0) if device == "cuda" else "cpu",
                "commit": run.commit(),
            }
            print(json.dumps(line))
            run.append_line(options.results, line)


if __name__ == "__main__":
    main()
