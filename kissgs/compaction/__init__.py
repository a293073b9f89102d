"""Fewer Gaussians for the same pictures (POPSpa): a stage of its own, from a scene to a scene."""
