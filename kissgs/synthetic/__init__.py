"""A procedural scene to try things on. Takes a count and a seed; gives Splats."""
