"""Cameras that together see the whole of a scene that came without photographs."""

from __future__ import annotations

from kissgs.cameras.views import Views
from kissgs.cameras.virtual.regions import allot, regions
from kissgs.cameras.virtual.select import check_wanted, sized, split_views
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats
from kissgs.core.threads import Workers


def scene_views(
    splats: Splats,
    *,
    width: int,
    height: int,
    count: int,
    threads: int = 0,
    progress: Progress = silent,
) -> Views:
    """Cameras for every region of a scene, in number by what it shows; every 8th is for testing.

    The same scene gives the same cameras, whatever the number of threads.

    Args:
        splats: finite (:func:`kissgs.clean`).
        width: of the images, pixels.
        height: of the images, pixels.
        count: how many views.
        threads: 0 means one per processor.
        progress: receives the stage ``"cameras"``.

    Raises:
        InvalidViewsError: less than one view, or images of less than one pixel, are asked for.
    """
    check_wanted(count, (width, height))
    with Workers(threads) as pool:
        found = regions(splats, (width, height), pool, progress, wanted=count)
    progress("cameras", 1.0)
    cameras = [camera for region, n in zip(found, allot(found, count), strict=True) for camera in region.cameras(n)]
    return split_views(sized(cameras[:count], width, height))
