"""``kissgs bench --compaction``: ways to have fewer Gaussians, as a table and a plot."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, cast

from rich.table import Column, Table

from kissgs._cli_pictures import choice
from kissgs._cli_settings import chosen
from kissgs._console import progress_bar
from kissgs.errors import UnsupportedError
from kissgs.evaluation.likeness import spell

if TYPE_CHECKING:
    from kissgs.compaction.study import Point
    from kissgs.views.view import Views


def compaction_curves(
    scenes: list[str],
    preset: str,
    changes: list[str] | None,
    ratios: list[float] | None,
    names: list[str] | None,
    plot: Path | None,
    views: Views | None,
    learn_from: str,
    threads: int,
) -> list[tuple[str, Point]]:
    """All ways on all scenes. That ``plot`` can be drawn is seen to before; it is drawn when all else is told."""
    from kissgs._plots import check_plot
    from kissgs.compaction.study import RATIOS, WAYS, Source, study
    from kissgs.scenes import load

    known = {way.name: way for way in WAYS}
    for name in names or []:
        if name not in known:
            raise UnsupportedError(f"there is no way {name!r}; there are: {'; '.join(known)}")
    if 0 in (ratios or ()):
        raise UnsupportedError("--ratio 0 keeps nothing; give a share above 0")
    source = cast(Source, choice("--learn-from", learn_from, Source))
    if views is None and source == "cameras":
        raise UnsupportedError("--learn-from cameras: say whose with --views")
    if plot is not None:
        if len(scenes) > 1:
            raise UnsupportedError("--plot draws one scene; name one")
        check_plot(plot)
    settings = chosen(preset, changes, group="compact").compact
    rows: list[tuple[str, Point]] = []
    with progress_bar(False) as progress:
        for scene in scenes:
            found = study(
                load(scene, threads=threads, progress=progress),
                settings,
                views,
                ratios=ratios or RATIOS,
                ways=[known[name] for name in names or known],
                learn_from=source,
                threads=threads,
                progress=progress,
            )
            rows += [(Path(scene).name, point) for point in found]
    return rows


def curves_table(rows: list[tuple[str, Point]]) -> Table:
    """For people."""
    names = ("Gaussians", "PSNR", "SSIM", "bytes", "seconds", "CPU s")
    table = Table("scene", "way", *(Column(name, justify="right") for name in names), box=None, pad_edge=False)
    for scene, point in rows:
        figures = f"{point.count:,}", spell(point.psnr, 2), spell(point.ssim, 4), f"{point.bytes:,}"
        table.add_row(scene, point.way, *figures, f"{point.seconds:.1f}", f"{point.cpu_seconds:.1f}")
    return table
