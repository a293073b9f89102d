"""``kissgs bench --compaction`` and ``--finetuning``: curves as tables and plots."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, cast

from rich.console import Group
from rich.table import Column, Table
from rich.text import Text

from kissgs._cli_pictures import choice
from kissgs._cli_settings import chosen
from kissgs._console import progress_bar
from kissgs.errors import UnsupportedError
from kissgs.evaluation.likeness import spell

if TYPE_CHECKING:
    from rich.console import RenderableType

    from kissgs.compaction.study import Point
    from kissgs.curves import RatePoint
    from kissgs.views.view import Source, Views


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
    from kissgs.compaction.study import RATIOS, WAYS, study
    from kissgs.scenes import load

    known = {way.name: way for way in WAYS}
    for name in names or []:
        if name not in known:
            raise UnsupportedError(f"there is no way {name!r}; there are: {'; '.join(known)}")
    if 0 in (ratios or ()):
        raise UnsupportedError("--ratio 0 keeps nothing; give a share above 0")
    source = _checked(scenes, plot, views, learn_from)
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


def _checked(scenes: list[str], plot: Path | None, views: Views | None, learn_from: str) -> Source:
    """What to learn from, once it is known that it can be, and that a plot can be drawn."""
    from kissgs._plots import check_plot
    from kissgs.views.view import Source

    source = cast(Source, choice("--learn-from", learn_from, Source))
    if views is None and source == "cameras":
        raise UnsupportedError("--learn-from cameras: say whose with --views")
    if plot is not None:
        if len(scenes) > 1:
            raise UnsupportedError("--plot draws one scene; name one")
        check_plot(plot)
    return source


def curves_table(rows: list[tuple[str, Point]]) -> Table:
    """For people."""
    names = ("Gaussians", "PSNR", "SSIM", "bytes", "seconds", "CPU s")
    table = Table("scene", "way", *(Column(name, justify="right") for name in names), box=None, pad_edge=False)
    for scene, point in rows:
        figures = f"{point.count:,}", spell(point.psnr, 2), spell(point.ssim, 4), f"{point.bytes:,}"
        table.add_row(scene, point.way, *figures, f"{point.seconds:.1f}", f"{point.cpu_seconds:.1f}")
    return table


def finetuning_curves(
    scenes: list[str],
    preset: str,
    changes: list[str] | None,
    fidelities: list[float] | None,
    plot: Path | None,
    views: Views | None,
    learn_from: str,
    threads: int,
) -> list[tuple[str, RatePoint]]:
    """With fine-tuning and without, at all fidelities on all scenes."""
    from kissgs.curves import FIDELITIES, rate_curves
    from kissgs.scenes import load

    source = _checked(scenes, plot, views, learn_from)
    settings = chosen(preset, changes, group="finetune")
    rows: list[tuple[str, RatePoint]] = []
    with progress_bar(False) as progress:
        for scene in scenes:
            found = rate_curves(
                *(load(scene, threads=threads, progress=progress), settings, views),
                fidelities=fidelities or FIDELITIES,
                learn_from=source,
                threads=threads,
                progress=progress,
            )
            rows += [(Path(scene).name, point) for point in found]
    return rows


def finetuning_table(rows: list[tuple[str, RatePoint]]) -> RenderableType:
    """For people."""
    from kissgs.curves import saved

    names = ("fidelity", "bytes", "PSNR", "SSIM", "to the scene", "seconds", "CPU s", "MB")
    table = Table("scene", "way", *(Column(name, justify="right") for name in names), box=None, pad_edge=False)
    lines = []
    for scene in dict.fromkeys(name for name, _ in rows):
        points = [point for name, point in rows if name == scene]
        for point in points:
            quality = spell(point.psnr, 2), spell(point.ssim, 4), spell(point.between, 2)
            took = f"{point.seconds:.1f}", f"{point.cpu_seconds:.1f}", f"{point.peak_memory / 1e6:.0f}"
            table.add_row(scene, point.way, f"{point.fidelity:g}", f"{point.bytes:,}", *quality, *took)
        kinds = {"PSNR": "psnr", "SSIM": "ssim", "PSNR to the scene's own pictures": "between"}
        if all(point.psnr == point.between for point in points):
            kinds.pop("PSNR to the scene's own pictures")
        for figure, name in kinds.items():
            share = saved(points, name)
            if share is not None:
                word = "fewer" if share >= 0 else "more"
                lines.append(f"{scene}: {100 * abs(share):.1f} % {word} bytes at equal {figure}, on average")
    return Group(table, *(Text(line) for line in lines))
