"""Rasterisation: one interface and three backends."""
