"""``kissgs compact`` and ``kissgs compress``."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from kissgs.cli.files import for_each_input, progress_bar, say_notes, show, sibling, source, stdout
from kissgs.cli.options import (
    CHECKPOINT,
    CheckpointOption,
    CompactOption,
    ContainerOption,
    DeviceOption,
    EvaluateOption,
    FinetuneOption,
    ForceOption,
    ForceViewsOption,
    JsonOption,
    MaxPsnrDropOption,
    MaxSsimDropOption,
    OriginOption,
    PresetOption,
    PsnrOption,
    RayOption,
    ResearchOption,
    SceneOptions,
    ScenesArgument,
    SeedOption,
    SetOption,
    TargetSizeOption,
    TimeOption,
    ViewsOption,
    budget_of,
    chosen,
    count_of,
    device_of,
    open_views,
    reads_scenes,
    refuse_without_training,
    share_of,
)
from kissgs.core.errors import UnsupportedError

# ``kissgs compact``: a ``.ply`` with fewer Gaussians.


@reads_scenes
def compact(
    scenes: ScenesArgument,
    output: Annotated[
        str | None,
        typer.Option(
            "--output", "-o", metavar="PATH", help="Output NAME.ply, a folder, or '-' for standard output. Required."
        ),
    ] = None,
    count: Annotated[
        str | None,
        typer.Option("--count", "-n", metavar="N", help="Number of Gaussians to keep, such as 200k or 1.5M."),
    ] = None,
    ratio: Annotated[
        str | None, typer.Option(metavar="SHARE", help="Share of the Gaussians to keep, such as 0.2 or 20%.")
    ] = None,
    max_psnr_drop: Annotated[
        float | None,
        typer.Option(metavar="DB", help="Keep as few Gaussians as lose at most this PSNR. Takes several runs."),
    ] = None,
    method: Annotated[
        str | None,
        typer.Option(
            metavar="METHOD",
            help="prune: remove what images miss least, and train the rest. merge: replace neighbours by one Gaussian; "
            "takes seconds, needs neither views nor torch. Default: prune.",
        ),
    ] = None,
    views: ViewsOption = None,
    force_views: ForceViewsOption = False,
    preset: PresetOption = "balanced",
    changes: ResearchOption = None,
    evaluate: Annotated[
        bool, typer.Option("--evaluate", help="Measure PSNR, SSIM, MS-SSIM and compressed size after every step.")
    ] = False,
    checkpoint: CheckpointOption = False,
    device: DeviceOption = "cpu",
    force: ForceOption = False,
    as_json: JsonOption = False,
    *,
    common: SceneOptions,
) -> None:
    """Reduce the number of Gaussians of scenes at nearly equal quality: score, prune and train (POPSpa), or merge.

    The preset fast only prunes; balanced, small and paper also train.
    """
    from kissgs.cli.signals import stoppable
    from kissgs.io.ply import write_ply
    from kissgs.pipeline.pipeline import compact as run
    from kissgs.training.checkpoint import delete_checkpoints

    budget = {
        "method": method,
        "count": None if count is None else count_of(count),
        "ratio": None if ratio is None else share_of(ratio),
        "max_psnr_drop": max_psnr_drop,
    }
    given = {name: value for name, value in budget.items() if value is not None}
    settings, quiet = chosen(preset, changes, group="compact", budget=given), common.quiet or as_json
    if not settings.compact.enabled:
        raise UnsupportedError(
            "missing the number of Gaussians to keep: give -n 200k, --ratio 0.2 or --max-psnr-drop 0.2"
        )
    refuse_without_training(settings, checkpoint=checkpoint, device=device)
    if output is None:
        raise UnsupportedError("missing -o: by default the output would overwrite the input")
    capture, training_device = open_views(views), device_of(device)

    def work(scene: str, target: Path) -> dict[str, Any]:
        piped = str(target) == "-"
        with progress_bar(quiet) as bar, stoppable(bar, settings.searches) as progress:
            result = run(
                source(scene),
                None if piped else target,
                settings=settings,
                reading=common.reading(),
                evaluate=evaluate,
                views=capture,
                force_views=force_views,
                checkpoint=sibling(scene, CHECKPOINT) if checkpoint else None,
                overwrite=force,
                threads=common.threads,
                device=training_device,
                progress=progress,
            )
        if piped:
            say_notes(scene, (result.report.note, *result.report.cleaned.notes), quiet)
            with stdout():
                write_ply(sys.stdout.buffer, result.splats)
            delete_checkpoints(result.checkpoint)
        elif not quiet:
            from kissgs.cli.tables import compaction_table

            show(compaction_table(result.report, str(target)))
        return result.report.as_dict()

    for_each_input(scenes, output, ".ply", as_json, work)


# ``kissgs compress``: compress scenes into containers.


@reads_scenes
def compress(
    scenes: ScenesArgument,
    output: Annotated[
        str | None,
        typer.Option(
            "--output",
            "-o",
            metavar="PATH",
            help="Output NAME.zip, NAME.sog, FOLDER/lod-meta.json or NAME.sogxt/ for levels of detail, a folder, or "
            "'-' for standard output. Default: next to the scene.",
        ),
    ] = None,
    container: ContainerOption = None,
    preset: PresetOption = "balanced",
    changes: SetOption = None,
    psnr: PsnrOption = None,
    target_size: TargetSizeOption = None,
    max_psnr_drop: MaxPsnrDropOption = None,
    max_ssim_drop: MaxSsimDropOption = None,
    time: TimeOption = None,
    compact: CompactOption = None,
    finetune: FinetuneOption = None,
    seed: SeedOption = None,
    unpacked: Annotated[bool, typer.Option("--unpacked", help="Write a folder instead of a zip.")] = False,
    evaluate: EvaluateOption = False,
    views: ViewsOption = None,
    force_views: ForceViewsOption = False,
    cache: Annotated[
        bool, typer.Option("--cache", help="Cache the sensitivity next to the scene as NAME.sensitivity.npz.")
    ] = False,
    checkpoint: CheckpointOption = False,
    origin: OriginOption = None,
    device: DeviceOption = "cpu",
    ray: RayOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
    *,
    common: SceneOptions,
) -> None:
    """Compress each scene into a SOG-XT container, into SOG, or into a folder with levels of detail."""
    from kissgs.cli.options import CompressOptions
    from kissgs.formats import ending_of, named_container, named_manifest
    from kissgs.pipeline.training_choice import decided

    named = None if output is None else Path(output)
    manifest = None if named is None else named_manifest(named)
    kind = named_container(container, None if manifest or output == "-" else output)
    settings = chosen(
        preset,
        changes,
        budget=None if compact is None else budget_of(compact),
        finetune=finetune,
        seed=seed,
        time=time,
        psnr=psnr,
        target_size=target_size,
        max_psnr_drop=max_psnr_drop,
        max_ssim_drop=max_ssim_drop,
    )
    renders = evaluate or settings.encode.rate_distortion or settings.compact.enabled or settings.finetune.enabled
    capture, training_device = open_views(views), device_of(device)
    refuse_without_training(decided(settings, capture), checkpoint=checkpoint, device=device)
    if views is not None and not renders and not common.quiet:
        sys.stderr.write(f"kissgs: --views has no effect: the preset {preset} renders no images; add --evaluate\n")
    options = CompressOptions(
        settings=settings,
        reading=common.reading(origin),
        container=kind,
        cache=cache,
        evaluate=evaluate,
        views=views,
        force_views=force_views,
        checkpoint=checkpoint,
        force=force,
        threads=common.threads,
        device=training_device,
        quiet=common.quiet or as_json,
    )
    ending = "" if unpacked else ending_of(kind)
    if manifest is not None:
        from kissgs.cli.compress_scenes import compress_streamed, refuse_options

        refuse_options(manifest, options, container=container, unpacked=unpacked)
        for_each_input(scenes, manifest, ".json", as_json, partial(compress_streamed, options, ray))
    elif ray is not None:
        from kissgs.cli.compress_scenes import ClusterCompression

        cluster = ClusterCompression(ray, options)
        for_each_input(scenes, output, ending, as_json, cluster.result, during=cluster.submitted)
    else:
        from kissgs.cli.compress_scenes import compress_here

        for_each_input(scenes, output, ending, as_json, partial(compress_here, options, capture))
