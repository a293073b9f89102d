"""Fewer camera candidates, for tests that are about something else."""

from kissgs.cameras.virtual import candidates, select


def try_fewer(patch, azimuths=8, radii=(1.1, 2.6)):
    """Of the several hundred thumbnails, some dozens: for checks that do not hang on how many cameras were tried."""
    patch.setattr(candidates, "AZIMUTHS", azimuths)
    for module in (candidates, select):
        patch.setattr(module, "WAYS_TO_LOOK", 4)
        patch.setattr(module, "RADII", radii)
