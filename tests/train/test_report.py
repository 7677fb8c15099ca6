"""The line that a prune leaves in the log."""

from __future__ import annotations

from dataclasses import replace

from sundae_ns.train.pruning import PruneReport

PLAIN = PruneReport(
    step=15000,
    before=1_234_567,
    after=123_456,
    dropped_nonfinite=0,
    peak=2_000_000,
    seconds=1.26,
    tau=None,
    sigma=None,
    isolated=None,
)


def test_it_says_what_happened_and_leaves_out_what_did_not() -> None:
    assert PLAIN.summary() == "step 15000: kept 123,456 of 1,234,567 Gaussians in 1.3 s; peak 2,000,000"
    odd = replace(PLAIN, dropped_nonfinite=1200, tau=0.0090, sigma=0.0316227, isolated=1500)
    assert odd.summary().split("; ")[2:] == ["1,200 were NaN or infinite", "sigma 0.0316, tau 0.009, 1,500 isolated"]
