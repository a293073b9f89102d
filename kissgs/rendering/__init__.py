"""From Gaussians to pictures: cameras, the rasteriser and its backends, and how pictures are compared."""
