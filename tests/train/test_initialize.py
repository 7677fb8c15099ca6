"""What a training starts from: sparse points, random ones, a finished scene, or a plane sweep."""

from copy import deepcopy
from types import SimpleNamespace

import pytest
import torch
from command_line import said
from foreign_files import FOREIGN, small_field

from sundae_ns.core.errors import CheckpointError, PackError
from sundae_ns.core.gaussians import sh_to_rgb
from sundae_ns.io.coordinates import similarity
from sundae_ns.io.pack.container import MAGIC
from sundae_ns.io.ply import write_ply
from sundae_ns.plugin.datamanager import DATASET_FRAME
from sundae_ns.train import initialize
from sundae_ns.train.initialize import FEWEST_POINTS

N = 60  # Gaussians of a model that is built without a count


def colors_of(model, camera):
    """Colours of the Gaussians as the camera sees them ``[N, 3]``."""
    settings = model.render_settings(training=False)
    return model.source.primitives(model.camera_of(camera), settings, features=False)["colors"].detach()


def cloud(n):
    return torch.rand(n, 3), torch.full((n, 3), 99, dtype=torch.uint8)


RANDOM = {"num_random": 40, "random_scale": 2.0}


@pytest.mark.parametrize(
    ("options", "count", "warning"),
    [
        ({"seed_points": None, **RANDOM}, 40, "no sparse point cloud"),
        ({"seed_points": cloud(0), **RANDOM}, 40, "no sparse point cloud"),
        ({"seed_points": cloud(FEWEST_POINTS - 1)}, FEWEST_POINTS - 1, f"only {FEWEST_POINTS - 1} sparse points"),
        ({"pruning": {"mode": "continuous", "max_gaussians": 25}}, 25, "starting from 25 of them"),
        ({"seed_points": cloud(FEWEST_POINTS)}, FEWEST_POINTS, None),
    ],
)
def test_a_field_starts_from_the_cloud_or_random_points_and_warns(build, training_of, options, count, warning, capsys):
    model = build(**options)
    assert model.num_points == count
    assert options.get("num_random") is None or 0.8 < model.means.abs().max() <= 1
    training_of(model)
    printed = said(capsys)
    assert (warning or "") in printed
    assert ("Warning" in printed) == (warning is not None)


def _ply(build, path, degree=1, **options):
    params = {name: value.detach() for name, value in build(sh_degree=degree).gauss_params.items()}
    params["features_rest"] = torch.randn_like(params["features_rest"])
    write_ply(path, params, **options)
    return params


def _frame():
    turn = torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    return torch.cat([turn, torch.tensor([[0.1], [0.2], [0.3]])], dim=1), 0.5


def test_a_ply_of_the_capture_is_moved_into_the_model(build, training_of, tmp_path):
    params = _ply(build, tmp_path / "a.ply")
    model = build(warm_start=tmp_path / "a.ply", metadata={DATASET_FRAME: _frame()})
    expected = similarity(params, *_frame())
    for name in ("means", "scales", "quats", "features_rest", "opacities"):
        torch.testing.assert_close(model.gauss_params[name].detach(), expected[name])
    assert model.gauss_params["features"].shape == (N, 5)
    as_is = build(warm_start=tmp_path / "a.ply", warm_start_frame="model")
    torch.testing.assert_close(as_is.means.detach(), params["means"])
    with pytest.raises(CheckpointError, match="^.*warm-start-frame model.*$"):
        training_of(build(warm_start=tmp_path / "a.ply"))


@pytest.mark.parametrize("name", [name for name in FOREIGN if name not in ("colors.ply", "a.ksplat")])
def test_files_of_other_programs_start_a_model(build, training_of, tmp_path, name, caplog):
    """gsplat's trainer normalises a capture in a way of its own, which its file does not state."""
    given = small_field(50)
    given["scales"][3, 0] = -torch.inf  # a flat Gaussian
    if name == "a.compressed.ply":  # its bounds are finite
        given["scales"][3, 0] = -20.0
    FOREIGN[name](tmp_path / name, given)
    options = {"warm_start": tmp_path / name, "metadata": {DATASET_FRAME: _frame()}}
    if name.endswith(".pt"):
        with pytest.raises(CheckpointError, match=r"coordinates.*--pipeline.model.warm-start-frame capture"):
            training_of(build(**options))
        caplog.clear()
        options["warm_start_frame"] = "capture"
    model = build(**options)
    torch.testing.assert_close(model.means.detach(), similarity(given, *_frame())["means"], rtol=0, atol=0.001)
    assert model.gauss_params["scales"].isfinite().all()
    assert len([message for message in caplog.messages if "clamped" in message]) == (name != "a.compressed.ply")


