"""``scene_views``: virtual cameras that together see every region of a scene."""

from __future__ import annotations

from kissgs.cameras.views import Views
from kissgs.cameras.virtual.regions import allocate_cameras, find_regions
from kissgs.cameras.virtual.select import check_request, split_views, with_size
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
    """Return views of every region of a scene, more of regions that show more; every 8th is held out.

    The result is the same for any number of threads.

    Args:
        splats: the scene, finite (:func:`kissgs.clean`).
        width: of the images, pixels.
        height: of the images, pixels.
        count: number of views, 1 or more.
        threads: number of threads; 0 means one per processor.
        progress: receives the stage ``"cameras"``.

    Raises:
        InvalidViewsError: ``count``, ``width`` or ``height`` is less than 1.
    """
    check_request(count, (width, height))
    with Workers(threads) as pool:
        regions = find_regions(splats, (width, height), pool, progress, camera_count=count)
    progress("cameras", 1.0)
    counts = allocate_cameras(regions, count)
    cameras = [camera for region, n in zip(regions, counts, strict=True) for camera in region.cameras(n)]
    return split_views(with_size(cameras[:count], width, height))
