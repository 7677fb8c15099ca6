"""Trials: train copies of a field for some steps, measure held-out training views, and keep the best copy."""
