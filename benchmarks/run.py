"""Train one configuration on one capture, measure it, and append a row to ``results/runs.csv``.

    python benchmarks/run.py sundae --scene bonsai --data ../shared/scenes/bonsai
    python benchmarks/run.py splatfacto --scene bonsai --data ../shared/scenes/bonsai
    python benchmarks/run.py sundae --scene bonsai --data ... --variant no-head -- --pipeline.model.head.mode off

Everything after ``--`` goes to ``ns-train``'s own parser, so a row's command is one that a user could type. Every figure
comes from the run itself: times are synchronised, and evaluation during training is switched off for all methods alike.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import torch
import tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.scripts.train import _set_random_seed

from sundae_ns.evaluation import RunRow, append_row, median_ms, psnr, ssim
from sundae_ns.evaluation.records import wait_for_lock
from sundae_ns.evaluation.timing import now
from sundae_ns.model import SundaeModel
from sundae_ns.scenes.measure import frame_times, revision, sizes
from sundae_ns.storage import Sizes, bytes_of

RESULTS = Path(__file__).parent / "results" / "runs.csv"
NEVER = 10**9


class NoLpips(torch.nn.Module):
    """Stands in for LPIPS in stock splatfacto, which downloads weights in its constructor and then computes no zero."""

    def __init__(self, **_: Any) -> None:
        super().__init__()

    def forward(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return torch.tensor(float("nan"))


def parse() -> tuple[argparse.Namespace, list[str]]:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("method")
    parser.add_argument("--scene", required=True)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--variant", default="default")
    parser.add_argument("--seed", type=int, default=42)
    parser.add_argument("--steps", type=int, help="length of the run, in place of the method's own")
    parser.add_argument("--out", type=Path, default=Path("outputs/benchmarks"))
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--save", action="store_true", help="keep the final checkpoint, and config.yml for other tools")
    parser.add_argument("--save-pruned", action="store_true", help="keep the checkpoint right after the prune")
    parser.add_argument("--save-warm", action="store_true", help="keep the checkpoint right before the prune")
    own, extra = sys.argv[1:], []
    if "--" in own:
        cut = own.index("--")
        own, extra = own[:cut], own[cut + 1 :]
    return parser.parse_args(own), extra


def configure(options: argparse.Namespace, extra: list[str]) -> tuple[TrainerConfig, str]:
    """The method's configuration as ``ns-train`` would parse it, and that command."""
    arguments = [options.method, "--data", str(options.data), "--machine.seed", str(options.seed)]
    if options.steps is not None:
        arguments += ["--max-num-iterations", str(options.steps)]
    arguments += extra
    arguments += ["colmap", "--colmap-path", "sparse/0", "--downscale-factor", "1"]
    arguments += ["--eval-mode", "interval", "--eval-interval", "8"]
    config = tyro.cli(AnnotatedBaseConfigUnion, args=arguments)
    shown = [options.scene if part == str(options.data) else part for part in arguments]
    config.pipeline.datamanager.data = config.data
    config.output_dir = options.out
    config.experiment_name = f"{options.scene}-{options.variant}-{options.seed}"
    config.set_timestamp()
    # The same for every method, and nothing but training in the training time.
    config.vis = "tensorboard"
    config.steps_per_save = config.steps_per_eval_batch = NEVER
    config.steps_per_eval_image = config.steps_per_eval_all_images = NEVER
    return config, "ns-train " + " ".join(shown)


class CountPrimitives:
    """Most primitives after any step of a training."""

    def __init__(self, trainer: Any) -> None:
        self.peak = 0
        self._trainer, self._step = trainer, trainer.train_iteration
        trainer.train_iteration = self

    def __call__(self, step: int) -> Any:
        self.peak = max(self.peak, self._trainer.pipeline.model.num_points)
        return self._step(step)


@torch.no_grad()
def evaluate(pipeline: Any) -> dict[str, float]:
    """Mean PSNR and SSIM over all test views, of the picture and of its base colours."""
    sums: dict[str, float] = {}
    views = pipeline.datamanager.fixed_indices_eval_dataloader
    for camera, batch in views:
        outputs = pipeline.model.get_outputs_for_camera(camera)
        target = pipeline.model.get_gt_img(batch["image"])
        for suffix, name in (("", "rgb"), ("_base", "base_rgb")):
            picture = outputs.get(name, outputs["rgb"])
            sums["psnr" + suffix] = sums.get("psnr" + suffix, 0.0) + float(psnr(picture, target))
            sums["ssim" + suffix] = sums.get("ssim" + suffix, 0.0) + float(ssim(picture, target))
    return {name: total / len(views) for name, total in sums.items()}


