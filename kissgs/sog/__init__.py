"""The SOG container: lossless WebP images and ``meta.json``, one scene or levels of detail. Takes files; gives Splats.

Needs no cameras, no renderer and no planner.
"""
