"""GPU tools beside gsplat: kernels compiled at run time, recorded CUDA graphs, the fused loss."""
