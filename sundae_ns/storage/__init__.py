"""Files: one module for each format, packed scenes, checkpoints and runs; atomic writes."""
