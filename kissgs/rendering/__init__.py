"""Cameras, the rasteriser with its CPU and CUDA backends, sensitivity, losses and image metrics."""