def test_a_finished_run_opens_without_what_it_started_from(build, training_of, tmp_path, capsys):
    """Training without the warm start is refused in one line; loading the run's checkpoint needs it no more."""
    _ply(build, tmp_path / "a.ply")
    state = build(warm_start=tmp_path / "a.ply", warm_start_frame="model").state_dict()
    (tmp_path / "a.ply").unlink()
    (tmp_path / "b.sundae").write_bytes(MAGIC)  # a damaged pack
    for name, error, words in (("a.ply", CheckpointError, "does not exist"), ("b.sundae", PackError, "whole")):
        orphan = build(warm_start=tmp_path / name, warm_start_frame="model")
        with pytest.raises(error, match=words):
            training_of(orphan)
    orphan.load_state_dict(state)
    assert torch.equal(orphan.means, state["gauss_params.means"])
    training_of(orphan)
    model = build(seed_points=None, num_random=40)
    model.load_state_dict(state)
    capsys.readouterr()
    training_of(model)
    assert "Warning" not in capsys.readouterr().out, "its field takes the place of random points"


@pytest.mark.parametrize("degree", [0, 1])
def test_colours_are_those_of_the_cloud_and_of_the_warm_start(build, points, camera, tmp_path, degree):
    xyz, rgb = points()
    model = build(sh_degree=degree, seed_points=(xyz, rgb))
    shown = colors_of(model, camera())
    torch.testing.assert_close(shown, rgb / 255, rtol=0, atol=2e-3)
    state, path = {f"_model.{k}": v for k, v in model.state_dict().items()}, tmp_path / "step-000000001.ckpt"
    torch.save({"pipeline": state}, path)
    for wanted in (0, 1):
        warm = build(sh_degree=wanted, warm_start=path)
        torch.testing.assert_close(colors_of(warm, camera()), shown, rtol=0, atol=2e-3)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_a_warm_start_of_another_sh_degree(build, tmp_path, degree):
    params = _ply(build, tmp_path / "a.ply", degree=degree)
    model = build(warm_start=tmp_path / "a.ply", warm_start_frame="model", sh_degree=1)
    rest = model.gauss_params["features_rest"].detach()
    assert rest.shape == (N, 3, 3)
    shared = min(3, params["features_rest"].shape[1])
    assert torch.equal(rest[:, :shared], params["features_rest"][:, :shared])
    assert not rest[:, shared:].any()


def test_a_warm_start_prunes_at_its_first_step(build, training_of, tmp_path):
    _ply(build, tmp_path / "a.ply")
    training = training_of(build(warm_start=tmp_path / "a.ply", warm_start_frame="model", pruning={"prune_at": 15000}))
    training.step(0)
    assert training.model.num_points == N // 2
    assert training.live()
    assert "base_loss" in training.step(1)
    assert training.model.num_points == N // 2


FOUND = 40


class FakeSweep:
    """Finds points at a known place, of a known colour."""

    longest, wanted, most = 0, 0, FOUND

    def __init__(self, photos, sparse, longest):
        self.photos, self.swept = list(photos), set[int]()
        FakeSweep.longest, FakeSweep.seen = longest, sparse

    def add(self, index):
        self.swept.add(index)

    def points(self, wanted):
        assert self.swept == {0, 1, 2}
        FakeSweep.wanted = wanted
        place = torch.arange(3.0 * self.most).reshape(-1, 3) / self.most + 5
        return place, torch.tensor([[0.2, 0.4, 0.6]]).repeat(self.most, 1)


