"""Formats, a module each, and the files of a run."""
