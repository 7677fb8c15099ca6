"""What runs on a GPU beside gsplat: kernels compiled at run time, recorded CUDA graphs, the fused loss. Floor 1."""
