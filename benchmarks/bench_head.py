"""Time the heads alone on CUDA, each as one CUDA graph; append a JSON line for each to results/heads.jsonl.

    python benchmarks/bench_head.py [--results FILE]

Inference: ``ms_HxW`` is the whole head in fp16 as the model runs it, from splatted fp32 pictures to the compensated one;
``ms_layers_HxW`` the network alone, layer by layer, weights and picture in fp16. Training: forward and backward in bf16 with
fp32 weights, as ``ns-train`` runs it, and layer by layer.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import run
import torch

from sundae_ns.compensation import CompensationHead, HeadConfig
from sundae_ns.evaluation import median_ms
from sundae_ns.gpu.cuda_graphs import aside, record

RESULTS = Path(__file__).parent / "results" / "heads.jsonl"
HEADS = (
    HeadConfig(size="tiny"),
    HeadConfig(size="compact", num_features=5),
    HeadConfig(size="compact"),
    HeadConfig(size="wide"),
    HeadConfig(size="small", num_features=5),
    HeadConfig(size="small"),
    HeadConfig(size="compact", pixel_unshuffle=4),
    *(HeadConfig(size=size, pixel_unshuffle=1) for size in ("small", "regular", "large")),  # the paper's
)
PICTURES = ((824, 1240), (1893, 1061), (533, 800))


def recorded(net: torch.nn.Module, picture: torch.Tensor) -> torch.cuda.CUDAGraph:
    with aside(picture.device):
        for _ in range(3):
            net(picture)
    return record(lambda: net(picture), picture.device)[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args()
    if not torch.cuda.is_available():
        parser.error("there is no CUDA device to time the heads on; sundae doctor says more")
    for config in HEADS:
        channels = config.num_features + 4
        line: dict[str, object] = {
            "size": config.size,
            "num_features": config.num_features,
            "pixel_unshuffle": config.pixel_unshuffle,
            "gpu": torch.cuda.get_device_name(0),
        }
        for height, width in PICTURES:
            half = CompensationHead(config).net.cuda().half()
            # [H, W, C] as splatted, seen as [1, C, H, W].
            picture = torch.rand(1, height, width, channels, device="cuda").half().permute(0, 3, 1, 2)
            with torch.no_grad():
                graph = recorded(half, picture)
            line[f"ms_layers_{height}x{width}"] = median_ms(graph.replay, device=picture.device).median_ms
            head = CompensationHead(replace(config, precision="fp16")).cuda().eval()
            splat = torch.rand(height, width, 3 + config.num_features, device="cuda")
            pictures = torch.rand_like(splat[..., :3]), splat, torch.rand_like(splat[..., :1])
            with torch.no_grad():
                whole = median_ms(partial(head, *pictures), device=picture.device, warmup=10)
            line[f"ms_{height}x{width}"] = whole.median_ms
            leaves = [picture.clone().requires_grad_() for picture in (splat, pictures[2])]
            for fused in (True, False):
                trained = CompensationHead(replace(config, fused=fused)).cuda()

                def step(trained: CompensationHead = trained) -> None:
                    out = trained(pictures[0], *leaves)  # noqa: B023
                    out.backward(torch.ones_like(out))

                name = "train" if fused else "train_layers"
                line[f"ms_{name}_{height}x{width}"] = median_ms(step, device=picture.device).median_ms
            line["parameters"] = sum(p.numel() for p in head.parameters())
        print(json.dumps(line))
        run.append_line(options.results, line)


if __name__ == "__main__":
    main()
