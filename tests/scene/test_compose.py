"""Rows of a scene, scenes of arrays, scenes in other coordinates, and several scenes as one."""

import dataclasses

import numpy as np
import pytest
import torch
from fields import random_field
from packed_scenes import KINDS, scene, write_kind

import sundae_ns as sn
from sundae_ns.core.covariance import rotation_matrices
from sundae_ns.core.gaussians import Gaussians

QUATERNION = torch.tensor([0.9, -0.2, 0.5, 0.3])
TURN = rotation_matrices(QUATERNION[None].double())[0]
SHIFT = torch.tensor([3.0, -1.0, 0.5], dtype=torch.float64)
SCALE = 2.5


def moved(whole):
    return sn.transform(whole, TURN, SCALE, SHIFT)


def survey(east, **values):
    frame = {"transform": [[1.0, 0, 0, -east], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": 1.0}
    return scene(meta={"frame": frame}, **values)


@pytest.mark.parametrize("form", [torch.Tensor.bool, np.asarray, torch.Tensor.tolist], ids=["torch", "numpy", "list"])
def test_rows_of_a_scene(form):
    whole = scene(up=(0.0, 0.0, 1.0))
    mask = whole.opacities > 0.5
    for rows in (form(mask), mask.nonzero()[:, 0], mask.nonzero()[:, 0].numpy()):
        part = whole[rows]
        assert torch.equal(part.means, whole.means[mask])
        assert (len(part), part.up) == (int(mask.sum()), whole.up)
    assert torch.equal(whole[::-3].means, whole.means.flip(0)[::3])
    assert torch.equal(whole[[-1, 5]].means, whole.means[[199, 5]])


def test_properties_and_arrays_are_counterparts():
    whole = scene(degree=1)
    harmonics = torch.cat([whole.gaussians["features_dc"][:, None], whole.gaussians["features_rest"]], dim=1)
    given = (whole.means, whole.scales, whole.quats, whole.opacities)
    for name, value in sn.Scene.from_arrays(*given, harmonics).gaussians.items():
        expected = whole.quats if name == "quats" else whole.gaussians[name]
        torch.testing.assert_close(value, expected, atol=1e-5, rtol=1e-5)
    plain = sn.Scene.from_arrays(*(value.numpy() for value in given), whole.colors.numpy())
    torch.testing.assert_close(plain.colors, whole.colors)
    assert plain.gaussians.sh_degree == 0
    assert [tuple(value.shape) for value in (*given, whole.colors)] == [(200, 3), (200, 3), (200, 4), (200,), (200, 3)]
    logits = sn.Scene(Gaussians(random_field(9, degree=0), "logits"))
    torch.testing.assert_close(logits.colors, logits.gaussians["features_dc"].sigmoid())


def test_moved_cameras_see_the_same_image(tmp_path):
    """Harmonics of degree 4, the head, and thin Gaussians with their blur in pixels too."""
    cameras = tuple(sn.virtual_cameras(scene(degree=4), 3, size=48))
    headed = sn.load(write_kind(tmp_path / "a.sundae", KINDS["residual"]))
    for whole in (scene(degree=4, cameras=cameras, start=cameras[1], up=(0.0, 1.0, 0.0)), headed):
        after = moved(whole)
        for camera, there in zip((*whole.cameras, whole.start), (*after.cameras, after.start)):
            if camera is not None and there is not None:
                image, again = sn.render(whole, camera), sn.render(after, there)
                torch.testing.assert_close(again.rgb, image.rgb, atol=2e-3, rtol=0)
                torch.testing.assert_close(again.depth, SCALE * image.depth, atol=2e-2, rtol=1e-3)
                expected = SCALE * TURN @ camera.center.double() + SHIFT
                torch.testing.assert_close(there.center.double(), expected, atol=1e-4, rtol=0)
        assert after.up == (whole.up and pytest.approx((TURN @ torch.tensor(whole.up).double()).tolist()))
    tiny = sn.transform(whole, scale=1e-4)
    torch.testing.assert_close(sn.render(tiny, tiny.cameras[0]).rgb, sn.render(whole, whole.cameras[0]).rgb)
    same = sn.transform(scene(degree=4), QUATERNION * 3, SCALE, SHIFT.tolist())
    torch.testing.assert_close(same.gaussians["features_rest"], moved(scene(degree=4)).gaussians["features_rest"])


def test_cameras_of_a_capture_follow_a_run():
    frame = {"transform": [[0.0, 1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7]], "scale": 0.5}
    run = scene(in_model_frame=True, meta={"frame": frame})
    points = torch.rand(9, 3, dtype=torch.float64)

    def to_scene(frame):
        rows = torch.tensor(frame["transform"], dtype=torch.float64)
        return frame["scale"] * (points @ rows[:, :3].T + rows[:, 3])

    after = moved(moved(run))
    expected = SCALE * (SCALE * to_scene(frame) @ TURN.T + SHIFT) @ TURN.T + SHIFT
    torch.testing.assert_close(to_scene(after.meta["frame"]), expected)
    assert not after.in_model_frame
    assert after.offset is None


def test_survey_coordinates_are_moved_and_merged_in_the_file(tmp_path):
    here, there = survey(4e6), survey(4e6 + 64)
    assert here.offset == (4e6, 0, 0)
    after = moved(here)
    assert after.offset is not None
    offset, before = torch.tensor(after.offset, dtype=torch.float64), torch.tensor(here.offset, dtype=torch.float64)
    expected = SCALE * (here.means.double() + before) @ TURN.T + SHIFT
    torch.testing.assert_close(after.means.double() + offset, expected, atol=1e-4, rtol=0)
    both = sn.merge([here, there])
    torch.testing.assert_close(both.means[200:], there.means + torch.tensor([64.0, 0, 0]))
    assert both.offset == here.offset
    sn.save(both, tmp_path / "a.ply")
    assert sn.load(tmp_path / "a.ply").offset == (4e6, 0, 0)


def test_a_merge_is_both_scenes():
    camera = sn.Camera.look_at((0, -30, 0), (0, 0, 0), width=64, height=32)
    red = scene(degree=0, cameras=(camera,), background_color="white")
    blue = sn.transform(scene(degree=2), translation=(6, 0, 0))
    logits = sn.Scene(Gaussians(random_field(7, degree=0), "logits"), cameras=(camera,), up=(0.0, 0.0, 1.0))
    both = sn.merge([red, blue, logits])
    assert (len(both), both.gaussians.sh_degree, both.up, both.background_color) == (407, 2, logits.up, "white")
    assert len(both.cameras) == 1, "that of two scenes is one"
    for part, alone in zip((both[:200], both[200:400], both[400:]), (red, blue, logits)):
        alone = dataclasses.replace(alone, background_color="white")
        assert sn.measure(part, alone, camera).psnr > 90
    assert sn.merge([logits, logits]).gaussians.encoding == "logits"


def test_a_head_goes_with_its_features(tmp_path):
    whole = sn.load(write_kind(tmp_path / "a.sundae", KINDS["residual"]))
    parts = sn.merge([whole[::2], whole[1::2].to("cpu")])
    assert sn.measure(parts, whole, whole.cameras[0]).psnr > 60
    assert parts.head is whole.head is not None
    other = dataclasses.replace(whole, head=type(whole.head)(whole.head.config))
    for odd in (other, dataclasses.replace(whole, head=None)):
        with pytest.raises(sn.SundaeError, match="one head cannot correct scenes of others; give"):
            sn.merge([whole, odd])
    assert "features" not in sn.merge([dataclasses.replace(whole, head=None), scene(degree=1)]).gaussians
