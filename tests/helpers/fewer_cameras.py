"""Fewer camera candidates and smaller images, for faster tests."""

from kissgs.cameras.virtual import select


def try_fewer(patch, azimuths=8, radii=(1.1, 2.6)):
    """Reduce the camera candidates to some dozens, for tests that do not depend on their number."""
    patch.setattr(select, "AZIMUTHS", azimuths)
    patch.setattr(select, "INSIDE_DIRECTIONS", 4)
    patch.setattr(select, "ORBIT_RADII", radii)


def evaluate_smaller(patch, *, searches):
    """Reduce the images of evaluations, and where ``searches`` also those that a search compares, and their number.

    The sample in which separate parts of a scene are found is smaller, too.
    """
    from kissgs.evaluation import cameras, scene_parts

    patch.setattr(cameras, "WIDTH", 96)
    patch.setattr(cameras, "HEIGHT", 72)
    patch.setattr(scene_parts, "SAMPLE_SIZE", 500)  # of whose positions a tree is made
    if searches:
        from kissgs.compaction import search_evaluation

        patch.setattr(search_evaluation, "COUNT", 8)
        patch.setattr(search_evaluation, "SIDE", 96)
