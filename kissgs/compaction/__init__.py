"""Compaction: a scene, its views and a budget -> a scene with fewer Gaussians and a report of every step. Gaussians are
scored and pruned, and the remaining ones are trained to show the same images (POPSpa, KISS-GS 3.2); or neighbours are
merged, without images."""
