"""Cameras: posed photographs of a capture, and virtual cameras for a scene without one."""
