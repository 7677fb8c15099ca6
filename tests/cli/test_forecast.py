"""The forecast of a training: steps of the real model, timed in a process of its own."""

from __future__ import annotations

import sys

import pytest

from sundae_ns.cli.forecast import measure, measured_step


def test_a_step_is_timed_in_a_process_of_its_own() -> None:
    found = measured_step("sundae-tiny", 24, 16)
    assert found is not None
    assert found.steps == 1200
    assert found.device in ("cpu", "cuda")
    assert found.step_s > 0


def test_what_cannot_be_measured_has_no_forecast(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(AttributeError, match="no_such_method"):
        measure("no-such-method", 24, 16)
    # As the process of an error ends; as one that says something else; as none.
    for program in ("/bin/false", "/bin/echo", "/no/such/program"):
        monkeypatch.setattr(sys, "executable", program)
        assert measured_step("no-such-method", 24, 16) is None
