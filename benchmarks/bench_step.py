"""Time training steps, or a part alone: loss, heads, rasterisers; print one JSON line for each row.

    python benchmarks/bench_step.py                            # sundae-tiny on a CPU, 128 x 128, 5,000 Gaussians
    python benchmarks/bench_step.py --primitives 20000 --size 256 --device cuda
    python benchmarks/bench_step.py loss --device cuda         # fused kernels and convolutions, with their errors
    python benchmarks/bench_step.py heads                      # on CUDA, each head as one CUDA graph
    python benchmarks/bench_step.py rasterizers --primitives 100000 --size 640

A step is render, head, losses, backward pass and optimizers. Times are medians in milliseconds, device waited for.
Errors of a loss are distances from the convolutions in float64; the gradient's is relative to its norm. Of the heads,
``ms_HxW`` is a frame in bf16 as the model runs it, ``ms_train_HxW`` forward and backward with fp32 weights;
``layers`` is the network layer by layer, without the kernels. Errors of a rasteriser are distances from float64;
gradients' are relative, the worst of all inputs.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator
from copy import deepcopy
from functools import partial
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.engine.optimizers import Optimizers
from pytorch_msssim import SSIM
from torch import Tensor

from sundae_ns.core.camera import Camera
from sundae_ns.core.timing import median_ms
from sundae_ns.cuda.cuda_graphs import record, warm_up
from sundae_ns.head.head import CompensationHead, HeadConfig
from sundae_ns.method_configs import sundae_tiny
from sundae_ns.rasterize.interface import BackendName, rasterize, select_backend
from sundae_ns.rasterize.types import Inputs
from sundae_ns.train import step

SIZES = ((533, 800), (824, 1240), (1893, 1061))
"""Height and width of the images of the loss and of the heads, pixels."""
SSIM_WEIGHT = 0.2
HEADS = (
    HeadConfig(size="tiny"),
    HeadConfig(size="compact"),
    HeadConfig(size="wide"),
    HeadConfig(size="regular", pixel_unshuffle=1),  # the paper's
)


def steps(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A step of ``sundae-tiny`` with its head and without."""
    torch.manual_seed(0)
    config = deepcopy(sundae_tiny.config)
    # Points in a ball that fills the image, as in the demo's scene.
    points = torch.nn.functional.normalize(torch.randn(options.primitives, 3), dim=1)
    points *= torch.rand(options.primitives, 1) ** (1 / 3)
    colors = torch.randint(0, 256, points.shape)
    model = config.pipeline.model.setup(
        scene_box=SceneBox(torch.tensor([[-1.0, -1, -1], [1, 1, 1]])),
        num_train_data=1,
        seed_points=(points, colors),
        device=options.device,
    ).to(options.device)
    model.train()
    optimizers = Optimizers(config.optimizers, model.get_param_groups())
    pose = torch.eye(4)[None, :3].clone()
    pose[0, 2, 3] = 2.5
    size, focal = options.size, float(options.size)
    camera = Cameras(pose, focal, focal, size / 2, size / 2, size, size).to(options.device)
    batch = {"image": torch.rand(size, size, 3, device=options.device)}
    # A step between the prune and the end.
    model.step = config.max_num_iterations

    def step() -> None:
        optimizers.zero_grad_all()
        outputs = model(camera)
        values = model.get_loss_dict(outputs, batch, model.get_metrics_dict(outputs, batch))
        torch.stack(list(values.values())).sum().backward()
        optimizers.optimizer_step_all()

    with_head = median_ms(step, device=options.device, repeats=options.repeats)
    model.state.head_starts_at = 2 * config.max_num_iterations
    without = median_ms(step, device=options.device, repeats=options.repeats)
    yield {
        "primitives": options.primitives,
        "size": size,
        "backend": model.backend.name,
        "features": model.config.num_features,
        "ms_step_with_head": round(with_head, 1),
        "ms_step_without_head": round(without, 1),
    }


