"""``kissgs compress``: compress scenes into containers."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from kissgs.cli.files import for_each_input
from kissgs.cli.options import (
    AntialiasedOption,
    ContainerOption,
    ForceOption,
    ForceViewsOption,
    JsonOption,
    LevelOption,
    MaxGaussiansOption,
    MaxPsnrDropOption,
    MaxSsimDropOption,
    OriginOption,
    PresetOption,
    PsnrOption,
    QuietOption,
    RawAxesOption,
    RayOption,
    ScenesArgument,
    SeedOption,
    SetOption,
    TargetSizeOption,
    ThreadsOption,
    TimeOption,
    budget_of,
    chosen,
    device_of,
    open_views,
    reading_options,
    refuse_without_training,
)

CompactOption = Annotated[
    str | None,
    typer.Option(
        metavar="BUDGET",
        help="First reduce the number of Gaussians, see 'kissgs compact': to a count (200k), a share (20%) or a "
        "PSNR drop (0.2dB); 100% keeps all; auto searches the number that serves a goal best, which is the default "
        "with held-out photographs, and without --views where it is fine-tuned.",
    ),
]
FinetuneOption = Annotated[
    str | None,
    typer.Option(
        metavar="[STEPS]",
        help="Fine-tune the quantised values on the photographs of --views, or on renderings of the scene: fewer "
        "bytes at equal PSNR, a minute or two more. Default number of steps: that of the preset; 0: never. "
        "Default with a goal, if photographs are held out or there is no --views.",
    ),
]


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
    evaluate: Annotated[
        bool, typer.Option("--evaluate", help="Decode the result, and measure PSNR and SSIM of its renderings.")
    ] = False,
    views: Annotated[
        Path | None,
        typer.Option(
            "--views",
            metavar="DATA",
            help="Capture (COLMAP or transforms.json folder): training views give sensitivity and training targets, "
            "held-out views evaluate. Default: virtual cameras.",
        ),
    ] = None,
    force_views: ForceViewsOption = False,
    cache: Annotated[
        bool, typer.Option("--cache", help="Cache the sensitivity next to the scene as NAME.sensitivity.npz.")
    ] = False,
    checkpoint: Annotated[
        bool,
        typer.Option(
            "--checkpoint", help="Save the state of --compact and --finetune next to the scene, and resume from it."
        ),
    ] = False,
    max_gaussians: MaxGaussiansOption = None,
    level: LevelOption = 0,
    raw_axes: RawAxesOption = False,
    origin: OriginOption = None,
    antialiased: AntialiasedOption = None,
    device: Annotated[str, typer.Option(help="Device of --compact and --finetune: cpu or cuda.")] = "cpu",
    threads: ThreadsOption = 0,
    ray: RayOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Compress each scene into a SOG-XT container, into SOG, or into a folder with levels of detail."""
    from kissgs.cli.options import CompressOptions
    from kissgs.formats import ending_of, named_container, named_manifest
    from kissgs.pipeline.training_choice import decided

    named = None if output is None else Path(output)
    manifest = None if named is None else named_manifest(named)
    kind = named_container(container, None if manifest or output == "-" else output)
    reading = reading_options(max_gaussians, level, raw_axes, origin, antialiased)
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
    if views is not None and not renders and not quiet:
        sys.stderr.write(f"kissgs: --views has no effect: the preset {preset} renders no images; add --evaluate\n")
    options = CompressOptions(
        settings=settings,
        reading=reading,
        container=kind,
        cache=cache,
        evaluate=evaluate,
        views=views,
        force_views=force_views,
        checkpoint=checkpoint,
        force=force,
        threads=threads,
        device=training_device,
        quiet=quiet or as_json,
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
