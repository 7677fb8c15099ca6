"""Time the reference rasteriser; print one JSON line.

Times are medians over the repeats, in milliseconds. The errors are norms of the difference between float32 and float64
over the norm in float64: of the image, and the worst one among the gradients.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable

import torch
from torch import Tensor

from sundae_ns.rasterization import Rasterization, rasterize, select_backend


def make_scene(count: int, channels: int, dtype: torch.dtype) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    scene = {
        "means": (uniform(count, 3) - 0.5) * 2 + torch.tensor([0.0, 0.0, 3.0]),
        "quats": torch.randn(count, 4, generator=generator, dtype=torch.float64),
        "scales": 0.01 + 0.04 * uniform(count, 3),
        "opacities": uniform(count),
        "colors": uniform(count, channels),
    }
    return {name: value.to(dtype).requires_grad_() for name, value in scene.items()}


def render(scene: dict[str, Tensor], size: int) -> Rasterization:
    dtype = scene["means"].dtype
    K = torch.tensor([[1.2 * size, 0, size / 2], [0, 1.2 * size, size / 2], [0, 0, 1]], dtype=dtype)
    viewmat = torch.eye(4, dtype=dtype)
    return rasterize(**scene, viewmat=viewmat, K=K, width=size, height=size, backend=select_backend("reference", "cpu"))


def render_backward(scene: dict[str, Tensor], size: int) -> Rasterization:
    for value in scene.values():
        value.grad = None
    rendered = render(scene, size)
    (rendered.colors.square().sum() + rendered.alpha.sum()).backward()
    return rendered


def median_ms(function: Callable[[], object], repeats: int) -> float:
    for _ in range(3):
        function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return round(statistics.median(times) * 1e3, 2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=5000, help="primitives")
    parser.add_argument("--size", type=int, default=128, help="side of the image in pixels")
    parser.add_argument("--channels", type=int, default=16)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--repeats", type=int, default=20)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)

    single = make_scene(arguments.count, arguments.channels, torch.float32)
    # Rounded to float32 first, so that the errors are those of the arithmetic and not of the input.
    double = {name: value.detach().double().requires_grad_() for name, value in single.items()}
    image, exact = render_backward(single, arguments.size).colors, render_backward(double, arguments.size).colors
    grad_errors = [((single[k].grad - double[k].grad).norm() / double[k].grad.norm()).item() for k in single]
    image_error = ((image - exact).norm() / exact.norm()).item()
    with torch.no_grad():
        forward_ms = median_ms(lambda: render(single, arguments.size), arguments.repeats)
    result = {
        "benchmark": "rasterization",
        "backend": "reference",
        "forward_ms": forward_ms,
        "forward_backward_ms": median_ms(lambda: render_backward(single, arguments.size), arguments.repeats),
        "N": arguments.count,
        "size": arguments.size,
        "channels": arguments.channels,
        "threads": arguments.threads,
        "image_error": float(f"{image_error:.2e}"),
        "gradient_error": float(f"{max(grad_errors):.2e}"),
        "torch": torch.__version__,
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
