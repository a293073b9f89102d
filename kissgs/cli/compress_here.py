"""``compress_here``: ``kissgs compress`` of one scene, in this process."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from kissgs.cli.compact import CHECKPOINT
from kissgs.cli.console import progress_bar
from kissgs.cli.files import say_notes, show, sibling, source, write_stdout
from kissgs.cli.signals import stoppable
from kissgs.pipeline.pipeline import compress
from kissgs.pipeline.training_choice import decided
from kissgs.training.checkpoint import delete_checkpoints

if TYPE_CHECKING:
    from pathlib import Path

    from kissgs.cameras.views import Views
    from kissgs.cli.options import CompressOptions


def compress_here(options: CompressOptions, capture: Views | None, scene: str, target: Path) -> dict[str, Any]:
    """Compress a scene, show a table of the result and return its report; ``capture`` are the ``options.views``."""
    piped = str(target) == "-"
    searches = decided(options.settings, capture).searches
    with progress_bar(options.quiet) as bar, stoppable(bar, searches) as progress:
        if options.evaluate:  # reported here, because evaluation reports only one stage
            from kissgs.core.progress import load_kernels

            load_kernels(progress)
        result = compress(
            source(scene),
            None if piped else target,
            settings=options.settings,
            reading=options.reading,
            container=options.container,
            cache=sibling(scene, ".sensitivity.npz") if options.cache else None,
            evaluate=options.evaluate,
            views=capture,
            force_views=options.force_views,
            checkpoint=sibling(scene, CHECKPOINT) if options.checkpoint else None,
            overwrite=options.force,
            threads=options.threads,
            device=options.device,
            progress=progress,
        )
    if piped:
        say_notes(scene, (result.report.note, *result.report.cleaned.notes), options.quiet)
        write_stdout(result.to_zip())
        delete_checkpoints(*result.checkpoints)
    elif not options.quiet:
        from kissgs.cli.tables import report_table

        show(report_table(result.report, str(target)))
    return result.report.as_dict()
