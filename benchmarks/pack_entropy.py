"""What a better entropy coder could take off a packed scene; one JSON line.

    python benchmarks/pack_entropy.py scene.sundae

``bytes_order0``: the entropy of every byte plane by itself, which a perfect coder without contexts would reach, beside what
zstandard took. ``bits``: for each attribute, bits a primitive that its values would need less if they were predicted, the mean
logarithm of how much narrower they get: ``transform`` by decorrelating the channels, ``neighbours`` beside that by a linear
guess from the mean of the four primitives before in the file and the nearest of the 256 before.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sundae_ns.storage.packing import container, read_scene

Floats = NDArray[np.float64]
BEFORE = 256


def order0(planes: list[bytes]) -> float:
    """Bytes of planes by the entropy of each."""
    total = 0.0
    for plane in planes:
        counts = np.bincount(np.frombuffer(plane, np.uint8))
        share = counts[counts > 0] / len(plane)
        total -= len(plane) * float((share * np.log2(share)).sum()) / 8
    return total


def joint_bits(values: Floats) -> float:
    """Logarithm of the volume of values ``[N, C]`` if they were Gaussian, but for a constant; bits."""
    return float(np.linalg.slogdet(np.atleast_2d(np.cov(values.T)))[1] / 2 / np.log(2))


def nearest_before(means: Floats) -> NDArray[np.int64]:
    """Index ``[N]`` of the nearest of the primitives before each; the first ones look at the last ones."""
    n = len(means)
    best, distance = np.zeros(n, np.int64), np.full(n, np.inf)
    for back in range(1, BEFORE + 1):
        found = np.square(means - np.roll(means, back, axis=0)).sum(axis=1)
        closer = found < distance
        best[closer], distance[closer] = back, found[closer]
    return (np.arange(n) - best) % n


def savings(values: Floats, nearest: NDArray[np.int64]) -> dict[str, float]:
    """Bits a primitive that predictions would save of one attribute ``[N, C]``."""
    values = np.clip(
        values, *np.quantile(values, [0.001, 0.999], axis=0)
    )  # a few outliers would be all of the variance
    values = values[:, values.std(axis=0) > 0]
    if values.shape[1] == 0:
        return {"transform": 0.0, "neighbours": 0.0}
    before = sum(np.roll(values, back, axis=0) for back in range(1, 5)) / 4
    guess = np.concatenate([values[nearest], before, np.ones((len(values), 1))], axis=1)
    rest = values - guess @ np.linalg.lstsq(guess, values, rcond=None)[0]
    alone, joint = float(np.log2(values.std(axis=0)).sum()), joint_bits(values)
    return {"transform": round(alone - joint, 2), "neighbours": round(joint - joint_bits(rest), 2)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path)
    file = parser.parse_args().file
    header = container.read_header(file)
    arrays = container.read_sections(file, header)
    sizes = {name: section.length for name, section in header.sections.items() if name in arrays}
    best = {name: min(order0(container._cut(array)), sizes[name]) for name, array in arrays.items()}
    field = {name: value.flatten(1).double().numpy() for name, value in read_scene(file).field.items()}
    nearest = nearest_before(field["means"])
    attributes = [name for name in ("scales", "opacities", "features_dc", "features_rest", "features") if name in field]
    bits: dict[str, Any] = {name: savings(field[name], nearest) for name in attributes if field[name].shape[1]}
    result = {
        "file": file.name,
        "primitives": len(nearest),
        "bits_a_primitive": round(8 * header.size / len(nearest), 1),
        "bytes_sections": sum(sizes.values()),
        "bytes_order0": round(sum(best.values())),
        "bits": bits,
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
