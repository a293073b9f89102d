"""Procedural sample scene. Takes a count and a seed; gives Splats."""
