"""The Gaussian in the centre of a camera's image: an oracle for cameras near the surface."""

import numpy as np


def looked_at(scene, cameras):
    """Return each camera's distance to the Gaussian in the centre of its image, and the index of that Gaussian."""
    found = []
    for camera in cameras:
        offsets = scene.means.astype(np.float64) - camera.position
        distances = np.linalg.norm(offsets, axis=1)
        target = int(np.argmax(offsets @ camera.viewmat[2, :3] / distances))
        found.append((float(distances[target]), target))
    return found
