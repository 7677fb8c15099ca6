"""Colours of plots."""

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Six colours that people with colour-vision deficiency can tell apart (Okabe and Ito, "Color Universal Design")."""
