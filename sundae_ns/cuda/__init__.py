"""CUDA: kernels of csrc compiled and launched, captured graphs, loss, Adam."""
