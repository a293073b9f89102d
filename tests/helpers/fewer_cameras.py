"""Fewer camera candidates, for faster tests."""

from kissgs.cameras.virtual import candidates, select


def try_fewer(patch, azimuths=8, radii=(1.1, 2.6)):
    """Reduce the camera candidates to some dozens, for tests that do not depend on their number."""
    patch.setattr(candidates, "AZIMUTHS", azimuths)
    for module in (candidates, select):
        patch.setattr(module, "INSIDE_DIRECTIONS", 4)
        patch.setattr(module, "ORBIT_RADII", radii)
