"""Times the head three ways: our fused kernels, torch.compile, and cuDNN alone, each also as one CUDA graph.

    PYTHONPATH=. python lab/head_compile.py [--out FILE.csv]

A row per way, direction, image size and number of features: median milliseconds of 50 synchronised runs, the seconds
that the first run took, and the largest error against the network in fp32 (of the image, or of the gradients of the
weights as a share of the largest one).
"""

from __future__ import annotations

import argparse
import csv
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from sundae_ns.compensation import CompensationHead, HeadConfig, UNet
from sundae_ns.gpu.cuda_graphs import record, warm_up

SIZES = ((533, 800), (824, 1240))
FEATURES = (13, 29)
REPEATS = 50
DEVICE = torch.device("cuda", 0)


def unet(net: UNet, image: Tensor) -> Tensor:
    """``UNet.forward`` without its hook for CPUs, which a compiler would have to break at."""
    height, width = image.shape[-2:]
    stride = net.pixel_unshuffle * 2 ** (len(net.encoder) - 1)
    x = F.pad(image, (0, -width % stride, 0, -height % stride))
    x = F.pixel_unshuffle(x, net.pixel_unshuffle).contiguous(memory_format=torch.channels_last)
    skips = []
    for level, block in enumerate(net.encoder):
        x = block(x if level == 0 else F.avg_pool2d(x, 2))
        skips.append(x)
    skips.pop()
    for block in net.decoder:
        x = F.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)
        x = block(torch.cat([x, skips.pop()], dim=1))
    return F.pixel_shuffle(net.out(x), net.pixel_unshuffle)[..., :height, :width]


def layered(net: UNet, dtype: torch.dtype) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
    """The residual head, layer by layer."""

    def run(base: Tensor, splatted: Tensor, alpha: Tensor) -> Tensor:
        image = torch.cat([splatted[..., :3], alpha, splatted[..., 3:]], dim=-1).permute(2, 0, 1)[None]
        # Within a CUDA graph the cast weights must not be cached from an earlier pass.
        with torch.autocast("cuda", dtype=dtype, enabled=dtype != torch.float32, cache_enabled=False):
            out = unet(net, image.to(dtype))
        return base + alpha * out[0].permute(1, 2, 0).float()

    return run


@contextmanager
def exact() -> Iterator[None]:
    """Without TF32, for the reference."""
    before = torch.backends.cudnn.allow_tf32, torch.backends.cuda.matmul.allow_tf32
    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = False
    yield
    torch.backends.cudnn.allow_tf32, torch.backends.cuda.matmul.allow_tf32 = before


class Case:
    """Images of one size, and a head with weights that correct them."""

    def __init__(self, height: int, width: int, features: int) -> None:
        torch.manual_seed(0)
        self.head = CompensationHead(HeadConfig(mode="residual", num_features=features)).to(DEVICE)
        torch.nn.init.normal_(self.head.net.out.weight, std=0.05)  # starts at 0 otherwise
        self.base = torch.rand(height, width, 3, device=DEVICE)
        self.splatted = torch.rand(height, width, 3 + features, device=DEVICE, requires_grad=True)
        self.alpha = torch.rand(height, width, 1, device=DEVICE, requires_grad=True)
        self.gradient = torch.randn(height, width, 3, device=DEVICE)
        self.leaves = (self.splatted, self.alpha, *self.head.net.parameters())

    def infer(self, head: Callable[[Tensor, Tensor, Tensor], Tensor]) -> list[Tensor]:
        """The image."""
        with torch.no_grad():
            return [head(self.base, self.splatted.detach(), self.alpha.detach())]

    def train(self, head: Callable[[Tensor, Tensor, Tensor], Tensor]) -> list[Tensor]:
        """The gradients of splatted values, accumulation and weights."""
        out = head(self.base, self.splatted, self.alpha)
        return list(torch.autograd.grad(out, self.leaves, self.gradient))


def captured(run: Callable[[], list[Tensor]]) -> Callable[[], list[Tensor]]:
    """The same work as one CUDA graph."""
    for _ in range(3):
        with warm_up(DEVICE):
            run()
    graph, result = record(run, DEVICE)

    def replay() -> list[Tensor]:
        graph.replay()
        return result

    return replay


def median_ms(run: Callable[[], object]) -> float:
    """Median of synchronised runs, after ten that are not counted."""
    for _ in range(10):
        run()
    times = []
    for _ in range(REPEATS):
        start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        torch.cuda.synchronize()
        start.record()
        run()
        end.record()
        torch.cuda.synchronize()
        times.append(start.elapsed_time(end))
    return statistics.median(times)


def error(values: list[Tensor], reference: list[Tensor], training: bool) -> float:
    """Largest difference of the image, or of the weights' gradients as a share of the largest value of each."""
    pairs = list(zip(values, reference, strict=True))[2 if training else 0 :]
    scales = [float(right.abs().max()) if training else 1.0 for _, right in pairs]
    return max(float((left - right).abs().max()) / scale for (left, right), scale in zip(pairs, scales, strict=True))


def measure(height: int, width: int, features: int, training: bool) -> Iterator[tuple[str, float, float, float] | str]:
    """A row for each way: name, ms, seconds of the first run, error; or the name and the message of one that failed."""
    case = Case(height, width, features)
    do = case.train if training else case.infer
    with exact():
        reference = [value.clone() for value in do(layered(case.head.net, torch.float32))]
    plain = layered(case.head.net, torch.bfloat16)
    compiled = torch.compile(plain, mode="max-autotune-no-cudagraphs", dynamic=False)
    ways = {
        "fused": lambda: lambda: do(case.head),
        "fused, graph": lambda: captured(lambda: do(case.head)),
        "compile": lambda: lambda: do(compiled),
        "compile, graph": lambda: captured(lambda: do(compiled)),
        "cudnn": lambda: lambda: do(plain),
        "cudnn, graph": lambda: captured(lambda: do(plain)),
    }
    for name, make in ways.items():
        try:
            begun = time.perf_counter()
            run = make()
            result = run()
            torch.cuda.synchronize()
            first = time.perf_counter() - begun
            ms = median_ms(run)
            yield name, ms, first, error([value.clone() for value in result], reference, training)
        except Exception as failure:
            torch.cuda.synchronize()
            yield f"{name}: {type(failure).__name__}: {' '.join(str(failure).split())[:300]}"


def main() -> int:
    """Print a CSV, and write it to ``--out``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path)
    out = parser.parse_args().out
    torch.backends.cudnn.benchmark = True
    rows = [("gpu", "torch", "way", "direction", "height", "width", "features", "ms", "first_s", "error")]
    gpu = torch.cuda.get_device_name(DEVICE)
    writer = csv.writer(sys.stdout)
    writer.writerow(rows[0])
    for height, width in SIZES:
        for features in FEATURES:
            for training in (False, True):
                torch._dynamo.reset()
                torch.cuda.empty_cache()
                direction = "training" if training else "frame"
                for line in measure(height, width, features, training):
                    if isinstance(line, str):
                        print(f"# {direction} {height}x{width} {features}: {line}", flush=True)
                        continue
                    name, ms, first, wrong = line
                    row = (gpu, torch.__version__, name, direction, height, width, features)
                    rows.append((*map(str, row), f"{ms:.3f}", f"{first:.1f}", f"{wrong:.2g}"))  # type: ignore[arg-type]
                    writer.writerow(rows[-1])
                    sys.stdout.flush()
    if out is not None:
        with out.open("w", newline="") as file:
            csv.writer(file).writerows(rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
