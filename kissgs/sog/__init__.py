"""The SOG container: lossless WebP images and ``meta.json``. Takes an encoding plan; gives files of SOG 2, and back.
Reads version 1 and levels of detail as well. Needs no cameras and no renderer; the decoder needs no planner."""
