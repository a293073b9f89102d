"""Cameras and photographs from files: COLMAP, transforms.json, camera JSON. Takes a folder; gives Views."""
