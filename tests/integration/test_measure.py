"""Measurements of a finished run."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from sundae_ns.cli import main
from sundae_ns.compensation import resize
from sundae_ns.errors import BackendError, CheckpointError, ConfigError
from sundae_ns.evaluation import Measured, psnr
from sundae_ns.rendering import render_view, zoomed
from sundae_ns.scenes import models as opening
from sundae_ns.scenes.measure import compensation, frame_times, measure_scene, rendered_as, sizes
from sundae_ns.scenes.models import Opened, load_model
from sundae_ns.storage import checkpoint


def figures_of(run: Opened, factor: float = 1.0) -> Measured:
    with rendered_as(run, factor=factor) as shown:
        return measure_scene(shown, label="", warmup=0, repeats=1)


def test_figures_of_a_run(tiny: Any) -> None:
    run = load_model(tiny.config)
    model, cameras, truths = run.model, run.cameras, run.truths
    assert [truth.shape[:2] for truth in truths] == [(int(c.height), int(c.width)) for c in cameras]
    assert all(0 <= truth.min() <= truth.max() <= 1 for truth in truths)
    times = frame_times(model, cameras[:1], warmup=0, repeats=1)
    assert min(times.frame, times.splat, times.head) > 0
    floats = sum(value.numel() for value in model.gauss_params.values())
    assert sizes(model).primitives == 4 * floats
    assert sizes(model).head == sum(p.numel() * p.element_size() for p in model.head.parameters())
    # Before the head is enabled there is none to time.
    model.state.head_starts_at = 10**9
    assert frame_times(model, cameras[:1], warmup=0, repeats=1).head == 0


def test_the_timed_frames_are_those_compared_with_the_truth(tiny: Any) -> None:
    run = load_model(tiny.config)
    run = replace(run, cameras=run.cameras[:2], truths=run.truths[:2])
    whole = figures_of(run)
    height, width = run.truths[0].shape[:2]
    assert whole.resolution == f"{width}x{height}"
    assert len(whole.full.views) == 2
    assert min(whole.full.ms, whole.base.ms, whole.ms_head) > 0
    with torch.no_grad():
        shown = [run.model.get_outputs_for_camera(camera) for camera in run.cameras]
    for name, found in (("rgb", whole.full.mean("psnr")), ("base_rgb", whole.base.mean("psnr"))):
        expected = [float(psnr(image[name], truth)) for image, truth in zip(shown, run.truths, strict=True)]
        assert found == pytest.approx(sum(expected) / 2, abs=1e-4)
    assert figures_of(run, 0.5).resolution == f"{width // 2}x{height // 2}"
    # The cameras of the run do not change.
    assert int(run.cameras[0].width) == width


def test_a_run_opens_while_its_training_replaces_the_checkpoint(
    tiny: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Path(shutil.copytree(tiny.folder, tmp_path / "run"))
    newest = checkpoint.newest_whole(run)[0]
    monkeypatch.setattr(opening, "_device", lambda: (newest.unlink(missing_ok=True), torch.device("cpu"))[1])
    assert load_model(run).steps == tiny.steps  # it reads the capture for seconds after it has found the checkpoint


@pytest.mark.parametrize("factor", [0.4, 1.3])
@torch.no_grad()
def test_frames_show_what_the_resized_truth_shows(tiny: Any, factor: float) -> None:
    run = load_model(tiny.config)
    model = run.model
    found = figures_of(run, factor)
    height, width = (round(factor * side) for side in run.truths[0].shape[:2])
    assert found.resolution == f"{width}x{height}"
    assert width != pytest.approx(factor * run.truths[0].shape[1], abs=0.1)  # else nothing is rounded
    background, expected = model._get_background_color(), []
    settings = model.render_settings(training=False).without_head()
    for camera, truth in zip(run.cameras, run.truths, strict=True):
        view = model.view_of(camera)
        # The edges of both images agree.
        K = view.K * torch.tensor([[width / view.width], [height / view.height], [1.0]])
        view = view._replace(K=K, width=width, height=height)
        shown, _ = render_view(model.source, view, background, settings, depth=False)
        expected.append(float(psnr(shown["base_rgb"], resize(truth, height, width))))
    assert found.base.mean("psnr") == pytest.approx(sum(expected) / len(expected), abs=1e-3)


@torch.no_grad()
def test_the_head_is_timed_at_the_size_at_which_it_runs(tiny: Any) -> None:
    run = load_model(tiny.config)
    model, whole = run.model, tuple(run.truths[0].shape[:2])
    seen: list[tuple[int, ...]] = []
    model.head.register_forward_pre_hook(lambda _, arguments: seen.append(tuple(arguments[0].shape[:2])))

    def sizes_seen(fn: Callable[[], Any]) -> set[tuple[int, ...]]:
        seen.clear()
        fn()
        return set(seen)

    # Frames of other scales are corrected at the trained one, thumbnails not at all.
    for factor, expected in ((1.0, {whole}), (0.875, {whole}), (0.5, {whole}), (2.0, {whole}), (0.25, set())):
        camera = zoomed(run.cameras[0], factor)
        assert sizes_seen(partial(model.get_outputs_for_camera, camera)) == expected
        assert sizes_seen(partial(frame_times, model, [camera], warmup=0, repeats=1)) == expected
    assert frame_times(model, [camera], warmup=0, repeats=1).head == 0


def test_the_head_is_disabled_inside_a_block(tiny: Any) -> None:
    run = load_model(tiny.config)

    def corrected() -> bool:
        shown = run.model.get_outputs_for_camera(run.cameras[0])
        return not torch.equal(shown["rgb"], shown["base_rgb"])

    assert corrected()
    with torch.no_grad(), compensation(run.model, on=False):
        assert not corrected()
    assert corrected()
    with pytest.raises(ZeroDivisionError), compensation(run.model, on=False):
        raise ZeroDivisionError
    assert corrected()


def test_a_capture_that_has_moved_is_found_or_named(
    tiny: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Found where it stands as before as seen from the run, and otherwise by --data."""
    root = Path(os.path.commonpath([tiny.scene, tiny.folder]))
    run = Path(shutil.copytree(tiny.folder, tmp_path / tiny.folder.relative_to(root)))
    capture = tmp_path / tiny.scene.relative_to(root)
    config, lost = yaml.load((run / "config.yml").read_text(), Loader=yaml.Loader), tmp_path / "gone"
    config.output_dir = lost / Path(config.output_dir).relative_to(root)
    config.data = config.pipeline.datamanager.data = lost / tiny.scene.relative_to(root)
    (run / "config.yml").write_text(yaml.dump(config))
    arguments = ["bench", "frame", str(run), "--views", "1", "--repeats", "1", "--json"]
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    assert f"the capture {lost}" in capsys.readouterr().err
    with pytest.raises(SystemExit) as caught:
        main([*arguments, "--data", str(tiny.scene)])
    assert caught.value.code == 0
    shutil.copytree(tiny.scene, capture)
    assert load_model(run).capture == capture


