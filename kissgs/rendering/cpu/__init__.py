"""The rasteriser for processors: compiled kernels, in the order in which a picture passes through them."""
