"""The forecast of a training: steps of the real model, timed in a process of its own."""

from __future__ import annotations

from sundae_ns.cli.forecast import measured_step


def test_a_step_is_timed_in_a_process_of_its_own() -> None:
    found = measured_step("sundae-tiny", 24, 16)
    assert found is not None
    assert found.steps == 1200
    assert found.device in ("cpu", "cuda")
    assert found.step_s > 0


def test_what_cannot_be_measured_has_no_forecast() -> None:
    assert measured_step("no-such-method", 24, 16) is None
