"""Train gsplat's MCMC from scratch to a given count: the peer that every selection rule is compared with.

    python benchmarks/mcmc.py --scene bonsai --data DIR --keep 0.01 0.1 0.3                # counts of rules.py's branches
    python benchmarks/mcmc.py --scene bonsai --data DIR --keep 0.1 --count 49000 --steps 30000

nerfstudio 1.1.5 knows the default strategy only, so gsplat's ``MCMCStrategy`` is driven here, in the same trainer, with the
same data, rates and losses as the other rows, and with what its paper adds: Gaussians start at opacity 0.5 and a tenth of
their width, opacities and scales are regularised by 0.01 each, and noise is added to positions in every step ("3D Gaussian
Splatting as Markov Chain Monte Carlo", Kheradmand et al., 2024). Needs CUDA, for gsplat's relocation is a CUDA kernel. One
line and one row for each count go to the files that ``rules.py`` writes; ``steps`` of a line is the length of the whole run
less the warm-up.
"""

from __future__ import annotations

import argparse
import shlex
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import rules
import run
import torch
import tyro
from gsplat.strategy import MCMCStrategy
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
from torch import Tensor

from sundae_ns.evaluation import append_row
from sundae_ns.model import SundaeModel, SundaeModelConfig
from sundae_ns.scenes.measure import sizes
from sundae_ns.training.densification import start_of_chain
from sundae_ns.training.losses import chain_losses


@dataclass
class McmcModelConfig(SundaeModelConfig):
    _target: type = field(default_factory=lambda: McmcModel)
    most: int = 1_000_000
    """Primitives to grow to."""
    refine_until: int = 25_000
    """Last step that moves or adds primitives."""


class McmcModel(SundaeModel):
    config: McmcModelConfig

    def populate_modules(self) -> None:
        super().populate_modules()
        if self.num_points > self.config.most:
            # Structure from motion may give more points than the cap allows, and the strategy takes none away.
            chosen = torch.randperm(self.num_points)[: self.config.most]
            for name, value in self.gauss_params.items():
                self.gauss_params[name] = torch.nn.Parameter(value.detach()[chosen])
        self.strategy = MCMCStrategy(  # type: ignore[assignment]
            cap_max=self.config.most, refine_stop_iter=self.config.refine_until
        )
        self.strategy_state = self.strategy.initialize_state()  # type: ignore[call-arg]
        for name, value in start_of_chain(self.gaussians).items():
            self.gauss_params[name].data = value.detach()

    def step_post_backward(self, step: int) -> None:
        rate = self.optimizers["means"].param_groups[0]["lr"]
        self.strategy.step_post_backward(self.gauss_params, self.optimizers, self.strategy_state, step, {}, lr=rate)

    def get_loss_dict(self, outputs: Any, batch: Any, metrics_dict: Any = None) -> dict[str, Tensor]:
        losses = super().get_loss_dict(outputs, batch, metrics_dict)
        losses.update(chain_losses(self.gaussians))
        return losses


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", required=True)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--method", default="sundae")
    parser.add_argument("--keep", type=float, nargs="+", default=[0.01, 0.1, 0.3])
    parser.add_argument("--count", type=int, help="primitives; default: the share of what the warm-up of rules.py had")
    parser.add_argument("--warmup", type=int, default=15000, help="steps before the prune of the rows to compare with")
    parser.add_argument("--steps", type=int, default=15000, help="steps after it: the run has as many as both together")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--parser", default=rules.COLMAP)
    parser.add_argument("--extra", default="")
    parser.add_argument("--out", type=Path, default=Path("outputs/rules"))
    parser.add_argument("--results", type=Path, default=rules.RESULTS)
    parser.add_argument("--rows", type=Path, default=run.RESULTS, help="CSV file of rows; - for none")
    return parser.parse_args()


def count_of(options: argparse.Namespace, keep: float) -> int:
    """Primitives that the branches of the same share kept."""
    if options.count is not None:
        return options.count
    for line in rules.finished(options.results):
        if (line["scene"], line["keep"], line["warmup"]) == (options.scene, keep, options.warmup):
            return line["primitives"]
    raise SystemExit(f"no branch of {options.scene} keeps {keep}: run rules.py first, or give --count")


def train(options: argparse.Namespace, keep: float, seed: int, count: int) -> tuple[dict[str, Any], int, str]:
    """What a line has of a run; the bytes of its primitives, and the size of its pictures."""
    arguments = [options.method, "--data", str(options.data), "--machine.seed", str(42 + seed)]
    arguments += ["--pipeline.model.head.mode", "off", "--pipeline.model.pruning.mode", "off"]
    steps = options.warmup + options.steps
    arguments += ["--max-num-iterations", str(steps), *shlex.split(options.extra)]
    config = tyro.cli(AnnotatedBaseConfigUnion, args=[*arguments, *shlex.split(options.parser)])
    config.pipeline.datamanager.data = config.data
    config.pipeline.datamanager.train_cameras_sampling_seed = 42 + seed
    model = vars(config.pipeline.model) | {"_target": McmcModel, "most": count, "refine_until": steps * 5 // 6}
    config.pipeline.model = McmcModelConfig(**model)
    config.optimizers["means"]["scheduler"].max_steps = steps
    config.output_dir, config.experiment_name = options.out, f"{options.scene}-mcmc-{keep}-{seed}"
    config.set_timestamp()
    config.vis = "tensorboard"
    config.steps_per_save = config.steps_per_eval_batch = run.NEVER
    config.steps_per_eval_image = config.steps_per_eval_all_images = run.NEVER
    run._set_random_seed(config.machine.seed)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    trainer.save_checkpoint = lambda step: None
    started = time.perf_counter()
    trainer.train()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    train_s = time.perf_counter() - started
    trainer.pipeline.eval()
    quality = run.evaluate(trainer.pipeline)
    measured = {
        "psnr": quality["psnr"],
        "ssim": quality["ssim"],
        "primitives": trainer.pipeline.model.num_points,
        "train_s": train_s,
        "command": " ".join(["ns-train", options.method, "--data", options.scene, *arguments[3:], options.parser]),
    }
    return measured, sizes(trainer.pipeline.model).primitives, run.resolution(trainer.pipeline)


def main() -> None:
    options = parse()
    for seed in options.seeds:
        for keep in options.keep:
            branch = rules.Branch("mcmc", keep, seed, {})
            key = rules.key_of(options, branch, options.warmup)
            if rules.is_finished(options.results, key):
                continue
            measured, bytes_primitives, resolution = train(options, keep, seed, count_of(options, keep))
            line = {
                **key,
                "options": {},
                "before": None,
                "psnr_pruned": None,
                "ssim_pruned": None,
                "prune_s": None,
                **measured,
                "gpu": torch.cuda.get_device_name(0) if torch.cuda.is_available() else "",
                "commit": run.commit(),
            }
            run.append_line(options.results, line)
            if str(options.rows) != "-":
                command = f"{line['command']} (mcmc.py --count {line['primitives']})"
                append_row(options.rows, rules.row(line, bytes_primitives, resolution, command))
            print("mcmc:", line)


if __name__ == "__main__":
    main()
