"""The extension that lets training images of few views leave out primitives at random.

With few views primitives hide behind others that explain an image alone. What may be left out at any step has to be
shown by the others too (DropGaussian, Park et al., 2025).
"""

from __future__ import annotations

from sundae_ns.training.extension import Extension, TrainingRun

SHARE = 0.2
"""Share of the primitives that are left out at the end of the schedule, as in the paper."""


class Dropout(Extension):
    """Hands share and schedule to the state, which knows the step."""

    name = "dropout"

    def before_training(self, run: TrainingRun) -> None:
        """Begin, where a trainer says how long the schedule is."""
        length = run.schedule_length
        run.state.dropout = None if length is None else (SHARE, length)
