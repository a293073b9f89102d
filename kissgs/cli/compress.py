"""``kissgs compress``: compress scenes into containers."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from kissgs.cli.files import for_each_input
from kissgs.cli.options import (
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
    SceneOptions,
    ScenesArgument,
    SeedOption,
    SetOption,
    TargetSizeOption,
    TimeOption,
    ViewsOption,
    budget_of,
    chosen,
    device_of,
    open_views,
    reads_scenes,
    refuse_without_training,
)


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
        from kissgs.cli.compress_streamed import compress_streamed, refuse_options

        refuse_options(manifest, options, container=container, unpacked=unpacked)
        for_each_input(scenes, manifest, ".json", as_json, partial(compress_streamed, options, ray))
    elif ray is not None:
        from kissgs.cli.compress_cluster import ClusterCompression

        cluster = ClusterCompression(ray, options)
        for_each_input(scenes, output, ending, as_json, cluster.result, during=cluster.submitted)
    else:
        from kissgs.cli.compress_here import compress_here

        for_each_input(scenes, output, ending, as_json, partial(compress_here, options, capture))
