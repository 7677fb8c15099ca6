"""Hand-made measurements for the tests of tables and plots."""

import pytest

from sundae_ns.core.metrics import ViewQuality
from sundae_ns.report.measure import HEAD_OFF, HEAD_ON, Configuration, Measured


@pytest.fixture
def measured():
    def make(label="a run", *, head=True, psnr=25.0, scene="bicycle"):
        def views(shift):
            return tuple(ViewQuality(psnr + shift + i, 0.8 + shift / 10, psnr_fitted=26.0) for i in (-1, 0, 1))

        ways = [Configuration(HEAD_OFF, 2.0, 1_000_000, views(0.0))]
        if head:
            ways.insert(0, Configuration(HEAD_ON, 3.5, 3_000_000, views(0.5)))
        return Measured(
            label=label,
            source="runs/a",
            scene=scene,
            method="sundae",
            variant="default",
            keep_ratio=0.1,
            seed=42,
            steps=30000,
            primitives=4000,
            bytes_primitives=2_000_000 if head else 1_000_000,
            bytes_head=1_000_000 if head else 0,
            resolution="1237x822",
            configurations=tuple(ways),
            ms_head=1.0 if head else 0.0,
        )

    return make
