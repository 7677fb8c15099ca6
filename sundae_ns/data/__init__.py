"""Captures, COLMAP models, camera poses, videos."""