def test_a_head_that_is_not_enabled_yet_counts_no_bytes(tiny: Any) -> None:
    run = load_model(tiny.config)
    assert figures_of(run).bytes_head > 0
    run.model.state.head_starts_at = 10**9
    figures = figures_of(run)
    assert figures.bytes_head == 0
    assert figures.bytes_total == figures.full.bytes


def test_the_share_kept_is_the_product_over_all_prunes(tiny: Any, tmp_path: Path) -> None:
    assert load_model(tiny.config).kept == tiny.keep_ratio
    run = Path(shutil.copytree(tiny.folder, tmp_path / "run"))
    prunes = [{"before": 200, "after": 50, "seconds": 1.0}, {"before": 80, "after": 40, "seconds": 0.5}]
    (run / "prune.json").write_text(json.dumps(prunes))
    found = load_model(run)
    assert (found.kept, found.prune_s) == (0.125, 1.5)
    (run / "prune.json").unlink()
    found = load_model(run)
    assert (found.kept, found.prune_s) == (None, None)


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"precision": "bf16"}, BackendError, "a CPU runs the head in fp32"),
        ({"factor": 0.0}, ConfigError, "images cannot be 0.0 times"),
        ({"factor": float("nan")}, ConfigError, "images cannot be nan times"),
        ({"factor": float("inf")}, ConfigError, "images cannot be inf times"),
    ],
)
def test_frames_that_cannot_be_measured(tiny: Any, options: dict[str, Any], error: type, match: str) -> None:
    with pytest.raises(error, match=match), rendered_as(load_model(tiny.config), **options):
        pass


def test_the_head_runs_as_asked_for_inside_a_block(tiny: Any) -> None:
    run = load_model(tiny.config)
    before = run.model.head.config
    with rendered_as(run, factor=0.5):
        assert run.model.head.config == replace(before, precision="fp32")
    assert run.model.head.config is before


def test_bench_frame_prints_one_line_a_job(tiny: Any, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [str(tiny.config), "--views", "1", "--repeats", "1", "--factors", "1", "0.25"]
    with pytest.raises(SystemExit) as caught:
        main(["bench", "frame", *arguments, "--json"])
    assert caught.value.code == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["factor"] for line in lines] == [1, 0.25]
    assert {line["device"] for line in lines} == {"cpu"}
    # At a quarter of the size the correction has faded out.
    assert lines[0]["psnr"] != lines[0]["psnr_base"]
    assert lines[1]["psnr"] == lines[1]["psnr_base"]
    with pytest.raises(SystemExit):
        main(["bench", "frame", *arguments[1:], str(tiny.folder)])
    assert "PSNR off" in capsys.readouterr().out


def test_bench_frame_prints_null_for_undefined_figures(tiny: Any, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [str(tiny.config), "--views", "1", "--repeats", "1", "--factors", "0.2", "0.25"]
    with pytest.raises(SystemExit) as caught:
        main(["bench", "frame", *arguments, "--json"])
    assert caught.value.code == 0

    def refuse(constant: str) -> None:
        raise AssertionError(f"JSON has no {constant}")

    small, larger = (json.loads(line, parse_constant=refuse) for line in capsys.readouterr().out.splitlines())
    # The window of SSIM is larger than 10 pixels.
    assert (small["width"], small["ssim"], small["ssim_base"]) == (10, None, None)
    assert larger["width"] == 12
    assert 0 < min(small["psnr"], larger["psnr"], larger["ssim"])
    with pytest.raises(SystemExit):
        main(["bench", "frame", *arguments])
    shown = capsys.readouterr().out
    assert "nan" not in shown
    assert "10x" in shown


def test_a_run_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="does not exist"):
        load_model(tmp_path / "config.yml")