def resolution(pipeline: Any) -> str:
    """Width x height of the first test view, pixels."""
    camera = pipeline.datamanager.eval_dataset.cameras[0]
    return f"{int(camera.width)}x{int(camera.height)}"


def append_line(path: Path, line: dict[str, Any]) -> None:
    """A line of JSON at the end of a file that several processes write to."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "a") as file:
        wait_for_lock(file.fileno())
        file.write(json.dumps(line) + "\n")


def commit() -> str:
    """The revision measured; a figure without one is not taken."""
    found = revision()
    if not found:
        raise SystemExit("no commit to note beside the figures: run in a checkout, or name it in BENCHMARK_COMMIT")
    return found


def main() -> None:
    options, extra = parse()
    config, command = configure(options, extra)
    if options.method.startswith("splatfacto"):
        import torchmetrics.image.lpip

        torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity = NoLpips  # type: ignore[misc,assignment]
    _set_random_seed(config.machine.seed)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    save, wanted = trainer.save_checkpoint, set()
    if options.save_pruned:
        wanted.add(config.pipeline.model.pruning.prune_at)
    if options.save_warm:
        wanted.add(config.pipeline.model.pruning.prune_at - 1)
    if wanted:
        config.steps_per_save, config.save_only_latest_checkpoint = 1, False  # the line below picks
    if options.save:
        wanted.add(config.max_num_iterations - 1)
        config.save_config()
    trainer.save_checkpoint = lambda step: save(step) if step in wanted else None
    counts = CountPrimitives(trainer)
    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()
    started = now(trainer.device)
    trainer.train()
    train_s = now(trainer.device) - started
    peak = torch.cuda.max_memory_allocated() / 2**20 if torch.cuda.is_available() else 0.0

    pipeline, model = trainer.pipeline, trainer.pipeline.model
    pipeline.eval()
    quality = evaluate(pipeline)
    cameras = pipeline.datamanager.eval_dataset.cameras.to(model.device)
    views = [cameras[i : i + 1] for i in range(len(cameras))]
    prune_s, keep_ratio = 0.0, 1.0
    if isinstance(model, SundaeModel):
        times, bytes_ = frame_times(model, views), sizes(model)
        ms_frame, ms_splat, ms_head = times.frame, times.splat, times.head
        counts.peak = max(counts.peak, model.pruning_state["peak"])
        budget = trainer.base_dir / "budget.json"
        if budget.exists():
            found = json.loads(budget.read_text())
            keep_ratio = found["primitives"] / found["before"]
            print("budget:", json.dumps(found))
        elif model.config.pruning.mode != "off":
            keep_ratio = model.config.pruning.keep_ratio
        reports = trainer.base_dir / "prune.json"
        if reports.exists():
            report = json.loads(reports.read_text())
            prune_s = sum(r["seconds"] for r in report)
            print("prune:", json.dumps(report))
    else:
        stock = [median_ms(lambda v=v: model.get_outputs_for_camera(v), device=model.device).median_ms for v in views]
        ms_frame = ms_splat = sorted(stock)[len(stock) // 2]
        ms_head, bytes_ = 0.0, Sizes(bytes_of(dict(model.gauss_params)))
    row = RunRow(
        scene=options.scene,
        method=options.method,
        variant=options.variant,
        keep_ratio=keep_ratio,
        seed=options.seed,
        steps=config.max_num_iterations,
        primitives=model.num_points,
        psnr=quality["psnr"],
        ssim=quality["ssim"],
        psnr_base=quality["psnr_base"],
        ssim_base=quality["ssim_base"],
        bytes_primitives=bytes_.primitives,
        bytes_head=bytes_.head,
        bytes_total=bytes_.total,
        ms_frame=ms_frame,
        ms_splat=ms_splat,
        ms_head=ms_head,
        train_s=train_s,
        prune_s=prune_s,
        peak_primitives=counts.peak,
        peak_vram_mib=peak,
        gpu=torch.cuda.get_device_name(0) if torch.cuda.is_available() else "",
        resolution=resolution(pipeline),
        commit=commit(),
        command=command,
    )
    append_row(options.results, row)
    print("row:", row)


if __name__ == "__main__":
    main()
