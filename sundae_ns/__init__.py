"""SUNDAE for nerfstudio: spectrally pruned Gaussian fields with neural compensation."""

__version__ = "0.1.0"