def loss(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """The loss of an image and its gradient: by the fused kernels on CUDA, and by convolutions."""

    def convolved(dtype: torch.dtype) -> Callable[[Tensor, Tensor], Tensor]:
        ssim = SSIM(data_range=1.0, channel=3)
        ssim.win = ssim.win.to(options.device, dtype)  # no buffer: moving the module would leave it

        def loss(image: Tensor, target: Tensor) -> Tensor:
            difference = (image - target).abs().mean()
            return (1 - SSIM_WEIGHT) * difference + SSIM_WEIGHT * step.convolved_ssim_loss(image, target, ssim)

        return loss

    def graded(way: Callable[[Tensor, Tensor], Tensor], image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        leaf = image.detach().requires_grad_()
        value = way(leaf, target)
        return value.detach(), torch.autograd.grad(value, leaf)[0]

    ways = {"convolutions": convolved(torch.float32)}
    if options.device == "cuda":
        ways["fused"] = lambda image, target: step.fused_loss(image, target, SSIM_WEIGHT)[0]
    for height, width in SIZES:
        torch.manual_seed(0)
        target = torch.rand(height, width, 3, device=options.device)
        image = (target + 0.1 * torch.randn_like(target)).clamp(0, 1)
        exact, slope = graded(convolved(torch.float64), image.double(), target.double())
        for name, way in ways.items():
            value, gradient = graded(way, image, target)
            timing = median_ms(partial(graded, way, image, target), device=options.device, repeats=options.repeats)
            yield {
                "way": name,
                "height": height,
                "width": width,
                "ms": round(timing, 3),
                "loss_error": abs(float(value) - float(exact)),
                "gradient_rel_error": float((gradient - slope).norm() / slope.norm()),
            }


def heads(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Each head alone, in inference and in training."""
    for config in HEADS:
        line: dict[str, Any] = {name: getattr(config, name) for name in ("size", "num_features", "pixel_unshuffle")}
        line["parameters"] = sum(p.numel() for p in CompensationHead(config).parameters())
        for height, width in SIZES:
            line |= {f"{name}_{height}x{width}": round(ms, 3) for name, ms in _head_ms(config, height, width).items()}
        yield line


def _head_ms(config: HeadConfig, height: int, width: int) -> dict[str, float]:
    """Milliseconds of one head on images of one size."""
    splat = torch.rand(height, width, 3 + config.num_features, device="cuda")
    base, alpha = torch.rand_like(splat[..., :3]), torch.rand_like(splat[..., :1])
    # [H, W, C] as splatted, seen as [1, C, H, W].
    inputs = torch.rand(1, height, width, config.num_features + 4, device="cuda").bfloat16().permute(0, 3, 1, 2)
    net = CompensationHead(config).net.cuda().bfloat16()
    head = CompensationHead(config).cuda().eval()
    with torch.no_grad():
        with warm_up(inputs.device):
            for _ in range(3):
                net(inputs)
        graph = record(lambda: net(inputs), inputs.device)[0]
        found = {"ms_layers": median_ms(graph.replay, device=inputs.device)}
        found["ms"] = median_ms(partial(head, base, splat, alpha), device=inputs.device, warmup=10)
    leaves = [image.clone().requires_grad_() for image in (splat, alpha)]
    for name, fused in (("ms_train", True), ("ms_train_layers", False)):
        trained = CompensationHead(config).cuda()
        trained._can_fuse = fused

        def step(trained: CompensationHead = trained) -> None:
            out = trained(base, *leaves)
            out.backward(torch.ones_like(out))

        found[name] = median_ms(step, device=inputs.device)
    return found


def rasterizers(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """The rasterisers of the device on a random view of 16 channels, Gaussians of one to three pixels."""
    n, size, g = options.primitives, options.size, torch.Generator().manual_seed(0)
    depth = 2 + 2 * torch.rand(n, 1, generator=g)
    screen = size * (torch.rand(n, 2, generator=g) - 0.5)
    scene = (
        torch.cat([screen * depth / size, depth], dim=1),
        torch.randn(n, 4, generator=g),
        2 * depth / size * (0.5 + torch.rand(n, 3, generator=g)),
        torch.rand(n, generator=g),
        torch.rand(n, 16, generator=g),
    )
    camera = (torch.eye(4), torch.tensor([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1.0]]))
    weights = torch.randn(size, size, 16, generator=g)

    def draw(name: BackendName, device: str, dtype: torch.dtype, gradients: bool = True) -> list[Tensor]:
        leaves = [value.to(device, dtype).requires_grad_(gradients) for value in scene]
        viewmat, K = (value.to(device, dtype) for value in camera)
        means, quats, scales, opacities, colors = leaves
        backend = select_backend(name, device)
        inputs = Inputs(means, quats, scales, opacities, colors, Camera(viewmat, K, size, size, float(size)))
        drawn = rasterize(inputs, backend=backend)
        if not gradients:
            return [drawn.colors]
        return [drawn.colors.detach(), *torch.autograd.grad(drawn.colors, leaves, weights.to(device, dtype))]

    oracle = draw("reference", "cpu", torch.float64)
    names: tuple[BackendName, ...] = ("gsplat", "reference") if options.device == "cuda" else ("cpu", "reference")
    for name in names:
        image, *gradients = (value.cpu() for value in draw(name, options.device, torch.float32))
        ways = {False: "ms_forward", True: "ms_forward_and_backward"}
        times = {
            text: median_ms(
                partial(draw, name, options.device, torch.float32, way), device=options.device, repeats=options.repeats
            )
            for way, text in ways.items()
        }
        errors = [float((a - b).norm() / b.norm()) for a, b in zip(gradients, oracle[1:], strict=True)]
        yield {
            "rasterizer": name,
            "primitives": n,
            "size": size,
            **{text: round(ms, 2) for text, ms in times.items()},
            "max_error": float((image - oracle[0]).abs().max()),
            "gradient_error": max(errors),
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = {"steps": steps, "loss": loss, "heads": heads, "rasterizers": rasterizers}
    parser.add_argument("part", nargs="?", choices=parts, default="steps")
    parser.add_argument("--primitives", type=int, default=5000, help="of a step or view")
    parser.add_argument("--size", type=int, default=128, help="side of the image of a step or view, pixels")
    parser.add_argument("--device", choices=("cpu", "cuda"), help="default: cpu; heads: cuda")
    parser.add_argument("--repeats", type=int, default=30, help="timed runs; their median counts")
    options = parser.parse_args()
    options.device = options.device or ("cuda" if options.part == "heads" else "cpu")
    if options.device == "cuda" and not torch.cuda.is_available():
        parser.error("there is no CUDA device here; sundae doctor says more")
    if options.part == "heads" and options.device != "cuda":
        parser.error("heads are timed on CUDA; leave --device out")
    device = torch.cuda.get_device_name() if options.device == "cuda" else f"CPU, {torch.get_num_threads()} threads"
    for line in parts[options.part](options):
        print(json.dumps({**line, "device": device}), flush=True)


if __name__ == "__main__":
    main()
