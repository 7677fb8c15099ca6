"""Finished scenes: opening, packing, fine-tuning and measuring them."""
