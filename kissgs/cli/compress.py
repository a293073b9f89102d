"""``kissgs compact`` and ``kissgs compress``."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Option

from kissgs.cli import files
from kissgs.cli.files import CHECKPOINT, Result, Work, for_each_input, progress_bar, say_notes, sibling, source
from kissgs.cli.options import (
    EncodingOptions,
    ForceOption,
    JsonOption,
    PresetOption,
    SceneOptions,
    ScenesArgument,
    TrainingOptions,
    chosen,
    count_of,
    open_common_views,
    open_views,
    output_option,
    share_of,
    with_option_groups,
)
from kissgs.core.errors import UnsupportedError

if TYPE_CHECKING:
    from kissgs.settings import Settings

# ``kissgs compact``: a ``.ply`` with fewer Gaussians.


@dataclass(frozen=True, kw_only=True)
class CompactionOptions:
    """Options of ``kissgs compact``: how many Gaussians to keep, and how."""

    count: Annotated[
        int | None,
        Option(
            "--count", "-n", metavar="N", parser=count_of, help="Number of Gaussians to keep, such as 200k or 1.5M."
        ),
    ] = None
    ratio: Annotated[
        float | None,
        Option(metavar="SHARE", parser=share_of, help="Share of the Gaussians to keep, such as 0.2 or 20%."),
    ] = None
    max_psnr_drop: Annotated[
        float | None, Option(metavar="DB", help="Keep as few Gaussians as lose at most this PSNR. Takes several runs.")
    ] = None
    method: Annotated[
        str | None,
        Option(
            metavar="METHOD",
            help="prune: remove what images miss least, and train the rest. merge: replace neighbours by one Gaussian; "
            "takes seconds, needs neither views nor torch. Default: merge with the preset fast, else prune.",
        ),
    ] = None
    preset: PresetOption = "balanced"
    changes: Annotated[list[str] | None, Option("--set", metavar="NAME=VALUE", hidden=True)] = None

    def settings(self) -> Settings:
        """Return the settings that these options stand for."""
        given = {name: getattr(self, name) for name in ("method", "count", "ratio", "max_psnr_drop")}
        settings = chosen(self.preset, self.changes, group="compact", compact=given)
        if not settings.compact.enabled:
            raise UnsupportedError(
                "missing the number of Gaussians to keep: give -n 200k, --ratio 0.2 or --max-psnr-drop 0.2"
            )
        return settings


@with_option_groups
def compact(
    scenes: ScenesArgument,
    output: Annotated[
        str | None, output_option("Output NAME.ply, a folder, or '-' for standard output. Required.")
    ] = None,
    *,
    compaction: CompactionOptions,
    evaluate: Annotated[
        bool, Option("--evaluate", help="Measure PSNR, SSIM, MS-SSIM and compressed size after every step.")
    ] = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
    training: TrainingOptions,
    common: SceneOptions,
) -> None:
    """Reduce the number of Gaussians of scenes at nearly equal quality: score, prune and train (POPSpa), or merge.

    The preset fast merges; balanced and paper prune and train.
    """
    from kissgs.cli.tables import compaction_table
    from kissgs.io.ply import write_ply
    from kissgs.pipeline.pipeline import compact as run
    from kissgs.training.checkpoint import delete_checkpoints

    settings, quiet = compaction.settings(), common.quiet or as_json
    training.refuse_without_training(settings)
    if output is None:
        raise UnsupportedError("missing -o: by default the output would overwrite the input")
    open_common_views(training.views)

    def work(scene: str, target: Path) -> Result:
        piped = str(target) == "-"
        capture = open_views(training.views, scene)
        with progress_bar(quiet) as bar, files.stoppable(bar, settings.searches) as progress:
            result = run(
                source(scene),
                None if piped else target,
                settings=settings,
                reading=common.reading(),
                evaluate=evaluate,
                views=capture,
                force_views=training.force_views,
                checkpoint=sibling(scene, CHECKPOINT) if training.checkpoint else None,
                overwrite=force,
                threads=common.threads,
                device=training.device,
                progress=progress,
            )
        if piped:
            say_notes(scene, (result.report.note, *result.report.cleaned.notes), quiet)
            with files.stdout() as file:
                write_ply(file, result.splats)
            delete_checkpoints(result.checkpoint)
        return result.report.as_dict(), compaction_table(result.report, str(target))

    for_each_input(scenes, output, ".ply", work, as_json=as_json, quiet=quiet)


# ``kissgs compress``: compress scenes into containers.


@with_option_groups
def compress(
    scenes: ScenesArgument,
    output: Annotated[
        str | None,
        output_option(
            "Output NAME.zip, NAME.sog, FOLDER/lod-meta.json or NAME.sogxt/ for levels of detail, a folder, or "
            "'-' for standard output. Default: next to the scene."
        ),
    ] = None,
    *,
    encoding: EncodingOptions,
    time: Annotated[
        str | None,
        Option(
            "--time",
            metavar="TIME",
            help="Time for each scene, such as 30s, 2min or 1h: the best that is found in it. With a goal, which comes "
            "first, it bounds the search. --evaluate takes longer.",
        ),
    ] = None,
    unpacked: Annotated[bool, Option("--unpacked", help="Write a folder instead of a zip.")] = False,
    training: TrainingOptions,
    cache: Annotated[
        bool, Option("--cache", help="Cache the sensitivity next to the scene as NAME.sensitivity.npz.")
    ] = False,
    ray: Annotated[
        str | None,
        Option(
            "--ray",
            metavar="[HOST:PORT]",
            help="Compress the scenes on the nodes of a Ray cluster: all machines must see scenes, outputs and --views "
            "at the same paths, on shared storage. Default address: RAY_ADDRESS, a cluster on this machine, or a new "
            "one that uses its processors. Needs the extra ray; docs/guide/many-machines.md.",
        ),
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
    common: SceneOptions,
) -> None:
    """Compress each scene into a SOG-XT container, into SOG, or into a folder with levels of detail."""
    from kissgs.cli import compress_scenes
    from kissgs.formats import ending_of, named_container, named_manifest
    from kissgs.pipeline.limited_time import resolved

    manifest = None if output is None else named_manifest(Path(output))
    kind = named_container(encoding.container, None if manifest or output == "-" else output)
    settings = encoding.settings(time=time)
    renders = (
        encoding.evaluate or settings.encode.rate_distortion or settings.compact.enabled or settings.finetune.enabled
    )
    training.refuse_without_training(resolved(settings, open_common_views(training.views)))
    if training.views is not None and not renders and not common.quiet:
        sys.stderr.write(
            f"kissgs: --views has no effect: the preset {encoding.preset} renders no images; add --evaluate\n"
        )
    each = compress_scenes.SceneCompression(
        settings=settings,
        reading=common.reading(encoding.origin),
        container=kind,
        cache=cache,
        evaluate=encoding.evaluate,
        views=None if training.views is None else training.views.absolute(),
        force_views=training.force_views,
        checkpoint=training.checkpoint,
        force=force,
        threads=common.threads,
        device=training.device,
        quiet=common.quiet or as_json,
    )
    work: Work = partial(compress_scenes.compress_here, each)
    during, ending = None, "" if unpacked else ending_of(kind)
    if manifest is not None:
        compress_scenes.refuse_options(manifest, each, container=encoding.container, unpacked=unpacked)
        work, ending, output = partial(compress_scenes.compress_streamed, each, ray), ".json", str(manifest)
    elif ray is not None:
        cluster = compress_scenes.ClusterCompression(ray, each)
        work, during = cluster.result, cluster.submitted
    for_each_input(scenes, output, ending, work, as_json=as_json, quiet=each.quiet, during=during)