@pytest.fixture(autouse=True)
def fake(monkeypatch):
    monkeypatch.setattr(initialize, "Sweep", FakeSweep)
    monkeypatch.setattr(FakeSweep, "most", FOUND)


def test_the_field_starts_from_both_clouds(build, training_of, points, capsys):
    model = build(dense_start_views=24, sh_degree=1)
    alone = model.scales.detach().clone()
    training = training_of(model)
    assert model.num_points == 60 + FOUND
    assert torch.equal(model.means[:60].detach(), points()[0])
    assert torch.equal(FakeSweep.seen, points()[0])
    assert (FakeSweep.longest, FakeSweep.wanted) == (initialize.SIDES["cpu"], initialize.FILLED["cpu"] - 60)
    assert float((model.means[60:].detach() - 5).min()) >= 0
    colours = sh_to_rgb(model.gauss_params["features_dc"][60:].detach())
    assert torch.allclose(colours, torch.tensor([0.2, 0.4, 0.6]).expand(FOUND, 3), atol=1e-5)
    # Widths follow the neighbours in both clouds: those of the dense one are a twentieth of the distances of the other.
    assert float(model.scales[60:].detach().max()) < float(alone.median())
    assert "40 points by a plane sweep beside 60 sparse ones" in said(capsys)
    assert training.live()
    training.step(0)
    assert training.live()
    saved, resumed = deepcopy(model.state_dict()), build(dense_start_views=24)  # which goes on with its own field
    resumed.load_state_dict(saved)
    training_of(resumed)
    assert resumed.num_points == 60 + FOUND
    assert torch.equal(resumed.means.detach(), saved["gauss_params.means"])


@pytest.mark.parametrize(
    ("options", "filled", "most"),
    [
        ({"dense_start_views": 3}, 100, 4),  # the model has 4 training images
        ({"dense_start_views": 0}, 100, 4),
        ({"random_init": True, "num_random": 60}, 100, 4),
        ({"seed_points": None, "num_random": 60}, 100, 4),
        ({}, 60, 3),
        ({}, 61, 2),
    ],
)
def test_other_fields_stay_as_they_are(build, training_of, monkeypatch, options, filled, most):
    monkeypatch.setattr(initialize, "MOST_ON_CPU", most)
    monkeypatch.setitem(initialize.FILLED, "cpu", filled)
    model = build(**{"dense_start_views": 24, **options})
    before = model.means.detach().clone()
    training_of(model)
    assert torch.equal(before, model.means)


def test_more_points_than_wanted_are_thinned_evenly(build, training_of, monkeypatch):
    monkeypatch.setattr(FakeSweep, "most", 900)
    monkeypatch.setattr(initialize, "MOST_ON_CPU", 3)
    monkeypatch.setitem(initialize.FILLED, "cpu", 60 + 90)
    model = build(dense_start_views=24)
    training_of(model)
    added = model.means[60:, 0].detach()
    assert len(added) == 90
    # Each tenth of the row has a tenth of them.
    assert torch.histc(added, bins=9, min=5, max=8).tolist() == pytest.approx([10] * 9, abs=1)


def test_photos_are_the_training_images_with_their_views_and_masks(build, training_of, batch, camera):
    """Transparent pixels are masked too."""
    run = training_of(build()).run
    photos = list(run.photos())
    assert [float(photo.camera.center[0]) for photo in photos] == pytest.approx([-0.5, 0.0, 0.5])
    assert [photo.mask for photo in photos] == [None] * 3
    assert torch.allclose(photos[0].target, batch()["image"].float() / 255)
    image = {**batch(channels=4), "mask": torch.ones(32, 40, 1, dtype=torch.bool)}
    image["mask"][:4] = False
    image["image"][..., 3] = 255
    image["image"][:, :7, 3] = 100
    cameras = {"cameras": lambda indices: [(camera(), image) for _ in indices]}
    run._datamanager = SimpleNamespace(train_indices=[0], cached_train=[image], **cameras)
    (photo,) = run.photos()
    expected = torch.ones(32, 40, dtype=torch.bool)
    expected[:4] = expected[:, :7] = False
    assert torch.equal(photo.mask, expected)
