"""One job of a comparison: trained by nerfstudio, saved, opened again from its files, and measured.

``OUT/jobs/KEY/job.json`` describes it. quality.py and suite.py start a process of it.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, NoReturn
from unittest import mock

import torch
import tyro
from filelock import FileLock
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion, all_methods
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.scripts.train import _set_random_seed
from nerfstudio.utils import profiler, writer

from harness.plan import WARM_UP, Job, Words, done_file, job_folder
from harness.run import run_script
from sundae_ns.core.errors import BackendError, CheckpointError, PackError, SundaeError
from sundae_ns.core.files import write_text
from sundae_ns.core.metrics import Lpips, lpips_weights
from sundae_ns.core.timing import now
from sundae_ns.io.pack.codecs import Codecs
from sundae_ns.io.pack.config import FINETUNE_STEPS, FINETUNED, PackConfig
from sundae_ns.io.pack.packed_scene import PackedScene, fit_scene, write_fitted
from sundae_ns.plugin.finished_runs import Opened, load_model, load_run, model_of
from sundae_ns.plugin.model import SundaeModelConfig
from sundae_ns.plugin.trainer import SundaeTrainerConfig
from sundae_ns.plugin.tuned_packs import finetune
from sundae_ns.report.measure import Measured, Subject, measure
from sundae_ns.scene.load_save import load
from sundae_ns.scene.packing import contents_of
from sundae_ns.train.schedules import set_schedule

NEVER = 10**9
"""A step that no training reaches."""


def perform(job: Job, out: Path) -> None:
    """Do a job unless it is done; wait for another process that does the same job."""
    job_folder(out, job.key).mkdir(parents=True, exist_ok=True)
    done_file(out, job.key).parent.mkdir(parents=True, exist_ok=True)
    with FileLock(job_folder(out, job.key) / "lock"):
        if not done_file(out, job.key).exists():
            result = train_and_measure(job, out)
            write_text(done_file(out, job.key), json.dumps(result) + "\n")


@contextlib.contextmanager
def watched_gpu() -> Iterator[Callable[[], bool]]:
    """Tell whether no other job of a comparison has used the GPU since the block began; a CPU counts as alone.

    Jobs of one user hold the file of a GPU, and add a byte to it: one that ends before this one is noticed too. Windows
    has no such locks, and every job counts as alone.
    """
    if not torch.cuda.is_available() or os.name != "posix":
        yield lambda: True
        return
    import fcntl

    device = torch.cuda.current_device()
    name = getattr(torch.cuda.get_device_properties(device), "uuid", device)
    path = Path(tempfile.gettempdir()) / f"sundae-bench-{os.getuid()}-{name}"
    with path.open("ab") as file:
        first = True
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            first = False
        fcntl.flock(file, fcntl.LOCK_SH)  # the system releases it when the process ends
        file.write(b".")
        file.flush()
        length = path.stat().st_size
        yield lambda: first and path.stat().st_size == length


def train_and_measure(job: Job, out: Path) -> dict[str, Any]:
    """Train, save, open the saved run, measure it, and pack it; the plain values of its result.

    Nothing is evaluated or saved while training is timed. A job that was not ``alone`` on its GPU has no times.
    """
    config, command = configure(job, out)
    ours = isinstance(config.pipeline.model, SundaeModelConfig)
    if not ours and not torch.cuda.is_available():
        raise BackendError(f"{job.arm} needs a CUDA device and gsplat's kernels; leave it out with --arms here")
    with watched_gpu() as alone:
        opened, measured = _measured(job, config, command)
        small = ours and job.kind != "warm-up"
        packed = pack(opened, job_folder(out, job.key) / "scene.sundae") if small else None
        fine = packed and torch.cuda.is_available()
        tuned = tune(opened, job_folder(out, job.key) / "tuned.sundae") if fine else None
        had_gpu = alone()
    if not had_gpu:
        timeless = tuple(replace(configuration, ms=None) for configuration in measured.configurations)
        measured = replace(measured, configurations=timeless, ms_head=None, train_s=None, prune_s=None)
    described = {"job": asdict(job), "measured": measured.as_json()}
    return {**described, "packed": packed, "tuned": tuned, "alone": had_gpu}


def pack(opened: Opened, path: Path) -> dict[str, Any] | None:
    """Pack a run by the defaults of ``sundae pack``; the file's bytes and its errors on the test views.

    ``*_base`` are those without the head; None for Gaussians that cannot be packed.
    """
    try:
        return _written(opened, path, *fit_scene(contents_of(load_run(opened.source)), PackConfig()))
    except PackError as error:
        print(f"not packed: {error}")
        return None


def tune(opened: Opened, path: Path) -> dict[str, Any] | None:
    """As :func:`pack`, after the fine-tune with which ``sundae run`` packs on a GPU; None if it is impossible."""
    try:
        scene, codecs = finetune(opened.source, contents_of(load_run(opened.source)), FINETUNED, FINETUNE_STEPS)
        _forget()
        return _written(opened, path, scene, codecs)
    # The training of hours before it must not be lost.
    except (SundaeError, torch.cuda.OutOfMemoryError) as error:
        print(f"not fine-tuned: {error}")
        return None


def _written(opened: Opened, path: Path, scene: PackedScene, codecs: Codecs) -> dict[str, Any]:
    """Write a pack of a run and measure the file on the test views."""
    report = write_fitted(path, scene, codecs)
    model = model_of(load(path)).to(opened.model.device).eval()
    subject = Subject.of_run(replace(opened, model=model, packed_bytes=report.bytes))
    found = measure(subject, repeats=0)
    errors = {name: found.full.mean(name) for name in ("psnr", "ssim")}
    return {"bytes": report.bytes, **errors, **{f"{name}_base": found.base.mean(name) for name in ("psnr", "ssim")}}


def _measured(job: Job, config: TrainerConfig, command: str) -> tuple[Opened, Measured]:
    """The finished run and its measurements."""
    cuda = torch.cuda.is_available()
    # Records of an attempt that was stopped would be taken for this one's.
    shutil.rmtree(config.get_base_dir(), ignore_errors=True)
    config.save_config()
    trainer, save = trainer_of(config)
    device = "cuda" if cuda else "cpu"
    if cuda:
        torch.cuda.reset_peak_memory_stats()
    started = now(device)
    trainer.train()
    seconds = now(device) - started
    peak = torch.cuda.max_memory_allocated() / 2**20 if cuda else None
    save(trainer.step)
    folder = trainer.base_dir
    del trainer, save
    _forget()
    opened = load_model(folder)
    lpips = Lpips() if lpips_weights()[1].is_file() else None
    measured = measure(Subject.of_run(opened), label=job.key, lpips=lpips, command=command)
    measured = replace(measured, scene=job.scene, variant=job.arm, seed=job.seed, train_s=seconds, peak_vram_mib=peak)
    return opened, measured if job.keep_ratio is None else replace(measured, keep_ratio=job.keep_ratio)


def trainer_of(config: TrainerConfig, rank: int = 0, ranks: int = 1) -> tuple[Any, Callable[[int], None]]:
    """A trainer that is set up and saves nothing, and the function by which it would save."""
    _set_random_seed(config.machine.seed + rank)
    # Stock splatfacto builds LPIPS, whose weights it would download; training evaluates nothing.
    name = "torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity"
    with mock.patch(name, return_value=torch.nn.Module()):
        trainer: Any = config.setup(local_rank=rank, world_size=ranks)
        trainer.setup()
    save, trainer.save_checkpoint = trainer.save_checkpoint, lambda step: None
    return trainer, save


def configure(job: Job, out: Path) -> tuple[TrainerConfig, str]:
    """The configuration as ``ns-train`` parses it, and that command; ``CheckpointError`` if its warm-up is not done."""
    start: Words = ()
    if job.kind == "branch":
        if not done_file(out, str(job.needs)).exists():
            raise CheckpointError(f"the warm-up {job.needs} is not done; run the whole plan")
        run = job_folder(out, str(job.needs)) / f"{job.method}-{WARM_UP}" / job.method / "run"
        start = ("--pipeline.model.warm-start", str(run / "nerfstudio_models"))
    fixed = ("--data", job.data, "--machine.seed", str(job.seed), "--max-num-iterations", str(job.steps))
    arguments = (job.method, *fixed, *job.options, *start, *job.parser)
    config = parse(arguments)
    config.output_dir = job_folder(out, job.key)
    config.experiment_name, config.timestamp = job.arm, "run"
    config.vis = "tensorboard"
    config.steps_per_save = config.steps_per_eval_batch = NEVER
    config.steps_per_eval_image = config.steps_per_eval_all_images = NEVER
    return config, "ns-train " + " ".join(job.scene if word == job.data else word for word in arguments)


def parse(arguments: Sequence[str]) -> TrainerConfig:
    """The configuration of a run, its schedule made, as ``ns-train`` parses the words that follow it."""
    return deepcopy(_parsed(tuple(arguments)))


@cache  # a parse takes a third of a second
def _parsed(arguments: Words) -> TrainerConfig:
    config = tyro.cli(AnnotatedBaseConfigUnion, args=list(arguments))  # type: ignore[arg-type]
    assert isinstance(config, TrainerConfig)
    config.pipeline.datamanager.data = config.data
    if isinstance(config, SundaeTrainerConfig):
        set_schedule(config, all_methods.get(str(config.method_name)), arguments)
    return config


def _forget() -> None:
    """Free the loggers that nerfstudio keeps in globals, and unused memory."""
    for writers in (writer.EVENT_WRITERS, writer.EVENT_STORAGE, profiler.PROFILER):
        writers.clear()
    writer.GLOBAL_BUFFER.clear()
    gc.collect()
    if torch.cuda.is_available():
        torch.cuda.empty_cache()


def job(out: Annotated[Path, tyro.conf.Positional], key: Annotated[str, tyro.conf.Positional]) -> int:
    """Train, save and measure; a job that is done is not done again."""
    plain = json.loads((job_folder(out, key) / "job.json").read_text(encoding="utf-8"))
    perform(Job(**{**plain, "options": tuple(plain["options"]), "parser": tuple(plain["parser"])}), out)
    return 0


def main() -> NoReturn:
    """Do the job that the command line names, and exit."""
    run_script(job, __doc__)
