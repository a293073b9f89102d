"""The CPU rasteriser: numba kernels for projection, shading, tiles, blending and sensitivity."""
