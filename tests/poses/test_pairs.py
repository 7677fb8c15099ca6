"""Pairs of photos that are compared."""

from __future__ import annotations

import numpy as np
import pytest

from sundae_ns.poses import pairs


def test_all_pairs_once_and_in_blocks() -> None:
    found = pairs.exhaustive(50)
    assert len(found) == len(set(found)) == 50 * 49 // 2
    assert all(i < j for i, j in found)
    first = found[: 20 * 19 // 2]
    assert {i for pair in first for i in pair} == set(range(20)), "the first block loads 20 photos only"


def test_the_way_fits_what_is_given() -> None:
    assert pairs.chosen("auto", 150, True) == "sequential"
    assert pairs.chosen("auto", pairs.MOST_EXHAUSTIVE, False) == "exhaustive"
    assert pairs.chosen("auto", pairs.MOST_EXHAUSTIVE + 1, False) == "similar"
    assert pairs.chosen("exhaustive", 9999, True) == "exhaustive"


def circle(count: int) -> np.ndarray:
    """How alike frames of a walk in a circle are."""
    angles = 2 * np.pi * np.arange(count) / count
    return np.cos(np.subtract.outer(angles, angles)).astype(np.float32)


def test_frames_of_a_video_meet_their_neighbours_and_the_end_of_a_loop() -> None:
    found = set(pairs.sequential(circle(100)))
    assert {(40, 40 + step) for step in (1, 2, 5, 10, 20, 40)} <= found
    assert {(0, 99), (1, 98)} <= found, "the walk ends where it began"
    assert (10, 47) not in found
    assert len(found) < 100 * 25
    assert set(pairs.sequential(circle(3))) == {(0, 1), (0, 2), (1, 2)}


def test_photos_meet_those_that_look_alike() -> None:
    order = np.random.default_rng(0).permutation(300)
    found = set(pairs.similar(circle(300)[np.ix_(order, order)]))
    place = np.argsort(order)
    near = [(place[i], place[(i + 1) % 300]) for i in range(300)]
    assert all((min(pair), max(pair)) in found for pair in near)
    assert len(found) < 300 * 45
    assert all(i < j for i, j in found)


def descriptors(seed: int, scene: int) -> np.ndarray:
    """Local features of a photo of one of several scenes, with noise of the photo."""
    shared = np.random.default_rng(1000 + scene).gamma(0.3, 60, (150, 128))
    noise = np.random.default_rng(seed).normal(0, 12, (150, 128))
    return np.clip(shared + noise, 0, 255).astype(np.uint8)


def test_photos_of_one_scene_look_alike() -> None:
    scenes = [number % 3 for number in range(12)]
    found = pairs.similarities([descriptors(seed, scene) for seed, scene in enumerate(scenes)])
    same = np.equal.outer(scenes, scenes)
    np.testing.assert_allclose(np.diag(found), 1, atol=1e-5)
    assert found[same].min() > found[~same].max() + 0.1


def test_photos_without_features_are_like_none() -> None:
    none = np.zeros((0, 128), np.uint8)
    found = pairs.similarities([descriptors(0, 0), none, descriptors(1, 0)])
    assert np.isfinite(found).all()
    assert (found[1] == 0).all()
    assert found[0, 0] > 0.99
    assert (pairs.similarities([none, none]) == 0).all()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_photos(count: int) -> None:
    every = set(pairs.exhaustive(count))
    assert set(pairs.similar(circle(count))) == set(pairs.sequential(circle(count))) == every
