"""Measurements of a finished run."""

import copy
import json
import os
import shutil
from functools import partial
from pathlib import Path

import pytest
import torch
import yaml

from sundae_ns.core.errors import CheckpointError, DataError
from sundae_ns.io import checkpoint
from sundae_ns.plugin import finished_runs as opening
from sundae_ns.plugin.finished_runs import load_model
from sundae_ns.report.measure import compensation, frame_times, measure_scene, sizes


def figures_of(run):
    return measure_scene(run, label="", warmup=0, repeats=1)


def test_figures_of_a_run(tiny):
    run = load_model(tiny.config)
    model, cameras, truths = run.model, run.cameras, run.truths
    assert [truth.shape[:2] for truth in truths] == [(int(c.height), int(c.width)) for c in cameras]
    assert all(0 <= truth.min() <= truth.max() <= 1 for truth in truths)
    times = frame_times(model, cameras[0], warmup=0, repeats=1)
    assert min(times.frame, times.splat, times.head) > 0
    floats = sum(value.numel() for value in model.gauss_params.values())
    assert sizes(model)[0] == 4 * floats
    assert sizes(model)[1] == sum(p.numel() * p.element_size() for p in model.head.parameters())
    # Before the head is enabled there is none to time.
    model.state.head_starts_at = 10**9
    assert frame_times(model, cameras[0], warmup=0, repeats=1).head == 0


def test_a_run_opens_while_its_training_replaces_the_checkpoint(tiny, tmp_path, monkeypatch):
    run = Path(shutil.copytree(tiny.folder, tmp_path / "run"))
    newest = checkpoint.newest_whole(run)[0]
    monkeypatch.setattr(opening, "fastest_device", lambda: (newest.unlink(missing_ok=True), torch.device("cpu"))[1])
    assert load_model(run).steps == tiny.steps  # it reads the capture for seconds after it has found the checkpoint


@torch.no_grad()
def test_the_head_is_timed_at_the_size_at_which_it_runs(tiny):
    run = load_model(tiny.config)
    model, whole = run.model, tuple(run.truths[0].shape[:2])
    seen = []
    model.head.register_forward_pre_hook(lambda _, arguments: seen.append(tuple(arguments[0].shape[:2])))

    def sizes_seen(fn):
        seen.clear()
        fn()
        return set(seen)

    # Frames of other scales are corrected at the trained one, thumbnails not at all.
    for factor, expected in ((1.0, {whole}), (0.875, {whole}), (0.5, {whole}), (2.0, {whole}), (0.25, set())):
        camera = copy.deepcopy(run.cameras[0])
        camera.rescale_output_resolution(factor)
        assert sizes_seen(partial(model.get_outputs_for_camera, camera)) == expected
        assert sizes_seen(partial(frame_times, model, camera, warmup=0, repeats=1)) == expected
    assert frame_times(model, camera, warmup=0, repeats=1).head == 0


def test_the_head_is_disabled_inside_a_block(tiny):
    run = load_model(tiny.config)

    def corrected():
        shown = run.model.get_outputs_for_camera(run.cameras[0])
        return not torch.equal(shown["rgb"], shown["base_rgb"])

    assert corrected()
    with torch.no_grad(), compensation(run.model, on=False):
        assert not corrected()
    assert corrected()
    with pytest.raises(ZeroDivisionError), compensation(run.model, on=False):
        raise ZeroDivisionError
    assert corrected()


def test_a_capture_that_has_moved_is_found_or_named(tiny, tmp_path):
    """Found where it stands as before as seen from the run, and otherwise by --data."""
    root = Path(os.path.commonpath([tiny.scene, tiny.folder]))
    run = Path(shutil.copytree(tiny.folder, tmp_path / tiny.folder.relative_to(root)))
    capture = tmp_path / tiny.scene.relative_to(root)
    config, lost = yaml.load((run / "config.yml").read_text(), Loader=yaml.Loader), tmp_path / "gone"
    config.output_dir = lost / Path(config.output_dir).relative_to(root)
    config.data = config.pipeline.datamanager.data = lost / tiny.scene.relative_to(root)
    (run / "config.yml").write_text(yaml.dump(config))
    with pytest.raises(DataError, match=f"the capture {lost}.* is missing; give its folder with --data"):
        load_model(run)
    assert load_model(run, data=tiny.scene).capture == tiny.scene
    shutil.copytree(tiny.scene, capture)
    assert load_model(run).capture == capture


def test_a_head_that_is_not_enabled_yet_counts_no_bytes(tiny):
    run = load_model(tiny.config)
    assert figures_of(run).bytes_head > 0
    run.model.state.head_starts_at = 10**9
    figures = figures_of(run)
    assert figures.bytes_head == 0
    assert figures.bytes_total == figures.full.bytes


def test_the_share_kept_is_the_product_over_all_prunes(tiny, tmp_path):
    assert load_model(tiny.config).kept == pytest.approx(tiny.keep_ratio, abs=0.01)  # a whole number of Gaussians
    run = Path(shutil.copytree(tiny.folder, tmp_path / "run"))
    prunes = [{"before": 200, "after": 50, "seconds": 1.0}, {"before": 80, "after": 40, "seconds": 0.5}]
    (run / "prune.json").write_text(json.dumps(prunes))
    found = load_model(run)
    assert (found.kept, found.prune_s) == (0.125, 1.5)
    (run / "prune.json").unlink()
    found = load_model(run)
    assert (found.kept, found.prune_s) == (None, None)


def test_a_run_that_is_not_there(tmp_path):
    with pytest.raises(CheckpointError, match="does not exist"):
        load_model(tmp_path / "config.yml")
