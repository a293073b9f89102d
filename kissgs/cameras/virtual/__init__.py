"""Cameras chosen for a scene that has none of its own. Takes Splats; gives Views."""
