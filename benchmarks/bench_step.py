"""Time a training step of ``sundae-tiny`` with its head; print one JSON line.

    python benchmarks/bench_step.py                       # 128 x 128, 5,000 primitives
    python benchmarks/bench_step.py --primitives 20000 --size 256 --device cuda

The step is the whole of it: render, head, losses, backward pass, optimizers. The times are medians, device waited for.
"""

from __future__ import annotations

import argparse
import json
from copy import deepcopy

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.engine.optimizers import Optimizers

from sundae_ns.evaluation import median_ms
from sundae_ns.method_configs import sundae_tiny


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--primitives", type=int, default=5000)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--repeats", type=int, default=30)
    options = parser.parse_args()

    torch.manual_seed(0)
    config = deepcopy(sundae_tiny.config)
    # Points in a ball that fills the picture, as the demo's scene does.
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
        losses = model.get_loss_dict(outputs, batch, model.get_metrics_dict(outputs, batch))
        torch.stack(list(losses.values())).sum().backward()
        optimizers.optimizer_step_all()

    times = {"with_head": median_ms(step, device=options.device, repeats=options.repeats)}
    model.config.head.start_at = 2 * config.max_num_iterations
    times["without"] = median_ms(step, device=options.device, repeats=options.repeats)
    result = {
        "primitives": options.primitives,
        "size": size,
        "device": options.device,
        "backend": model.backend.name,
        "threads": torch.get_num_threads(),
        "features": model.num_features,
        "ms_step_with_head": round(times["with_head"].median_ms, 1),
        "ms_step_without_head": round(times["without"].median_ms, 1),
        "ms_step_with_head_p90": round(times["with_head"].p90_ms, 1),
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
