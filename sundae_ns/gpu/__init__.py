"""GPU tools beside gsplat: kernels compiled at run time, CUDA graphs, and the kernels of loss, Adam and plane sweep."""
