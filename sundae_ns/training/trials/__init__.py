"""Trials: train copies of a field for some steps, measure held-out training views, and keep the copy that is best."""

from sundae_ns.training.trials.engine import Trial, TrialEngine
from sundae_ns.training.trials.head import HeadTrials
from sundae_ns.training.trials.stopping import EarlyStopping

__all__ = ["EarlyStopping", "HeadTrials", "Trial", "TrialEngine"]
